"""Generates the public surface of `talk`: help, errors, exit codes, the library, and replies to requests.

    python -m tests.golden.surface          updates tests/golden/*.txt; `git diff` shows the changes

Values that differ from run to run are replaced by their types.
"""

from __future__ import annotations

import inspect
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import talkcli
from talkcli import aio, errors
from talkcli.cli.commands import COMMANDS
from tests.conformance.bareserve import TALK, environment, run
from tests.support.processes import Talk
from tests.support.surroundings import short_directory
from tests.wire.test_recorded import VARIES

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE = Path(__file__).parent

#: Arguments by command that are wrong, or that find no server. The exit code and the output are recorded.
ERRORS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("", (
        "nonsense", "sey hello", "--sockt /x status", "--socket '' status", "--connect-timeout 0 status",
        "--connect-timeout soon status", "--connect-timeout 0.1 status", "--connect-timeout 5 --robot @all status",
        "--connect-timeout 5 serve", "--connect-timeout 5 bridge --name anna", "--connect-timeout 5 fleet status",
        "--connect-timeout 5 doctor", "say --connect-timeout 5 -o x.wav hello", "status --json --json extra words",
    )),
    ("say", (
        "", "''", "'  '", "hello", "--wait hello", "--prempt hello", "-t 5 hello", "-wt 0 hello", "-wt never hello",
        "--preempt --queue --flush hello", "--queue --flush hello", "--priority high hello", "--priority 1000001 hello",
        "--ttl -1 hello", "--ttl nan hello", "--ttl 5x hello", "--lead-in 0.5ms hello",
        "--stall 2m --stream", "--key '' hello", "--throttle -1 hello", "--id '' hello", "--id 4k7f-12 hello",
        "--id 12 hello", "--id 'a b' hello", "--as '' hello", "--rate 79 hello",
        "--rate 451 hello", "--rate 99.5 hello", "--volume 1.1 hello", "--volume loud hello", "--pitch 101 hello",
        "--voice '' hello", "-o", "-o '' hello", "-o /nowhere/x.wav hello", "-o x.wav --key k hello", "--lines hello",
        "-- ''",
    )),
    ("play", ("", "''", "a b", "--list a", "--list -w", "--rate 90 a", "-f a", "-t 5 a", "a")),
    ("wait", ("--timeout -1", "-t 0.1", "''")),
    ("cancel", ("", "''", "--before ''", "--key ''")),
    ("status", ("", "a b", "''")),
    ("", ("--json status",)),
    ("watch", ("", "now")),
    ("log", (
        "", "-n 0", "-n 2201", "--since 5d", "--since 2h --until 3h", "--since 2099-01-01", "--as ''",
    )),
    ("set", ("", "--rate 5", "--ttl -1", "--preempt --no-preempt --rate x")),
    ("pause", ("", "now", "--while", "--while ls -l", "--while -- ls", "--for 25h", "--robot anna --while -- ls")),
    ("resume", ("",)),
    ("voices", ("", "--language ''")),
    ("serve", (
        "--rate 5", "--volume 2", "--pitch -1", "--max-queue 0", "--max-text 10001", "--max-clients 0",
        "--lead-in 5001", "--socket-mode 0888", "--socket-mode 0066", "--player null --device x", "--player file:",
        "--player null --driver parrot", "--print-unit nonsense", "--history notext", "now",
    )),
    ("completion", ("", "tcsh")),
    ("doctor", ("now",)),
)  # fmt: skip

#: The classes that users construct.
CONSTRUCTED = {"Client", "Fleet"}
#: A conversation with a server that has the scripted engine. It contains every request, and invalid ones.
REQUESTS: tuple[dict[str, Any], ...] = (
    {"request": "hello", "name": "golden"},
    {"seq": 1, "request": "voices"},
    {"seq": 1, "request": "sounds"},
    {"seq": 2, "request": "status"},
    {"seq": 3, "request": "set"},
    {"seq": 4, "request": "set", "rate": 150, "volume": 0.5, "voice": "en", "pitch": 60, "preempt": True, "ttl": 9},
    {"seq": 5, "request": "set", "rate": 1},
    {"seq": 6, "request": "watch"},
    {"seq": 7, "request": "pause"},
    {"seq": 8, "request": "say", "text": "one length=0", "wait": True, "feedback": True, "id": "a/1", "preempt": False},
    {"seq": 9, "request": "say", "text": "two", "key": "k", "priority": 3, "ttl": 60, "rate": 90, "volume": 1}
    | {"pitch": 1, "data": {"a": 1}},
    {"seq": 10, "request": "say", "text": "three", "key": "k", "priority": 3, "preempt": False, "voice": "en"},
    {"seq": 11, "request": "say", "text": "four", "throttle": 5, "flush": True, "preempt": False},
    {"seq": 12, "request": "say", "text": "five", "format": "ssml"},
    {"seq": 13, "request": "say", "text": ""},
    {"seq": 14, "request": "say", "text": "six", "voice": "parrot"},
    {"seq": 15, "request": "say", "text": "one length=0 more", "id": "a/1"},
    {"seq": 16, "request": "say", "text": "seven", "id": "4k7f-3"},
    {"seq": 17, "request": "say", "text": "eight", "rate": 200.5},
    {"seq": 18, "request": "say", "text": "nine", "louder": True},
    {"seq": 19, "request": "say"},
    {"seq": 20, "request": "shout"},
    {"seq": 21},
    {"seq": "22", "request": "status"},
    {"seq": 23, "request": "status", "id": "a/1"},
    {"seq": 24, "request": "status", "id": "nobody"},
    {"seq": 25, "request": "wait", "ids": ["nobody"]},
    {"seq": 26, "request": "cancel", "ids": ["nobody", "later.1"], "before": "nowhere"},
    {"seq": 27, "request": "cancel", "key": "k"},
    {"seq": 28, "request": "cancel", "current": True},
    {"seq": 29, "request": "say", "text": "ten", "id": "later.1"},
    {"seq": 30, "request": "resume"},
    {"seq": 31, "request": "wait"},
    {"seq": 32, "request": "wait", "ids": ["a/1"], "feedback": True},
    {"seq": 33, "request": "log", "count": 3},
    {"seq": 34, "request": "log", "count": 0},
    {"seq": 34, "request": "log", "history": True, "grep": "one", "state": "SUCCEEDED", "since": 1, "until": 1e12},
    {"seq": 34, "request": "log", "state": "LOST"},
    {"seq": 35, "request": "cancel"},
)


def surface() -> dict[str, str]:
    """Return the text of each file by its name."""
    files = {f"help-{name or 'talk'}": text for name, text in _helps()}
    return {**files, "errors": _errors(), "library": _library(), "wire": _wire()}


def write() -> None:
    """Write all files, and delete outdated ones."""
    for path in HERE.glob("*.txt"):
        path.unlink()
    for name, text in surface().items():
        (HERE / f"{name}.txt").write_text(text, encoding="utf-8")


def _run_without_server(home: str, argv: list[str]) -> tuple[int, str, str]:
    """Run `talk` without a server or sound, and return its exit code and output, with `home` replaced by HOME."""
    done = run([*TALK, *argv], environment(home, TALK_SOCKET=f"{home}/s", COLUMNS="80", PULSE_SERVER="unix:/nowhere"))
    return done.code, done.out.replace(home, "HOME"), done.err.replace(home, "HOME")


def _helps() -> Iterator[tuple[str, str]]:
    with short_directory() as home:
        for name in ("", *COMMANDS):
            code, out, err = _run_without_server(home, [*([name] if name else []), "--help"])
            assert (code, err) == (0, ""), name
            yield name, out


def _errors() -> str:
    results = []
    with short_directory() as home:
        for line in (f"{command} {words}".strip() for command, lines in ERRORS for words in lines):
            code, out, err = _run_without_server(home, shlex.split(line))
            results.append(f"$ talk {line}\n{_indented(out)}{_indented(err, '! ')}= {code}\n")
    return "\n".join(results)


def _indented(text: str, mark: str = "  ") -> str:
    return "".join(f"{mark}{line}\n" for line in text.splitlines())


def _library() -> str:
    """Return the public names of `talkcli` and `talkcli.aio` with their members, and the errors."""
    lines = []
    for package, prefix in ((talkcli, ""), (aio, "aio.")):
        lines.append(f"{prefix}__all__ = {package.__all__}")
        for name in package.__all__:
            value = getattr(package, name)
            if isinstance(value, type):
                lines += ["", f"class {prefix}{name}", *_members(value)]
        lines.append("")
    lines.append("errors")
    for value in vars(errors).values():
        if isinstance(value, type) and issubclass(value, errors.TalkError):
            (base, *_) = value.__bases__
            lines.append(f"    {value.__name__}({base.__name__}): code {value.code}, exit {value.exit_code}")
    return "\n".join(lines) + "\n"


def _members(kind: type) -> Iterator[str]:
    if hasattr(kind, "__members__"):
        yield from (f"    {member.name} = {member.value}" for member in kind)  # type: ignore[attr-defined]
        return
    if kind.__name__ in CONSTRUCTED:
        yield f"    def __init__{inspect.signature(kind.__init__)}"  # type: ignore[misc]
    yield from (f"    {name}: {kind}" for name, kind in inspect.get_annotations(kind).items())
    for name in dir(kind):
        member = inspect.getattr_static(kind, name)
        if name.startswith("_"):
            continue
        if isinstance(member, property):
            yield f"    {name}: {inspect.signature(member.fget).return_annotation}"  # type: ignore[arg-type]
        elif callable(member):
            yield f"    {'async ' * inspect.iscoroutinefunction(member)}def {name}{inspect.signature(member)}"


def _wire() -> str:
    """Return the replies of a server with the scripted engine to `REQUESTS`."""
    talk = Talk(scripted=True)
    try:
        with talk.connect() as wire:
            boot = str(wire.greeting["boot"])
            lines = [f"< {json.dumps(_stable(wire.greeting))}"]
            for request in REQUESTS:
                wire.send(request)
                lines.append(f"> {json.dumps(request)}")
                # After "resume", the last goal is spoken.
                awaited = {"ok", "result"} if request.get("request") == "resume" else {"ok"}
                while awaited:
                    message = wire.receive()
                    lines.append(f"< {json.dumps(_stable(message))}")
                    awaited -= {"ok"} & message.keys() | {str(message.get("event"))}
        talk.stop()
    finally:
        talk.close()
    return "\n".join(lines).replace(f"{boot}-", "BOOT-") + "\n"


def _stable(value: Any, name: str = "") -> Any:
    """Replace values that differ from run to run by their types, except messages for people."""
    if isinstance(value, dict):
        return {key: _stable(item, key) for key, item in value.items()}
    if isinstance(value, list):
        return [_stable(item) for item in value]
    if name in VARIES - {"message", "clients"} or name == "boot":
        return "null" if value is None else type(value).__name__
    return value


if __name__ == "__main__":
    write()
