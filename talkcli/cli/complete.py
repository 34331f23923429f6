"""What the shells offer for a word that is being typed, as the server that would be asked knows it: live completion.

It must be quick and never say anything: where no server answers at once, there is nothing to offer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from talkcli.errors import TalkError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import click
    from click.shell_completion import CompletionItem

    from talkcli.client.client import Client, ServerStatus
    from talkcli.goals.goal import Goal, JsonObject

    Items = list[CompletionItem[str]]

_Answer = TypeVar("_Answer")

#: Seconds in which the server must answer: somebody has pressed a key and looks at the screen.
PATIENCE = 0.5
#: Ended goals whose ids are offered.
_ENDED = 100
#: Characters of a text that stand beside an id.
_MAX_TEXT = 60


def goal_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the ids of goals that have not ended."""
    status = _ask(context, lambda client: client.status())
    return [] if status is None else _ids(_unfinished(status), status, incomplete)


def known_ids(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the ids of goals, the ended ones too: first what is not over, then the newest."""

    def both(client: Client) -> tuple[ServerStatus, list[Goal]]:
        return client.status(), client.log(_ENDED)

    found = _ask(context, both)
    if found is None:
        return []
    status, ended = found
    return _ids([*_unfinished(status), *reversed(ended)], status, incomplete)


def keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the keys of goals that have not ended, and of the last that have."""
    status = _ask(context, lambda client: client.status())
    return [] if status is None else _keys([*_unfinished(status), *reversed(status.recent)], incomplete)


def unfinished_keys(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the keys of goals that have not ended."""
    status = _ask(context, lambda client: client.status())
    return [] if status is None else _keys(_unfinished(status), incomplete)


def voices(context: click.Context, _: click.Parameter, incomplete: str) -> Items:
    """Return the languages of the engine's voices; their ids and names, once the word can't be a language."""
    found = _ask(context, lambda client: client.voices()) or []
    for field in ("language", "id", "name"):
        offered = {str(each.get(field) or ""): _voice_help(each, field) for each in reversed(found)}
        items = _items(reversed(offered.items()), incomplete)
        if items:
            return items
    return []


def files(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Have the shell offer files."""
    from click.shell_completion import CompletionItem

    return [CompletionItem(incomplete, type="file")]


def players(_: click.Context, __: click.Parameter, incomplete: str) -> Items:
    """Return the players that talk knows by name."""
    from talkcli.engine.players.programs import PLAYERS

    return _items([(name, each.about) for name, each in PLAYERS.items()], incomplete)


def _ask(context: click.Context, question: Callable[[Client], _Answer]) -> _Answer | None:
    """Return the server's answer, or None if there is none for whatever reason."""
    from talkcli.client.client import Client
    from talkcli.client.connection import SocketConnection

    socket = getattr(context.find_root().obj, "socket", None)  # --socket, where it stood before
    try:
        with Client.over(SocketConnection(socket, patience=PATIENCE)) as client:
            return question(client)
    except (TalkError, OSError, ValueError):
        return None


def _unfinished(status: ServerStatus) -> list[Goal]:
    return ([status.active] if status.active else []) + list(status.pending)


def _ids(goals: Iterable[Goal], status: ServerStatus, incomplete: str) -> Items:
    """Return the ids; where digits were typed, the numbers that stand for this server's as well."""
    own = f"{status.server.get('boot')}-"
    digits = incomplete.isascii() and incomplete.isdecimal()
    offered = []
    for each in goals:
        number = each.id.removeprefix(own)
        offered += [
            (name, _goal_help(each)) for name in ((number, each.id) if digits and number != each.id else (each.id,))
        ]
    return _items(offered, incomplete)


def _keys(goals: Iterable[Goal], incomplete: str) -> Items:
    offered: dict[str, str] = {}
    for each in goals:
        if each.key is not None:
            offered.setdefault(each.key, _goal_help(each))
    return _items(offered.items(), incomplete)


def _items(offered: Iterable[tuple[str, str]], incomplete: str) -> Items:
    from click.shell_completion import CompletionItem

    return [CompletionItem(value, help=words) for value, words in offered if _fits(value, incomplete)]


def _fits(value: str, incomplete: str) -> bool:
    # What can't be seen can't be chosen either, and would reach the terminal raw.
    return bool(value) and value.startswith(incomplete) and value.isprintable()


def _goal_help(goal: Goal) -> str:
    from talkcli.terminal.text import printable

    text = "" if goal.text is None else printable(goal.text, _MAX_TEXT)
    return f"{goal.state.name} {text}"


def _voice_help(voice: JsonObject, field: str) -> str:
    from talkcli.terminal.text import printable

    parts = [printable(str(voice.get(each) or ""), _MAX_TEXT) for each in ("name", "language") if each != field]
    return ", ".join(filter(None, parts)) or "voice"
