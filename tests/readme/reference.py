"""The README's list of options, made from click's declarations: `python -m tests.readme.reference` writes it.

A test shows that the README has it as it is now.
"""

from __future__ import annotations

import re

import click

from talkcli.cli.commands import COMMANDS, talk
from tests.wire.readme import ROOT

README = ROOT / "README.md"
BEGIN, END = "<!-- options: begin -->\n", "<!-- options: end -->\n"


def options() -> str:
    """Return the list: first what every command has, then each command's own."""
    context = click.Context(talk, info_name="talk")
    shared = {each.name for each in talk.params}
    parts = ["### Of all commands\n", _table(talk.params, context)]
    for name in COMMANDS:
        command = talk.get_command(context, name)
        assert command
        own = [each for each in command.params if each.name not in shared]
        rows = _table(own, click.Context(command, parent=context, info_name=name))
        if rows:
            parts += [f"### {name}\n", rows]
    return "\n".join(parts)


def current(text: str) -> str:
    """Return the README's text with the list as it is now."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{options()}\n{END}{after}"


def _table(parameters: list[click.Parameter], context: click.Context) -> str:
    rows = [each.get_help_record(context) for each in parameters if isinstance(each, click.Option)]
    lines = [f"| `{_cell(left)}` | {_words(right)} |\n" for left, right in filter(None, rows)]
    return "".join(["| option | meaning |\n| --- | --- |\n", *lines]) if lines else ""


def _words(text: str) -> str:
    """Return help as it stands in a table: what is typed, and names of variables, as code; no link made of brackets."""
    text = re.sub(r"(?<![\w`'-])(--[a-z][a-z-]*)", r"`\1`", _cell(text))
    text = re.sub(r"'(-|default|talk [^']*|aplay [^']*|pactl [^']*|pw-cli [^']*)'", r"`\1`", text)
    text = re.sub(r"\b(TALK_[A-Z]+)\b", r"`\1`", text)
    return re.sub(r"\s+", " ", text).replace("<", "&lt;").replace("*", "\\*")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    README.write_text(current(README.read_text(encoding="utf-8")), encoding="utf-8")
