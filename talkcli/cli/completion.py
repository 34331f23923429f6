"""Completion: the values that a shell offers for a word, and the exchange with bash, zsh and fish.

The values come from the server that the command would use. If it doesn't answer quickly, nothing is offered. Completion
never prints an error.

The scripts and their output format are our own, on top of click's classes. click's scripts pass on the words that the
shell has split. bash also splits at `:` and `=`, which ids may contain, and values with a space, a comma, a quote or a
`*` don't survive the way back. Here the shell sends the line up to the cursor as it was typed, and gets back quoted
values that start where it inserts them. The scripts are files in this directory, which `talk completion` prints.

An option or an argument names its completer in its row. A completer is a function of this module that takes the common
options and the incomplete word, and returns the values to choose from, each with its help.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem, ShellComplete, add_completion_class, split_arg_string

from talkcli.cli.show import show
from talkcli.errors import TalkError
from talkcli.goals.options import is_neural
from talkcli.protocol.events import unfinished
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import ClassVar

    from talkcli.cli.show import CommonOptions
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.events import ServerStatus

    #: Values that a shell may offer, each with its help.
    Offers = list[tuple[str, str]]

#: How long the server may take to answer, because a person has pressed a key and is waiting.
COMPLETION_TIMEOUT_S = 0.5
#: How many ended goals are offered at most.
_MAX_ENDED_GOALS = 100
#: The length at which the text of a goal, or a name, is cut in the help of a value.
_HELP_TEXT_CHARS = 60
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
        # If one more character would begin a new word, the word to complete is still empty.
        if len(split_arg_string(f"{line}x")) > len(words):
            words.append("")
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem[str]) -> str:
        return "file" if item.type == "file" else self.line(item.value, item.help)

    def line(self, value: str, words: str | None) -> str:  # noqa: ARG002
        """Return the line that tells the shell to offer a value. `words` is the value's help."""
        return f"plain,{value}"


@add_completion_class
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


@add_completion_class
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


@add_completion_class
class FishCompletion(_LineCompletion):
    """Completion for fish, which quotes by itself and takes help after a tab."""

    name = "fish"
    script = "talk.fish"

    def line(self, value: str, words: str | None) -> str:
        typed, _ = _last_word(os.environ["COMP_WORDS"])
        return f"plain,{_with_flag(value, typed)}" + (f"\t{words}" if words else "")


def completion(_: CommonOptions, shell: str) -> None:
    """Print the completion script of a shell."""
    shell_class = click.shell_completion.get_completion_class(shell)
    assert shell_class
    talk = click.get_current_context().find_root().command
    show(shell_class(talk, {}, "talk", "_TALK_COMPLETE").source().rstrip("\n"))


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
    """Return a value, with the flag in front of it if the user is typing --option=VALUE."""
    word = "".join(split_arg_string(typed))
    option, equals, _ = word.partition("=")
    return f"{option}={value}" if equals and option.startswith("-") else value


def _quote_for_bash(value: str, quote: str) -> str:
    """Return a value quoted for bash. `quote` is the quotation mark that is still open; empty if there is none."""
    if quote == "'":
        return value.replace("'", "'\\''")
    if quote:
        return re.sub(r'(["\\$`])', r"\\\1", value)
    return _BASH_SPECIAL.sub(lambda found: f"\\{found[0]}", value)


def complete(completer: str, options: CommonOptions, incomplete: str) -> list[CompletionItem[str]]:
    """Return the completions of an incomplete word.

    Args:
        completer: the name of the completer; "files" lets the shell complete a file.
        options: the common options that were typed before the word.
        incomplete: the beginning of the word.

    Returns:
        The matching values, each once. After an error, for example without a server, there are none.
    """
    if completer == "files":
        return [CompletionItem(incomplete, type="file")]
    options.connect_timeout = None
    try:
        offers: Offers = globals()[completer](options, incomplete)
    except (TalkError, OSError, ValueError):
        return []
    matching: dict[str, str] = {}
    for value, words in offers:
        if _matches(value, incomplete):
            matching.setdefault(value, words)
    return [CompletionItem(value, help=words) for value, words in matching.items()]


def _matches(value: str, incomplete: str) -> bool:
    # A value with invisible characters couldn't be recognised, and would reach the terminal unescaped.
    return bool(value) and value.startswith(incomplete) and value.isprintable()


def goal_ids(options: CommonOptions, incomplete: str) -> Offers:
    """Offer the ids of unfinished goals."""
    status = _status(options)
    return _offer_ids(unfinished(status), status, incomplete)


def known_ids(options: CommonOptions, incomplete: str) -> Offers:
    """Offer the ids of all goals: first those of unfinished goals, then the newest."""
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        status, ended = client.status(), client.log(_MAX_ENDED_GOALS)
    return _offer_ids([*unfinished(status), *reversed(ended)], status, incomplete)


def keys(options: CommonOptions, _: str) -> Offers:
    """Offer the keys of unfinished and recent goals."""
    status = _status(options)
    return _offer_keys([*unfinished(status), *reversed(status.recent)])


def unfinished_keys(options: CommonOptions, _: str) -> Offers:
    """Offer the keys of unfinished goals."""
    return _offer_keys(unfinished(_status(options)))


def voices(options: CommonOptions, incomplete: str) -> Offers:
    """Offer the languages of the voices. If none of them matches, offer the ids, or else the names.

    Neural voices are few and are called by their ids, so these ids are offered together with the languages.
    """
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        found = client.voices()
    offers: Offers = []
    for field in ("language", "id", "name"):
        named = [("id" if is_neural(str(each.get("id"))) else field, each) for each in found]
        offers = [(str(each.get(name) or ""), _voice_help(each, name)) for name, each in named]
        if any(_matches(value, incomplete) for value, _ in offers):
            break
    return offers


def robots(options: CommonOptions, _: str) -> Offers:
    """Offer the robots of the fleet that are online, and their groups."""
    broker = options.broker()
    from talkcli.fleet import topics
    from talkcli.fleet.desk.watch import read_robots

    found = read_robots(broker, COMPLETION_TIMEOUT_S, with_status=False)
    online = [each.presence for each in found if each.presence.online]
    members = Counter(f"@{group}" for each in online for group in {*each.groups} if not topics.name_fault(group))
    return [
        *((each.name, ", ".join(map(_shorten, each.groups)) or "robot") for each in online),
        *((name, f"{count} robot{'' if count == 1 else 's'}") for name, count in sorted(members.items())),
    ]


def players(_: CommonOptions, __: str) -> Offers:
    """Offer the names of the players."""
    from talkcli.engine.players import PLAYERS

    return [(name, each.description) for name, each in PLAYERS.items()]


def _status(options: CommonOptions) -> ServerStatus:
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        return client.status()


def _offer_ids(goals: Iterable[Goal], status: ServerStatus, incomplete: str) -> Offers:
    """Offer the ids of goals. If digits were typed, also offer the bare numbers of this server's goals."""
    own = f"{status.server.get('boot')}-" if incomplete.isascii() and incomplete.isdecimal() else ""
    return [(name, _goal_help(each)) for each in goals for name in dict.fromkeys((each.id.removeprefix(own), each.id))]


def _offer_keys(goals: Iterable[Goal]) -> Offers:
    return [(each.key, _goal_help(each)) for each in goals if each.key is not None]


def _shorten(text: str) -> str:
    return printable(text, _HELP_TEXT_CHARS)


def _goal_help(goal: Goal) -> str:
    return f"{goal.state.name} {_shorten(goal.text or '')}"


def _voice_help(voice: JsonObject, field: str) -> str:
    parts = [_shorten(str(voice.get(each) or "")) for each in ("name", "language") if each != field]
    return ", ".join(filter(None, parts)) or "voice"
