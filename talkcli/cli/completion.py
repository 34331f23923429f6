"""Completion: the values that a shell offers for a word, and the exchange with bash, zsh and fish.

The values come from the server that the command would use. If it doesn't answer quickly, nothing is offered. Completion
never prints an error.

The scripts and their output format are our own, on top of click's classes. click's scripts pass on the words that the
shell has split. bash also splits at `:` and `=`, which ids may contain, and values with a space, a comma, a quote or a
`*` don't survive the way back. Here the shell sends the line up to the cursor as it was typed, and gets back quoted
values that start where it inserts them. The scripts are files in this directory, which `talk completion` prints.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING, TypeVar

import click
from click.shell_completion import CompletionItem, ShellComplete, add_completion_class, split_arg_string

from talkcli.cli.show import show
from talkcli.errors import TalkError
from talkcli.goals.options import is_neural
from talkcli.protocol.events import ServerStatus, unfinished
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import ClassVar

    from talkcli.cli.show import CommonOptions
    from talkcli.client.client import Client
    from talkcli.goals.goal import Goal, JsonObject

    Items = list[CompletionItem[str]]

_Answer = TypeVar("_Answer")

#: How long the server may take to answer, because a person has pressed a key and is waiting.
COMPLETION_TIMEOUT_S = 0.5
#: How many goals that have ended are offered.
_MAX_ENDED_GOALS = 100
#: Longer texts are cut in the help of a value.
_HELP_TEXT_CHARS = 60
#: Used if no server answers.
_NO_STATUS = ServerStatus({}, None, (), ())

#: Characters that bash needs escaped. Letters and digits of all scripts can stay as they are.
_BASH_SPECIAL = re.compile(r"[^\w@%+=:,./-]")


class _LineCompletion(ShellComplete):
    """Completion for a shell that sends the line up to the cursor in COMP_WORDS."""

    #: the name of the script's file
    script: ClassVar[str]

    def source(self) -> str:
        """Return the script that sets up completion."""
        with open(os.path.join(os.path.dirname(__file__), self.script), encoding="utf-8") as file:
            return file.read()

    def get_completion_args(self) -> tuple[list[str], str]:
        line = os.environ["COMP_WORDS"]
        words = split_arg_string(line)
        # Another character shows whether it would begin a new word or continue the last one.
        if len(split_arg_string(f"{line}x")) > len(words):
            words.append("")
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem[str]) -> str:
        return "file" if item.type == "file" else self.line(item.value, item.help)

    def line(self, value: str, words: str | None) -> str:  # noqa: ARG002
        """Return the line for a value: its kind and the text to insert. `words` is its help."""
        return f"plain,{value}"


class BashCompletion(_LineCompletion):
    """Completion for bash, which replaces the text in COMP_CWORD and doesn't quote."""

    name = "bash"
    script = "talk.bash"

    def line(self, value: str, words: str | None) -> str:  # noqa: ARG002
        typed, quote = _last_word(os.environ["COMP_WORDS"])
        replaced = os.environ["COMP_CWORD"]
        if replaced in {":", "="}:
            replaced = ""  # bash-completion, which is used after sudo, passes the separator if nothing follows it
        stays = typed.removesuffix(replaced) if replaced else typed
        kept = "".join(split_arg_string(stays))
        return f"plain,{_quote_for_bash(_with_flag(value, typed).removeprefix(kept), quote)}"


class ZshCompletion(_LineCompletion):
    """Completion for zsh, which quotes by itself and takes help after a colon."""

    name = "zsh"
    script = "_talk"

    def line(self, value: str, words: str | None) -> str:
        if not words:
            return super().line(value, words)
        value, words = (each.replace("\\", "\\\\") for each in (value, words))
        value = value.replace(":", "\\:")
        return f"described,{value}:{words}"


class FishCompletion(_LineCompletion):
    """Completion for fish, which quotes by itself and takes help after a tab."""

    name = "fish"
    script = "talk.fish"

    def line(self, value: str, words: str | None) -> str:
        typed, _ = _last_word(os.environ["COMP_WORDS"])
        return f"plain,{_with_flag(value, typed)}" + (f"\t{words}" if words else "")


SHELL_COMPLETIONS: dict[str, type[ShellComplete]] = {
    each.name: each for each in (BashCompletion, ZshCompletion, FishCompletion)
}


def completion(_: CommonOptions, shell: str) -> None:
    """Print the completion script of a shell."""
    talk = click.get_current_context().find_root().command
    show(SHELL_COMPLETIONS[shell](talk, {}, "talk", "_TALK_COMPLETE").source().rstrip("\n"))


def register() -> None:
    """Make click use these classes."""
    for each in SHELL_COMPLETIONS.values():
        add_completion_class(each)


def _last_word(line: str) -> tuple[str, str]:
    """Return the last word of a line as it was typed, and the quote that is still open in it."""
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


def _with_flag(value: str, typed: str) -> str:
    """Return a value together with its flag if --option=VALUE is being typed."""
    word = "".join(split_arg_string(typed))
    option, equals, _ = word.partition("=")
    return f"{option}={value}" if equals and option.startswith("-") else value


def _quote_for_bash(value: str, quote: str) -> str:
    """Return the value so that bash reads it as one word within an open quote."""
    if quote == "'":
        return value.replace("'", "'\\''")
    if quote:
        return re.sub(r'(["\\$`])', r"\\\1", value)
    return _BASH_SPECIAL.sub(lambda found: f"\\{found[0]}", value)


def goal_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete the id of an unfinished goal."""
    status = _status(context)
    return _id_items(unfinished(status), status, incomplete)


def known_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete the id of any goal. Unfinished goals come first, then the newest."""
    status, ended = _ask_server(context, lambda client: (client.status(), client.log(_MAX_ENDED_GOALS))) or (
        _NO_STATUS,
        [],
    )
    return _id_items([*unfinished(status), *reversed(ended)], status, incomplete)


def keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete the key of an unfinished or recent goal."""
    status = _status(context)
    return _key_items([*unfinished(status), *reversed(status.recent)], incomplete)


def unfinished_keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete the key of an unfinished goal."""
    return _key_items(unfinished(_status(context)), incomplete)


def voices(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete a voice by its language, or by its id or name if no language starts with the word.

    Neural voices are few and are called by their ids, so these ids are offered together with the languages.
    """
    found = _ask_server(context, lambda client: client.voices()) or []
    for field in ("language", "id", "name"):
        fields = [("id" if is_neural(str(each.get("id"))) else field, each) for each in reversed(found)]
        offered = {str(each.get(name) or ""): _voice_help(each, name) for name, each in fields}
        items = _matching_items(reversed(offered.items()), incomplete)
        if items:
            return items
    return []


def robots(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Complete an online robot of the fleet, or a group of such robots."""
    options: CommonOptions = context.find_root().obj
    try:
        broker = options.broker()
        from talkcli.fleet import topics
        from talkcli.fleet.desk.watch import read_robots

        found = read_robots(broker, COMPLETION_TIMEOUT_S, with_status=False)
    except (TalkError, OSError, ValueError):
        return []
    online = [each.presence for each in found if each.presence.online]
    offered = [(each.name, ", ".join(map(_shorten, each.groups)) or "robot") for each in online]
    members = Counter(f"@{group}" for each in online for group in {*each.groups} if not topics.name_fault(group))
    offered += [(name, f"{count} robot{'' if count == 1 else 's'}") for name, count in sorted(members.items())]
    return _matching_items(offered, incomplete)


def files(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Let the shell complete a file."""
    return [CompletionItem(incomplete, type="file")]


def players(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Complete the name of a player."""
    from talkcli.engine.players import PLAYERS

    return _matching_items([(name, each.about) for name, each in PLAYERS.items()], incomplete)


def _ask_server(context: click.Context, question: Callable[[Client], _Answer]) -> _Answer | None:
    """Ask the server something, and return the answer, or None after any error."""
    options: CommonOptions = context.find_root().obj  # with --socket if it was typed before
    options.connect_timeout = None
    try:
        with options.connect(COMPLETION_TIMEOUT_S) as client:
            return question(client)
    except (TalkError, OSError, ValueError):
        return None


def _status(context: click.Context) -> ServerStatus:
    return _ask_server(context, lambda client: client.status()) or _NO_STATUS


def _id_items(goals: Iterable[Goal], status: ServerStatus, incomplete: str) -> Items:
    """Return the ids. If digits were typed, also return the bare numbers of this server's goals."""
    own = f"{status.server.get('boot')}-"
    digits = incomplete.isascii() and incomplete.isdecimal()
    offered = []
    for each in goals:
        number = each.id.removeprefix(own)
        names = [number, each.id] if digits and number != each.id else [each.id]
        offered += [(name, _goal_help(each)) for name in names]
    return _matching_items(offered, incomplete)


def _key_items(goals: Iterable[Goal], incomplete: str) -> Items:
    offered: dict[str, str] = {}
    for each in goals:
        if each.key is not None:
            offered.setdefault(each.key, _goal_help(each))
    return _matching_items(offered.items(), incomplete)


def _matching_items(offered: Iterable[tuple[str, str]], incomplete: str) -> Items:
    # A value with invisible characters couldn't be recognised, and would reach the terminal unescaped.
    fitting = ((value, words) for value, words in offered if value.startswith(incomplete) and value.isprintable())
    return [CompletionItem(value, help=words) for value, words in fitting if value]


def _shorten(text: str) -> str:
    return printable(text, _HELP_TEXT_CHARS)


def _goal_help(goal: Goal) -> str:
    return f"{goal.state.name} {_shorten(goal.text or '')}"


def _voice_help(voice: JsonObject, field: str) -> str:
    parts = [_shorten(str(voice.get(each) or "")) for each in ("name", "language") if each != field]
    return ", ".join(filter(None, parts)) or "voice"
