"""How click shows help, and what it tells of a command line that is wrong, in talk's own words: what, and what next.

It knows nothing of any one command: those bring their examples and exit codes along.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from talkcli.cli.values import nearest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from click.shell_completion import CompletionItem

    from talkcli.cli.command import Codes

#: What a command is called elsewhere, where that isn't near to its name here.
_ELSEWHERE = {
    "check": "doctor",
    "follow": "watch",
    "history": "log",
    "kill": "cancel",
    "queue": "status",
    "speak": "say",
    "start": "serve",
    "stop": "cancel",
    "unpause": "resume",
}


def with_short_help(options: list[CompletionItem]) -> list[CompletionItem]:
    """Have a shell show of an option's help what it has room for beside it: what stands before its first stop."""
    for each in options:
        each.help = re.split(r"[.;](?:\s|$)", each.help or "", maxsplit=1)[0] + "."
    return options


def write_examples(examples: str, formatter: click.HelpFormatter) -> None:
    """Write a section of command lines, as they are."""
    with formatter.section("Examples"):
        write_lines(examples, formatter)


def write_lines(text: str, formatter: click.HelpFormatter) -> None:
    """Write lines as they are, indented as the formatter is at this moment."""
    for line in text.strip().splitlines():
        formatter.write(f"{'':{formatter.current_indent}}{line.strip()}\n")


def write_options(command: click.Command, ctx: click.Context, formatter: click.HelpFormatter, shared: str) -> None:
    """Write the command's own options, and then, under the heading `shared`, those that all have."""
    own: list[tuple[str, str]] = []
    common: list[tuple[str, str]] = []
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record and isinstance(parameter, click.Option):
            (own if parameter.expose_value else common).append(record)
    for heading, records in (("Options", own), (shared, common)):
        if records:
            with formatter.section(heading):
                formatter.write_dl(records)


def write_exit_codes(exit_codes: Codes, formatter: click.HelpFormatter) -> None:
    """Write a section of exit codes, in their order."""
    rows = sorted(exit_codes.items(), key=lambda row: row[0] if isinstance(row[0], int) else 128)
    with formatter.section("Exit codes"):
        formatter.write_dl([(str(code), words) for code, words in rows])


def unknown_command(words: list[str], commands: Iterable[str]) -> str:
    """Return what is said of a command that there isn't: which was meant, or how to speak these words."""
    name, commands = words[0], list(commands)
    if name.lower() == "help":
        meant = next((each for each in words[1:] if each in commands), None)
        return f"no such command '{name}': write 'talk{f' {meant}' if meant else ''} --help'"
    near = _ELSEWHERE.get(name.lower()) or nearest(name, commands)
    return f"no such command '{name}': " + (
        f"did you mean '{near}'?" if near else f"to speak it, write: talk say {_quoted(' '.join(words))}"
    )


def _quoted(text: str) -> str:
    """Return a text as a shell takes it, in the quotes that people write where these do."""
    import shlex

    return shlex.quote(text) if any(each in text for each in '"$`\\!') else f'"{text}"'


def told(error: click.ClickException) -> str:
    """Return what is wrong with a command line, without the next step."""
    if isinstance(error, click.NoSuchOption):
        # Without the dashes, which make any two of them alike.
        near = nearest(error.option_name.lstrip("-"), [each.lstrip("-") for each in error.possibilities or ()])
        return f"no such option '{error.option_name}'" + (f": did you mean '--{near}'?" if near else "")
    if isinstance(error, click.MissingParameter) and error.param and isinstance(error.param.type, click.Choice):
        return f"{error.param.metavar} is missing: one of {', '.join(error.param.type.choices)}"
    words = error.format_message().rstrip(".")
    if isinstance(error, click.BadParameter):
        option, colon, wrong = words.removeprefix("Invalid value for ").partition(": ")
        return option.replace("'", "") + colon + wrong
    return words if words[:2].isupper() else words[:1].lower() + words[1:]
