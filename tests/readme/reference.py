"""Tables in the documents that are generated from the code: options, requests and reasons.

`python -m tests.readme.reference` updates them. A test checks that they are current.
"""

from __future__ import annotations

import json
import re

import click

from talkcli.cli.click_app import talk
from talkcli.cli.commands import COMMANDS
from talkcli.goals.options import IDS, Option, Set
from talkcli.goals.reasons import Reason
from talkcli.protocol.requests import REQUEST_TYPES
from tests.support.documents import COMMAND_LINE, WIRE

#: The name and the note for options that all commands have.
_ALL, _ANYWHERE = "all", "before the command; all but `--version` also after it"


def options() -> str:
    """Return the table of options: first those of all commands, then those of each command."""
    context = click.Context(talk, info_name="talk")
    shared = {parameter.name for parameter in talk.params}
    lines = ["| command | option | meaning |\n| --- | --- | --- |\n", f"| {_ALL} | | {_ANYWHERE} |\n"]
    lines += _rows(talk.params, context)
    for name, row in COMMANDS.items():
        command = talk.get_command(context, name)
        assert command
        lines.append(f"| `{name}` | | {_markdown(row.summary)} |\n")
        own = [parameter for parameter in command.params if parameter.name not in shared]
        lines += _rows(own, click.Context(command, parent=context, info_name=name))
    return "".join(lines)


def requests() -> str:
    """Return the table of requests and fields."""
    lines = ["| request | field | type | default | meaning |\n| --- | --- | --- | --- | --- |\n"]
    for kind, request in REQUEST_TYPES.items():
        meaning = request.meaning.removesuffix(".")
        lines.append(f"| `{kind}` | | | | {meaning[0].lower()}{meaning[1:]} |\n")
        lines += [_field(option, changes=request is Set) for option in request.options]
    return "".join(lines)


def reasons() -> str:
    """Return the table of reasons."""
    rows = (f"| `{reason}` | {', '.join(map(str, reason.states))} | {reason.meaning} |\n" for reason in Reason)
    return "".join(["| reason | state | why |\n| --- | --- | --- |\n", *rows])


def _field(option: Option, *, changes: bool) -> str:
    """Return the row of a field. `changes` means that an absent field keeps its setting."""
    null = "null" if option.default is None else json.dumps(option.default)
    default = f"`{option.default}`" if option.default and isinstance(option.default, str) else null
    meaning = (changes and option.setting and option.setting.meaning) or option.meaning
    servers = option.default is None and (option.setting or option.for_engine)
    absent = "" if changes else option.default_words or ("the server's" if servers else "")
    return f"| | `{option.name}` | {_values(option)} | {absent or default} | {meaning} |\n"


def _values(option: Option) -> str:
    if option.kind is IDS:
        return f"{option.kind.name} {option.form}, or null"
    form = option.range or option.form
    return option.kind.name + (" or null" if option.default is None else "") + (f", {form}" if form else "")


#: The document and the generator of each table, by the name in the markers around it.
TABLES = {"options": (COMMAND_LINE, options), "requests": (WIRE, requests), "reasons": (WIRE, reasons)}


def current(name: str) -> str:
    """Return the text of the document with an up-to-date table."""
    document, make = TABLES[name]
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->\n"
    before, rest = document.text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n{make()}\n{end}{after}"


def _rows(parameters: list[click.Parameter], context: click.Context) -> list[str]:
    records = [parameter.get_help_record(context) for parameter in parameters if isinstance(parameter, click.Option)]
    return [f"| | `{_cell(left)}` | {_markdown(right)} |\n" for left, right in filter(None, records)]


def _markdown(text: str) -> str:
    """Return a help text for a table cell, with commands, options and variables as code, and escaped Markdown."""
    quoted = r"'(-|default|talk [^']*|aplay [^']*|pactl [^']*|pw-cli [^']*)'"
    text = re.sub(rf"{quoted}|(?<![\w`'-])(--[a-z][a-z-]*)", lambda match: f"`{match[1] or match[2]}`", _cell(text))
    text = re.sub(r"\b(TALK_[A-Z]+)\b", r"`\1`", text)
    return re.sub(r"\s+", " ", text).replace("<", "&lt;").replace("*", "\\*")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    for _name, (_document, _) in TABLES.items():
        _document.text = current(_name)  # the next table may be in the same document
        _document.path.write_text(_document.text, encoding="utf-8")
