"""Facts that the socket tells: what is at each place, how the server describes itself, how it plays a sentence.

It asks as any client does: with limits of time, and its goal waits its turn and can be cancelled.
"""

from __future__ import annotations

import glob
import os
import socket
from typing import TYPE_CHECKING

from talkcli import paths, peers
from talkcli.client.client import Client
from talkcli.client.dial import Interrupted
from talkcli.doctor.places import FOREIGN, MUTE, SERVER, STOPPED, Place, Places
from talkcli.doctor.sentence import Played
from talkcli.errors import TalkError
from talkcli.frozen import replace
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.client.goal import GoalHandle
    from talkcli.goals.goal import Goal

#: What this client calls itself.
_NAME = "talk doctor"
#: How an error begins that names every place: `Places` says that better.
_NO_SERVER = "no server"


def connect(option: str | None, interrupt: int | None) -> tuple[Client | None, Places]:
    """Return a client of the server, if one can be had, and what is at each place; `option`: --socket."""
    named = paths.named_socket(option)
    by = "--socket" if option else "TALK_SOCKET" if named else None
    tried = paths.client_sockets(named)
    try:
        client = Client(option, name=_NAME, interrupt=interrupt)
    except TalkError as error:
        found = tuple(_place(each, trusted=_trusted(each, named)) for each in tried)
        trouble = _trouble(error.message.splitlines(), found)
        elsewhere = _server_among(paths.client_sockets(None)) if named else None
        return None, Places(found, by, None, trouble, error.code, elsewhere, _others(tried))
    before = tried[: tried.index(client.path)]
    found = (*(_place(each, trusted=_trusted(each, named)) for each in before), Place(client.path, SERVER))
    return client, Places(found, by, client.server_pid)


def _trouble(lines: list[str], found: tuple[Place, ...]) -> str | None:
    """Return what an error says beyond the places: all of it, or why one that answers takes nobody."""
    if not lines[0].startswith(_NO_SERVER):
        return lines[0]
    answering = [f"{each.path}: " for each in found if each.what in {MUTE, STOPPED}]
    told = (line.strip() for line in lines[1:])
    return next((line.removeprefix(each) for line in told for each in answering if line.startswith(each)), None)


def _trusted(path: str, named: str | None) -> bool:
    """Tell whether a client takes any user's server here."""
    return named is not None or path == paths.SYSTEM_SOCKET


def _place(path: str, *, trusted: bool) -> Place:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except BlockingIOError:  # its backlog is full
            return Place(path, MUTE, _owner(path))
        except OSError as error:
            return Place(path, paths.found_at(path, error), _owner(path))
        pid, uid = peers.credentials(probe)
    if not (trusted or uid in {os.getuid(), 0}):
        return Place(path, FOREIGN, uid, pid)
    return Place(path, STOPPED if _is_stopped(pid) else MUTE, uid, pid)


def _is_stopped(pid: int | None) -> bool:
    """Whether a process was stopped, by Ctrl-Z for one."""
    return pid is not None and peers.stat_of(pid)[:1] == [b"T"]


def _owner(path: str) -> int | None:
    """Return who owns a socket's file, or else its directory."""
    for each in (path, os.path.dirname(path)):
        try:
            return os.stat(each).st_uid
        except OSError:
            continue
    return None


def _server_among(places: list[str]) -> str | None:
    return next((each for each in places if _place(each, trusted=False).what == MUTE), None)


def _others(tried: list[str]) -> tuple[str, ...]:
    """Return the sockets of other users that can be seen: all of them for root, none for most."""
    return tuple(each for each in sorted(glob.glob(f"/run/user/*/talk/{paths.SOCKET}")) if each not in tried)


def process_here(client: Client) -> int | None:
    """Return the server's process; None where it runs elsewhere, behind a socket that ssh forwards for one.

    Of a socket unit's socket the kernel names systemd, which has made it, as the one who listens.
    """
    pid, _ = peers.credentials(client._connection.line.socket)
    here = pid == client.server_pid or peers.command_of(pid) == "systemd"
    return client.server_pid if here else None


def speak(client: Client, text: str, limit: float) -> Played:
    """Send a sentence that waits its turn, and return how it ended; after `limit` seconds it is taken back."""
    try:
        goal = client.say(text, preempt=False, ttl=0)
    except TalkError as error:
        return Played(State.LOST, "lost", error.message)
    try:
        if goal.speech_paused:
            goal.cancel()
            return Played(goal.state, "paused", "speech is paused")
        return _played(goal.wait(limit))
    except TimeoutError:
        return _taken_back(client, goal, limit)
    except TalkError as error:
        return Played(State.LOST, "lost", error.message)
    except Interrupted:
        goal.request_cancel()
        raise


def beside(client: Client, play: Callable[[], Played]) -> tuple[Played, bool]:
    """Play without the server, and return how that went, and whether the server spoke meanwhile."""
    try:
        before = client.status()
        played = play()
        after = client.status()
    except TalkError as error:
        return Played(State.LOST, "lost", error.message), False
    spoken = {each.id for each in after.recent if each.state in {State.SUCCEEDED, State.PREEMPTED}}
    return played, bool(before.active or after.active or spoken - {each.id for each in before.recent})


def _taken_back(client: Client, goal: GoalHandle, limit: float) -> Played:
    """Cancel a goal that has not ended in time, and say what was in its way."""
    try:
        before = client.status()
        ended = goal.cancel()
    except TalkError as error:
        return Played(State.LOST, "lost", error.message)
    if ended.state in {State.SUCCEEDED, State.ABORTED}:  # in this moment
        return _played(ended)
    ahead = next((number for number, each in enumerate(before.pending) if each.id == goal.id), None)
    if before.server.get("paused") is True:
        return Played(ended.state, "paused", "speech is paused")
    if ahead is None:
        return Played(ended.state, "late", f"it was begun and not over after {limit:g} s, and was cancelled")
    goals = "1 goal" if ahead + bool(before.active) == 1 else f"{ahead + bool(before.active)} goals"
    return Played(ended.state, "late", f"it still waited behind {goals} after {limit:g} s, and was taken back")


def _played(goal: Goal) -> Played:
    return Played(goal.state, goal.reason, goal.message, goal.duration)


def with_player(played: Played, player: object) -> Played:
    """Return how a sentence ended, with the name of the server's player."""
    return replace(played, player=str(player)) if player else played
