"""Makes `plain_table`, what is known of commands without click, from click's own declarations.

`python -m talkcli.cli.tabulate` writes it; a test shows that it is up to date.
"""

from __future__ import annotations

import math
from pathlib import Path
from pprint import pformat
from typing import TYPE_CHECKING

import click

from talkcli.cli.commands import talk

if TYPE_CHECKING:
    from collections.abc import Iterable

TABLE = Path(__file__).with_name("plain_table.py")
#: Commands that send one request and end: scripts call them all the time.
_COMMANDS = ("say", "wait", "cancel", "status", "log", "voices", "set", "pause", "resume")
#: Options of theirs that need more than a server: they are left to click.
_LEFT = {"lines", "output"}

_HEAD = '''"""What is known of some commands without click. Made by `python -m talkcli.cli.tabulate`: don't edit it.

An option: its name for click, and True or False, the value of a flag; or "text"; or "int" or "float" and its limits.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any

# fmt: off
'''


def table() -> str:
    """Return the module's text."""
    common = {each.name or "" for each in talk.params if not each.expose_value}
    commands = {name: _command(name, common) for name in _COMMANDS}
    parts = {"COMMON": _options(each for each in talk.params if each.name in common), "COMMANDS": commands}
    shown = {name: pformat(each, width=110, sort_dicts=False).replace("'", '"') for name, each in parts.items()}
    return _HEAD + "".join(f"{name}: dict[str, Any] = (\n{each}\n)\n" for name, each in shown.items())


def _command(name: str, common: set[str]) -> dict[str, object]:
    context = click.Context(talk, info_name="talk")
    command = talk.get_command(context, name)
    assert command
    argument = next((each for each in command.params if isinstance(each, click.Argument)), None)
    options = [each for each in command.params if isinstance(each, click.Option) and each.name not in common]
    return {
        "argument": (argument.name, argument.nargs) if argument else None,
        "options": _options(each for each in options if each.name not in _LEFT),
        "defaults": {each.name: _default(each, context) for each in options},
        "environment": {each.name: each.envvar for each in options if each.envvar},
    }


def _options(options: Iterable[click.Parameter]) -> dict[str, object]:
    """Return the options by each of their spellings."""
    found: dict[str, object] = {}
    for option in options:
        if not isinstance(option, click.Option) or option.name in {"help", "version"}:
            continue
        kind = (True,) if option.is_flag else _kind(option.type)
        found |= dict.fromkeys(option.opts, (option.name, *kind))
        found |= dict.fromkeys(option.secondary_opts, (option.name, False))
    return found


def _kind(kind: object) -> tuple[object, ...]:
    if kind is click.INT:
        return "int", None, None
    if not isinstance(kind, click.IntRange | click.FloatRange):
        return ("text",)
    # The next number above a limit that is itself outside.
    low = math.nextafter(kind.min, math.inf) if kind.min_open and kind.min is not None else kind.min
    return "int" if isinstance(kind, click.IntRange) else "float", low, kind.max


def _default(option: click.Option, context: click.Context) -> object:
    default = option.get_default(context)
    return default if isinstance(default, bool | int | float | str) else None  # click has a word of its own for none


if __name__ == "__main__":
    TABLE.write_text(table(), "utf-8")
