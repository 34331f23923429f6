"""What a program can send, be told and end with is in the documents' tables, and these have nothing else."""

from __future__ import annotations

import ast
import os
import re
from functools import cache
from typing import TYPE_CHECKING

import click
import pytest

from talkcli import errors, paths
from talkcli.cli import click_app, commands
from talkcli.fleet import policy, topics
from talkcli.goals import states
from talkcli.goals.goal import Goal
from talkcli.goals.history import MAX_RECALLED, MAX_REJECTED, MAX_SPOKEN
from talkcli.goals.options import Cancel
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.lines import MAX_LINE
from talkcli.protocol.requests import KINDS, read_request
from talkcli.server import connection, stream
from talkcli.server.requests import ALL_WAITING, EACH, MAX_WAITING, RECENT
from talkcli.server.run import MAX_CLIENTS, MAX_QUEUE
from tests.support.documents import DOCUMENTS, FLEET, README, ROOT, WIRE, first_column, tables, words
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from tests.support.documents import Document
    from tests.support.processes import Talk

#: Which argument of a call is a goal's reason; the place of a keyword doesn't matter.
REASON_AT = {
    "CannotSpeak": 0, "StartFailed": 0, "Ended": 2, "_lose_process": 1, "_recall": 1, "_stop": 1,
    "_end": 2, "failed": 1,
}  # fmt: skip
#: … and which is the code of an error on the wire.
CODE_AT = {"BadRequest": 1, "RequestRefused": 1, "failure": 1, "refuse": 0}
CODE = re.compile(r"[a-z]+(_[a-z]+)*")


def requests_table() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the rows of each request's fields."""
    found: dict[str, dict[str, tuple[str, ...]]] = {}
    kind = ""
    for row in tables(WIRE.section("Requests"))[0][1:]:
        kind = words(row[0])[0] if row[0] else kind
        fields = found.setdefault(kind, {})
        if row[1]:
            fields[words(row[1])[0]] = row
    return found


@cache
def sources(*, fleet: bool = False) -> list[tuple[str, ast.AST]]:
    """Return every node of the sources, with the name of its file: without a fleet's, or those alone."""
    paths = [each for each in sorted((ROOT / "talkcli").rglob("*.py")) if (each.parent.name == "fleet") is fleet]
    return [(path.name, node) for path in paths for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]


def constants(node: ast.AST | None) -> set[str]:
    """Return the codes that an expression may be."""
    if isinstance(node, ast.IfExp):
        return constants(node.body) | constants(node.orelse)
    if isinstance(node, ast.BoolOp):
        return set().union(*map(constants, node.values))
    found = node.value if isinstance(node, ast.Constant) else None
    return {found} if isinstance(found, str) and CODE.fullmatch(found) else set()


def arguments(places: dict[str, int], keyword: str, *, fleet: bool = False) -> set[str]:
    """Return the codes that stand at their place in the calls of the sources."""
    found = set()
    for _, node in sources(fleet=fleet):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in places and len(node.args) > places[name]:
            found |= constants(node.args[places[name]])
        if name in places or name == "Goal":
            found |= set().union(*(constants(each.value) for each in node.keywords if each.arg == keyword))
    return found


def reasons() -> set[str]:
    """Return the reasons that the sources give to goals: by calls, or as the first of a pair with words for people."""
    found = arguments(REASON_AT, "reason")
    for name, node in sources():
        if isinstance(node, ast.Call):  # of `Goal`, or of `replace`
            found |= set().union(*(constants(each.value) for each in node.keywords if each.arg == "reason"))
        if isinstance(node, ast.Tuple) and len(node.elts) == 2:
            first, second = node.elts
            for_people = isinstance(second, ast.JoinedStr | ast.Call) or " " in str(getattr(second, "value", ""))
            if name in {"scheduler.py", "text.py", "speech.py"} and for_people:
                found |= constants(first)
            if name == "scheduler.py" and isinstance(first, ast.Name):
                found |= constants(second)
    return found


def test_reasons_of_the_sources_are_found() -> None:
    """One of each form, so that a search that finds nothing is seen."""
    assert reasons() >= {
        "canceled", "preempted", "replaced", "displaced", "expired", "throttled", "queue_full", "invalid_text",
        "text_too_long", "unknown_voice", "audio_device", "audio_lost", "engine_hung", "lost", "shutdown",
    }  # fmt: skip


def test_reasons_are_in_the_table() -> None:
    table = tables(WIRE.section("States"))[1]
    assert sorted(first_column(table)) == sorted(reasons())
    for row in table[1:]:
        for state in row[1].split(", "):
            assert State[state].terminal, row


def test_states_are_in_the_table() -> None:
    table = tables(WIRE.section("States"))[0]
    documented = {words(row[0])[0]: (int(row[1]), row[3] == "yes") for row in table[1:]}
    assert documented == {each.name: (int(each), each.terminal) for each in State}


def test_requests_and_their_fields_are_in_the_table() -> None:
    assert {kind: set(fields) for kind, fields in requests_table().items()} == {
        kind: {each.name for each in request.options} for kind, request in KINDS.items()
    }
    answered = {each for row in tables(WIRE.section("Requests"))[1][1:] for each in words(row[0])[:1]}
    assert answered == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_value_of_the_documented_type_is_read_and_null_where_it_may_be(kind: str) -> None:
    samples = {"string": "x", "integer": 1, "number": 0.5, "boolean": True, "object": {}, "list": ["x"], "id": "x"}
    needed = {"text": "x"} if kind == "say" else {}
    for name, row in requests_table()[kind].items():
        documented = re.split(r"[ ,]", row[2])[0]
        read_request({"request": kind, **needed, name: samples[documented]})
        wrong: list[object] = [] if "or null" in row[2] else [None]
        for value in [*wrong, {} if documented != "object" else []]:
            with pytest.raises(errors.BadRequest, match="must be"):
                read_request({"request": kind, **needed, name: value})


def test_what_is_kept_is_what_the_text_says() -> None:
    assert Cancel().everything
    assert RECENT == 10
    kept = f"{MAX_SPOKEN:,} spoken goals, {MAX_RECALLED:,} RECALLED ones and {MAX_REJECTED} REJECTED ones"
    assert f"The server keeps the last {kept}." in WIRE.section("The goal")


def test_limits_are_those_of_the_code() -> None:
    limits = {row[0]: row[1] for row in tables(WIRE.section("Errors and limits"))[1][1:]}
    assert limits["a request"].startswith(f"{MAX_LINE:,} bytes")
    assert f"within {connection.FIRST_REQUEST:g} s" in limits["the first request"]
    assert f"within {connection.LINE_LIMIT:g} s" in limits["a line"]
    assert limits["lines that are no requests"].startswith(f"{connection.MAX_BAD_LINES} ")
    read = limits["a client that doesn't read"]
    assert f"{connection.SOFT_OUTPUT // 1024} KiB" in read
    assert f"{connection.HARD_OUTPUT // 2**20} MiB" in read
    assert f"past {stream.ALL_OUTPUT // 2**20} MiB for all" in limits["clients that don't read"]
    assert limits["clients"].startswith(f"{MAX_CLIENTS} ")
    assert limits["queue"].startswith(f"{MAX_QUEUE} ")
    assert limits["requests that wait"].startswith(
        f"{MAX_WAITING:,} of one connection, and {ALL_WAITING >> 20} MiB for all"
    )
    assert f"and {EACH >> 10} KiB)" in limits["requests that wait"]


def test_limits_of_a_fleet_are_those_of_the_code() -> None:
    needs_packages("paho")
    from talkcli.fleet import askers, bridge, link, news, session

    limits = {row[0]: row[1] for row in tables(FLEET.section("Limits"))[0][1:]}
    assert limits["a request"].startswith(f"{MAX_LINE:,} bytes")
    assert limits["correlation data"] == f"{policy.MAX_CORRELATION} bytes"
    assert f"past {policy.MAX_CORRELATION} bytes the request" in FLEET.section("Requests and replies")
    assert f"at most {(link.MAX_PACKET - link.MAX_HEAD) // 1024} KiB" in limits["a reply's payload"]
    assert limits["goals from afar that are pending"] == str(policy.SHARE)
    assert limits["askers"].startswith(f"{askers.MAX_SESSIONS}, and {session.MAX_WAITING} requests of each")
    assert limits["requests that wait"].startswith(f"{session.MAX_HELD >> 20} MiB for all askers")
    assert limits["an asker that says nothing"] == f"{session.IDLE:g} s"
    assert limits["ids that are remembered"] == f"{policy.REMEMBERED:,}"
    assert f"past {bridge.SOFT_OUTPUT // 1024} KiB" in limits["what the broker is slow to take"]
    assert f"past {bridge.HARD_OUTPUT // 2**20} MiB" in limits["what the broker is slow to take"]
    section = FLEET.section("Topics")
    assert f"1 to {topics.LONGEST} of" in section
    assert f"expires after {bridge.PRESENCE_EXPIRY} s, renewed every {bridge.PRESENCE_EVERY:g} s" in section
    assert f"expires after {news.EVENT_EXPIRY} s" in section
    assert f"more than {policy.STALE_AFTER:g} s ago" in " ".join(FLEET.section("What is refused").split())


def test_places_are_those_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    variables = {"XDG_RUNTIME_DIR": "/own/run", "TMPDIR": "/own/tmpdir", "TEMP": "/own/temp", "TMP": "/own/tmp"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.platform", "linux")
    (paragraph,) = re.findall(r"^\*\*Connecting\..*?\n\n", WIRE.text, re.MULTILINE | re.DOTALL)
    places = [each for each in words(paragraph) if each.endswith(".sock")]
    for name, value in variables.items():
        places = [each.replace(f"${name}/", f"{value}/") for each in places]
    assert [each.replace("UID", str(os.getuid())) for each in places] == paths.client_sockets(None)


def test_goal_has_the_keys_of_the_table() -> None:
    assert first_column(tables(WIRE.section("The goal"))[0]) == list(Goal("", State.PENDING).to_json())


def test_server_has_the_keys_of_the_text(scripted: Talk) -> None:
    found = re.search(r"^`server` has (.*?)\.$", WIRE.section("Requests"), re.MULTILINE | re.DOTALL)
    assert found
    assert words(found[1]) == list(scripted.request("status")["server"])


def test_events_are_in_the_table() -> None:
    """Every kind that the server sends is an event of the protocol's, or stands as `{"event": KIND` in the sources."""
    sent = {kind: set(each.__annotations__) for kind, each in events._KINDS.items()}
    for path in (ROOT / "talkcli" / "server").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Dict):
                keys = [each.value if isinstance(each, ast.Constant) else "" for each in node.keys]
                if "event" in keys:
                    value = node.values[keys.index("event")]
                    assert isinstance(value, ast.Constant), f"{path.name}:{node.lineno}"
                    sent.setdefault(str(value.value), set()).update(str(each) for each in keys if each)
    table = {words(row[0])[0]: set(words(row[2])) for row in tables(WIRE.section("Events"))[0][1:]}
    assert set(sent) == set(table) >= {"state", "word", "paused", "result", "alive"}
    for kind, fields in sent.items():
        assert fields - {"event"} <= table[kind], kind


def test_error_codes_are_in_the_table() -> None:
    classes: list[type[errors.RequestRefused]] = [
        errors.UnknownGoal,
        errors.BadRequest,
        *errors.BadRequest.__subclasses__(),
    ]
    codes = arguments(CODE_AT, "code") | {each.code for each in classes}
    codes |= {"unknown_voice"}  # goes from `voice_fault` into the reply to `set`
    assert codes >= {"bad_json", "unknown_field", "line_too_long", "too_slow", "bad_option", "internal_error"}
    assert sorted(first_column(tables(WIRE.section("Errors and limits"))[0])) == sorted(codes)


def test_error_codes_of_a_fleet_are_in_its_table() -> None:
    """Those that a bridge has besides the wire's."""
    codes = arguments({"BadRequest": 1, "failure": 1, "_refuse": 1}, "code", fleet=True)
    codes |= {policy.STALE, errors.Busy.code}
    codes -= set(first_column(tables(WIRE.section("Errors and limits"))[0]))
    table = tables(FLEET.section("What is refused"))[0]
    assert sorted(first_column(table)) == sorted(codes)


def test_exit_codes_are_in_the_table() -> None:
    rows = [row[0] for row in tables(README.section("Exit codes"))[0][1:]]
    assert rows[-1] == f"{errors.EXIT_SIGNAL}+n"
    classes = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, errors.TalkError)]
    used = {each.exit_code for each in classes} | set(states.EXIT_CODES.values())
    used |= {errors.EXIT_OK, errors.EXIT_ERROR, errors.EXIT_USAGE, errors.EXIT_DIFFER, errors.EXIT_TIMEOUT}
    assert sorted(map(int, rows[:-1])) == sorted(used)


def command(name: str) -> click.Command:
    found = click_app.talk.get_command(click.Context(click_app.talk), name)
    assert found, name
    return found


def options(name: str) -> set[str]:
    """Return the options of a command that it doesn't share with all others."""
    shared = {each.name for each in click_app.talk.params}
    own = [each for each in command(name).params if isinstance(each, click.Option) and each.name not in shared]
    return {form for each in own for form in (*each.opts, *each.secondary_opts)}


def test_commands_are_in_the_table() -> None:
    rows = tables(README.section("Commands"))[0][1:]
    assert sorted(each.split()[0] for row in rows for each in words(row[0])) == sorted(commands.COMMANDS)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda each: each.name)
def test_every_command_in_the_examples_can_be_read(document: Document) -> None:
    """Its options are the command's own; what stands around it is the shell's business. The README has all commands."""
    seen = set()
    lines = "".join(document.examples("sh"))
    for name, rest in re.findall(r"\btalk (?:--json |--(?:robot|connect-timeout) \S+ )?([a-z]+)\b([^|#;&\n]*)", lines):
        if name not in commands.COMMANDS:
            continue
        seen.add(name)
        shared = {form for each in click_app.talk.params for form in each.opts}
        for option in re.findall(r"(?<!\S)(--?[a-z][a-z-]*)", rest.split(" -- ")[0]):
            assert option in options(name) | shared, f"talk {name}{rest}"
    assert document is not README or seen == set(commands.COMMANDS)


def test_readme_has_the_setup_commands_as_they_were() -> None:
    assert (
        README.examples("sh", "Start")
        == [each for each in README.examples("sh") if ".venv" in each]
        == [
            "python3 -m venv .venv && . .venv/bin/activate && pip install . && "
            '{ talk serve & talk --connect-timeout 10 say "talk is ready" --wait; }\n',
            "python3 -m venv .venv && . .venv/bin/activate && pip install . && "
            '{ talk serve --player file:ready.wav & talk --connect-timeout 10 say "talk is ready" --wait; }\n',
            "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest -n 4\n",
        ]
    )
