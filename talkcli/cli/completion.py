"""Completion: what the shells offer for a word that is being typed, and how each asks for it and takes the answer.

What is offered is what the server that would be asked knows: it must be quick and never say anything, and where no
server answers at once, there is nothing to offer.

The scripts and formats are our own, on click's machinery. click's scripts give a shell the words as it cuts them: bash
cuts at `:` and `=`, which ids may hold, and a value with a blank, a comma, a quote or a `*` doesn't survive the way
back. Here the shell sends the line up to the cursor, as it was typed; what goes back is quoted, and begins where the
shell puts it. The scripts are the files beside this one, which `talk completion` prints.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING, TypeVar

import click
from click.shell_completion import CompletionItem, ShellComplete, add_completion_class, split_arg_string

from talkcli.cli.show import show
from talkcli.engine.voices import is_neural
from talkcli.errors import TalkError
from talkcli.protocol.events import ServerStatus, unfinished
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import ClassVar

    from talkcli.cli.show import Common
    from talkcli.client.client import Client
    from talkcli.fleet.presence import Presence
    from talkcli.goals.goal import Goal, JsonObject

    Items = list[CompletionItem[str]]

_Answer = TypeVar("_Answer")

#: Seconds in which the server must answer: somebody has pressed a key and looks at the screen.
PATIENCE = 0.5
#: Ended goals whose ids are offered.
_ENDED = 100
#: Characters of a text that stand beside an id.
_MAX_TEXT = 60
#: What there is to offer where no server answers.
_NO_STATUS = ServerStatus({}, None, (), ())

#: What bash takes as it stands; letters and digits of other scripts, too.
_BASH_PLAIN = re.compile(r"[^\w@%+=:,./-]")


class _Line(ShellComplete):
    """A shell that sends its line up to the cursor in COMP_WORDS."""

    #: the file of its script
    script: ClassVar[str]

    def source(self) -> str:
        """Return the script."""
        with open(os.path.join(os.path.dirname(__file__), self.script), encoding="utf-8") as file:
            return file.read()

    def get_completion_args(self) -> tuple[list[str], str]:
        line = os.environ["COMP_WORDS"]
        words = split_arg_string(line)
        # One more character shows whether it would begin a word or belong to the last one.
        if len(split_arg_string(f"{line}x")) > len(words):
            words.append("")
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem[str]) -> str:
        return "file" if item.type == "file" else self.line(item.value, item.help)

    def line(self, value: str, words: str | None) -> str:  # noqa: ARG002
        """Return a line for what is offered: a kind, and what the shell shall insert."""
        return f"plain,{value}"


class Bash(_Line):
    """bash replaces what it takes for the word, COMP_CWORD, by what it gets, and quotes nothing."""

    name = "bash"
    script = "talk.bash"

    def line(self, value: str, words: str | None) -> str:  # noqa: ARG002
        typed, quote = _last_word(os.environ["COMP_WORDS"])
        replaced = os.environ["COMP_CWORD"]
        if replaced in {":", "="}:
            replaced = ""  # so bash-completion says, behind sudo for one, that nothing follows what bash cuts at
        stays = typed.removesuffix(replaced) if replaced else typed
        kept = "".join(split_arg_string(stays))
        return f"plain,{_quoted(_whole(value, typed).removeprefix(kept), quote)}"


class Zsh(_Line):
    """zsh quotes what it inserts; a help stands behind a colon."""

    name = "zsh"
    script = "_talk"

    def line(self, value: str, words: str | None) -> str:
        if not words:
            return super().line(value, words)
        value, words = (each.replace("\\", "\\\\") for each in (value, words))
        value = value.replace(":", "\\:")
        return f"described,{value}:{words}"


class Fish(_Line):
    """fish quotes what it inserts; a help stands behind a tab."""

    name = "fish"
    script = "talk.fish"

    def line(self, value: str, words: str | None) -> str:
        typed, _ = _last_word(os.environ["COMP_WORDS"])
        return f"plain,{_whole(value, typed)}" + (f"\t{words}" if words else "")


#: Each of them by its shell's name.
SHELLS: dict[str, type[ShellComplete]] = {"bash": Bash, "zsh": Zsh, "fish": Fish}


def completion(_: Common, shell: str) -> None:
    """Print the script of a shell."""
    talk = click.get_current_context().find_root().command
    show(SHELLS[shell](talk, {}, "talk", "_TALK_COMPLETE").source().rstrip("\n"))


def register() -> None:
    """Have click use these for their shells."""
    for each in SHELLS.values():
        add_completion_class(each)


def _last_word(line: str) -> tuple[str, str]:
    """Return the word at the end of a line as it was typed, and the quote that is open in it."""
    word, quote, escaped = "", "", False
    for character in line:
        if escaped:
            escaped = False
        elif character == "\\" and quote != "'":
            escaped = True
        elif quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character.isspace():
            word = ""
            continue
        word += character
    return word, quote


def _whole(value: str, typed: str) -> str:
    """Return what is offered for the value of --option=VALUE with its option, as it was typed."""
    word = "".join(split_arg_string(typed))
    option, equals, _ = word.partition("=")
    return f"{option}={value}" if equals and option.startswith("-") else value


def _quoted(value: str, quote: str) -> str:
    """Return the value so that bash reads it as one word, within the quote that is open."""
    if quote == "'":
        return value.replace("'", "'\\''")
    if quote:
        return re.sub(r'(["\\$`])', r"\\\1", value)
    return _BASH_PLAIN.sub(lambda found: f"\\{found[0]}", value)


def goal_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the ids of goals that have not ended."""
    status = _status(context)
    return _ids(unfinished(status), status, incomplete)


def known_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the ids of goals, the ended ones too: first what is not over, then the newest."""
    status, ended = _ask(context, lambda client: (client.status(), client.log(_ENDED))) or (_NO_STATUS, [])
    return _ids([*unfinished(status), *reversed(ended)], status, incomplete)


def keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the keys of goals that have not ended, and of the last that have."""
    status = _status(context)
    return _keys([*unfinished(status), *reversed(status.recent)], incomplete)


def unfinished_keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the keys of goals that have not ended."""
    return _keys(unfinished(_status(context)), incomplete)


def voices(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the languages of the engine's voices; their ids and names, once the word can't be a language.

    A neural voice is called by its id alone, which is offered with the languages: such voices are few.
    """
    found = _ask(context, lambda client: client.voices()) or []
    for field in ("language", "id", "name"):
        fields = [("id" if is_neural(str(each.get("id"))) else field, each) for each in reversed(found)]
        offered = {str(each.get(name) or ""): _voice_help(each, name) for name, each in fields}
        items = _items(reversed(offered.items()), incomplete)
        if items:
            return items
    return []


def robots(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the robots of the fleet that are there, and then their groups."""
    options: Common = context.find_root().obj
    try:
        broker = options.broker()
        from talkcli.fleet import topics
        from talkcli.fleet.desk.roster import roster

        found = roster(broker, PATIENCE)
    except (TalkError, OSError, ValueError):
        return []
    there = [each for _, each in sorted(found.items()) if each.online]
    members = Counter(f"@{group}" for each in there for group in {*each.groups} if not topics.fault(group))
    groups = [(name, f"{count} robot{'' if count == 1 else 's'}") for name, count in sorted(members.items())]
    return _items([*((each.name, ", ".join(_groups(each)) or "robot") for each in there), *groups], incomplete)


def _groups(presence: Presence) -> list[str]:
    return [printable(each, _MAX_TEXT) for each in presence.groups]


def files(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Have the shell offer files."""
    return [CompletionItem(incomplete, type="file")]


def players(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Return the players that talk knows by name."""
    from talkcli.engine.players import PLAYERS

    return _items([(name, each.about) for name, each in PLAYERS.items()], incomplete)


def _ask(context: click.Context, question: Callable[[Client], _Answer]) -> _Answer | None:
    """Return the server's answer, or None if there is none for whatever reason."""
    options: Common = context.find_root().obj  # with --socket, where it stood before
    options.connect_timeout = None
    try:
        with options.connect(PATIENCE) as client:
            return question(client)
    except (TalkError, OSError, ValueError):
        return None


def _status(context: click.Context) -> ServerStatus:
    return _ask(context, lambda client: client.status()) or _NO_STATUS


def _ids(goals: Iterable[Goal], status: ServerStatus, incomplete: str) -> Items:
    """Return the ids; where digits were typed, the numbers that stand for this server's as well."""
    own = f"{status.server.get('boot')}-"
    digits = incomplete.isascii() and incomplete.isdecimal()
    offered = []
    for each in goals:
        number = each.id.removeprefix(own)
        names = [number, each.id] if digits and number != each.id else [each.id]
        offered += [(name, _goal_help(each)) for name in names]
    return _items(offered, incomplete)


def _keys(goals: Iterable[Goal], incomplete: str) -> Items:
    offered: dict[str, str] = {}
    for each in goals:
        if each.key is not None:
            offered.setdefault(each.key, _goal_help(each))
    return _items(offered.items(), incomplete)


def _items(offered: Iterable[tuple[str, str]], incomplete: str) -> Items:
    # What can't be seen can't be chosen either, and would reach the terminal raw.
    fitting = ((value, words) for value, words in offered if value.startswith(incomplete) and value.isprintable())
    return [CompletionItem(value, help=words) for value, words in fitting if value]


def _goal_help(goal: Goal) -> str:
    text = "" if goal.text is None else printable(goal.text, _MAX_TEXT)
    return f"{goal.state.name} {text}"


def _voice_help(voice: JsonObject, field: str) -> str:
    parts = [printable(str(voice.get(each) or ""), _MAX_TEXT) for each in ("name", "language") if each != field]
    return ", ".join(filter(None, parts)) or "voice"
