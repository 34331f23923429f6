"""Shell completion for bash, zsh and fish.

The values come from the server that the command would use. If the server doesn't answer quickly, no values are offered.
Completion never prints an error.

We use click's parser, but not its scripts. click's scripts pass on the words that the shell has split. But bash also
splits at `:` and `=`, which ids may contain, and values with a space, a comma, a quote or a `*` are garbled when they
are passed back. Our scripts send the line up to the cursor as it was typed, and get back quoted values that they can
insert unchanged. The scripts are files in this directory, which `talk completion` prints.

An option or an argument is completed by the function of this module that is named in its `completion` field. This
function takes the common options and the incomplete word, and returns the possible values, each with a help text.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem, ShellComplete, split_arg_string

from talkcli.cli.show import show
from talkcli.errors import EXIT_ERROR, EXIT_OK, TalkError
from talkcli.goals.options import is_neural
from talkcli.polling import run_blocking
from talkcli.protocol.events import unfinished
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Iterable

    from talkcli.cli.show import CommonOptions
    from talkcli.goals.goal import Goal, JsonObject
    from talkcli.protocol.events import ServerStatus

    #: Completion values, each with its help text.
    Offers = list[tuple[str, str]]

#: The time limit for the server's answer. It is short because the user is waiting for completions.
COMPLETION_TIMEOUT_S = 0.5
#: The maximum number of ended goals to offer.
_MAX_ENDED_GOALS = 100
#: Maximum length of a text or a name in the description of a completion.
_HELP_TEXT_CHARS = 60
#: The file names of the completion scripts.
_SCRIPTS = {"bash": "talk.bash", "zsh": "_talk", "fish": "talk.fish"}
#: Matches a character that must be escaped in bash.
_BASH_SPECIAL = re.compile(r"[^\w@%+=:,./-]")


def print_completions(talk: click.Command, options: CommonOptions) -> int:
    """Print the completions that the shell's completion script requests. Return the exit code."""
    try:
        click.echo("\n".join(_completion_lines(talk, options)).encode())
    except Exception:
        if os.environ.get("TALK_DEBUG"):
            raise
        return EXIT_ERROR
    return EXIT_OK


def _completion_lines(talk: click.Command, options: CommonOptions) -> list[str]:
    """Return the completions for the command line in COMP_WORDS, formatted for the shell."""
    line, shell = os.environ["COMP_WORDS"], os.environ["_TALK_COMPLETE"].removesuffix("_complete")
    words = split_arg_string(line)
    # If the next character would start a new word, the word to complete is empty.
    if len(split_arg_string(f"{line}x")) > len(words):
        words.append("")
    found = ShellComplete(talk, {"obj": options}, "talk", "_TALK_COMPLETE").get_completions(words[1:-1], words[-1])
    format_line = {"bash": _format_for_bash, "zsh": _format_for_zsh, "fish": _format_for_fish}[shell]
    return ["file" if each.type == "file" else format_line(words[-1], each.value, each.help) for each in found]


def _format_for_bash(incomplete: str, value: str, _: str | None) -> str:
    """Format and quote the part of a value that bash inserts.

    bash replaces the text in COMP_CWORD, which may be only the last part of the word.
    """
    typed, quote = _last_word(os.environ["COMP_WORDS"])
    replaced = os.environ["COMP_CWORD"]
    if replaced in {":", "="}:
        replaced = ""  # after `sudo`, bash passes the separator instead of an empty word
    kept = "".join(split_arg_string(typed.removesuffix(replaced)))
    return f"plain,{_quote_for_bash(_with_flag(value, incomplete).removeprefix(kept), quote)}"


def _format_for_zsh(_: str, value: str, help_text: str | None) -> str:
    """Format a value and its help text for zsh.

    zsh quotes the value itself.
    """
    if not help_text:
        return f"plain,{value}"
    value, help_text = (each.replace("\\", "\\\\") for each in (value, help_text))
    value = value.replace(":", "\\:")
    return f"described,{value}:{help_text}"


def _format_for_fish(incomplete: str, value: str, help_text: str | None) -> str:
    """Format a value and its help text for fish.

    fish quotes the value itself.
    """
    return f"plain,{_with_flag(value, incomplete)}" + (f"\t{help_text}" if help_text else "")


def completion(_: CommonOptions, shell: str) -> None:
    """Print the completion script for a shell."""
    with open(os.path.join(os.path.dirname(__file__), _SCRIPTS[shell]), encoding="utf-8") as file:
        show(file.read().rstrip("\n"))


def _last_word(line: str) -> tuple[str, str]:
    """Return the last word of a line and its unclosed quotation mark, if any."""
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


def _with_flag(value: str, incomplete: str) -> str:
    """Return the value, or `--option=VALUE` if the user has typed the option with an equals sign."""
    option, equals, _ = incomplete.partition("=")
    return f"{option}={value}" if equals and option.startswith("-") else value


def _quote_for_bash(value: str, open_quote: str) -> str:
    """Escape a value that bash inserts, possibly after an unclosed quotation mark.

    `open_quote` is this quotation mark, or an empty string.
    """
    if open_quote == "'":
        return value.replace("'", "'\\''")
    if open_quote:
        return re.sub(r'(["\\$`])', r"\\\1", value)
    return _BASH_SPECIAL.sub(lambda found: f"\\{found[0]}", value)


def complete(completer_name: str, options: CommonOptions, incomplete: str) -> list[CompletionItem[str]]:
    """Return the completions for a partially typed word.

    Args:
        completer_name: the name of a function in this module, or "files" to let the shell complete file names.
        options: the common options that were typed before the word.
        incomplete: the part of the word that has been typed.

    Returns:
        The matching values, without duplicates. The list is empty after an error, for example if there is no server.
    """
    if completer_name == "files":
        return [CompletionItem(incomplete, type="file")]
    options.connect_timeout = None
    try:
        offers: Offers = globals()[completer_name](options, incomplete)
    except (TalkError, OSError, ValueError):
        return []
    matching: dict[str, str] = {}
    for value, words in offers:
        if _matches(value, incomplete):
            matching.setdefault(value, words)
    return [CompletionItem(value, help=words) for value, words in matching.items()]


def _matches(value: str, incomplete: str) -> bool:
    """Return whether a value begins with the typed text and is safe to print."""
    # Leave out values with invisible characters, because the shell would write them to the terminal unescaped.
    return bool(value) and value.startswith(incomplete) and value.isprintable()


def goal_ids(options: CommonOptions, incomplete: str) -> Offers:
    """Return the ids of unfinished goals as completions."""
    status = _request_status(options)
    return _offer_ids(unfinished(status), status.server, incomplete)


def known_ids(options: CommonOptions, incomplete: str) -> Offers:
    """Return the ids of unfinished and recent goals as completions."""
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        status, ended = client.status(), client.log(_MAX_ENDED_GOALS, history=False)
    return _offer_ids([*unfinished(status), *reversed(ended)], status.server, incomplete)


def keys(options: CommonOptions, _: str) -> Offers:
    """Return the keys of unfinished and recent goals as completions."""
    status = _request_status(options)
    return _offer_keys([*unfinished(status), *reversed(status.recent)])


def unfinished_keys(options: CommonOptions, _: str) -> Offers:
    """Return the keys of unfinished goals as completions."""
    return _offer_keys(unfinished(_request_status(options)))


def voices(options: CommonOptions, incomplete: str) -> Offers:
    """Return completions for a voice: languages, ids or names, whichever match first.

    Neural voices are always offered by id, because there are few of them and users select them by id.
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


def sounds(options: CommonOptions, _: str) -> Offers:
    """Return the names of sounds as completions."""
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        return [(each, "sound") for each in client.sounds()]


def robots(options: CommonOptions, _: str) -> Offers:
    """Return the names and groups of online robots as completions."""
    broker = options.broker()
    from talkcli.fleet import topics
    from talkcli.fleet.desk.watch import read_robots

    found = run_blocking(read_robots(broker, COMPLETION_TIMEOUT_S, with_status=False))
    online = [each.presence for each in found if each.presence.online]
    members = Counter(f"@{group}" for each in online for group in {*each.groups} if not topics.name_fault(group))
    return [
        *((each.name, ", ".join(map(_shorten, each.groups)) or "robot") for each in online),
        *((name, f"{count} robot{'' if count == 1 else 's'}") for name, count in sorted(members.items())),
    ]


def players(_: CommonOptions, __: str) -> Offers:
    """Return the names of the players as completions."""
    from talkcli.engine.players import PLAYERS

    return [(name, each.description) for name, each in PLAYERS.items()]


def _request_status(options: CommonOptions) -> ServerStatus:
    """Request the server's status with a time limit of half a second. Return the status."""
    with options.connect(COMPLETION_TIMEOUT_S) as client:
        return client.status()


def _offer_ids(goals: Iterable[Goal], server: JsonObject, incomplete: str) -> Offers:
    """Return the ids of goals as completions, including this server's short ids if digits were typed."""
    own = f"{server.get('boot')}-" if incomplete.isascii() and incomplete.isdecimal() else ""
    return [(name, _goal_help(each)) for each in goals for name in dict.fromkeys((each.id.removeprefix(own), each.id))]


def _offer_keys(goals: Iterable[Goal]) -> Offers:
    """Return the keys of goals as completions."""
    return [(each.key, _goal_help(each)) for each in goals if each.key is not None]


def _shorten(text: str) -> str:
    """Escape and shorten a text for use in a help text."""
    return printable(text, _HELP_TEXT_CHARS)


def _goal_help(goal: Goal) -> str:
    """Return the help text for a goal's id or key."""
    return f"{goal.state.name} {_shorten(goal.text or '')}"


def _voice_help(voice: JsonObject, field: str) -> str:
    """Return the name and the language of a voice as a help text. Leave out the given field."""
    parts = [_shorten(str(voice.get(each) or "")) for each in ("name", "language") if each != field]
    return ", ".join(filter(None, parts)) or "voice"
