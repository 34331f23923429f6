"""The server: at which place it is or what is there instead, how it describes itself, and what has failed lately.

The doctor asks as any client does, with limits of time.
"""

from __future__ import annotations

import glob
import os
import socket
import time

from talkcli import __version__, paths, peers
from talkcli.client.client import Client
from talkcli.client.connection import SocketConnection
from talkcli.doctor.machine import owner
from talkcli.doctor.report import Finding, failed, ok, warning
from talkcli.doctor.sentence import remedy
from talkcli.doctor.voice import WORKING
from talkcli.errors import TalkError
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.options import told
from talkcli.goals.states import State
from talkcli.paths import ABSENT, DIRECTORY, FILE, FORBIDDEN, STALE
from talkcli.terminal.goals import clock_time

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from talkcli.goals.goal import Goal, JsonObject

#: What this client calls itself.
_NAME = "talk doctor"
#: How an error begins that names every place: `Places` says that better.
_NO_SERVER = "no server"
#: Goals of the log that are looked at for failures, and the check of it.
_LOG, _RECENT = 100, "recent goals"
#: Seconds in which an engine should be ready, and between two looks whether it is.
_STARTING, _PAUSE = 1.0, 0.05
#: What is found at a place, beside what `found_at` finds where nobody can be reached.
FOREIGN = "another user's server"
#: A connection proves no more: the kernel takes it, whatever the process does.
MUTE = "something listens"
STOPPED = "a process listens that is stopped"
SERVER = "the server"
#: What to do where a server answers and takes no client, by the code of the client's error.
_ANSWERS = {
    "protocol_mismatch": "install the same talk on both sides, and start the server again",
    "busy": "end some of its clients, or raise the limit that is named: talk serve --max-clients 512, or LimitNOFILE=",
    "permission_denied": "have its owner let you in: talk serve --socket-mode 0660, and join the socket's group",
}
#: What to do about what is found, that which is most surely in the way first.
_STEPS = {
    FORBIDDEN: "have {whose} let you in: talk serve --socket-mode 0660, and join the socket's group; or start your own",
    FOREIGN: "remove it, and: talk serve; or if you trust uid {uid}: talk --socket {path} doctor",
    STOPPED: "let it go on: kill -CONT {pid}",
    MUTE: "restart the server on {path}; if it is none of talk's, remove that",
    FILE: "remove {path}, and: talk serve",
    DIRECTORY: "remove {path}, and: talk serve",
    STALE: "talk serve (it takes the place of what was left over)",
}
#: By what names a socket: what stands between it and the name, and how it is not named any more.
_AS = {"TALK_SOCKET": "=", "--socket": " "}
_OFF: dict[str | None, str] = {"TALK_SOCKET": "unset TALK_SOCKET", "--socket": "leave --socket out"}
#: Volume below which a server's setting may be why nobody hears it.
_FAINT_SETTING = 0.2


@frozen
class Place:
    """One path, and what is there."""

    path: str
    what: str
    #: who owns what is there: the uid of a server or of a file
    uid: int | None = None
    #: the process that listens or serves, where that is known
    pid: int | None = None


@frozen
class Places:
    """All places that are tried, in order; where the server is, none is after that."""

    places: tuple[Place, ...]
    #: what named the only one: "--socket", "TALK_SOCKET"; None for the list
    named: str | None = None
    #: what a client's error says beyond the places, where none was, and its code
    trouble: str | None = None
    code: str | None = None
    #: a server of this user at a usual place, though another was named
    elsewhere: str | None = None
    #: sockets of other users' servers
    others: tuple[str, ...] = ()


def connect(option: str | None, interrupt: Mapping[int, int] | None) -> tuple[Client | None, Places]:
    """Return a client of the server, if one can be had, and what is at each place; `option`: --socket."""
    named = paths.named_socket(option)
    by = "--socket" if option else "TALK_SOCKET" if named else None
    tried = paths.client_sockets(named)
    #: where a client takes any user's server
    trusted = {named, paths.SYSTEM_SOCKET}
    try:
        client = Client.over(SocketConnection(option, name=_NAME, interrupt=interrupt))
    except TalkError as error:
        found = tuple(_place(each, trusted) for each in tried)
        trouble = _trouble(error.message.splitlines(), found)
        usual = paths.client_sockets(None) if named else []
        elsewhere = next((each for each in usual if _place(each, set()).what == MUTE), None)
        # Of other users root sees all, most see none.
        others = sorted({*glob.glob(f"/run/user/*/talk/{paths.SOCKET}")}.difference(tried))
        return None, Places(found, by, trouble, error.code, elsewhere, tuple(others))
    before = tried[: tried.index(client.path)]
    places = (*(_place(each, trusted) for each in before), Place(client.path, SERVER, pid=client.server_pid))
    return client, Places(places, by)


def _trouble(lines: list[str], found: tuple[Place, ...]) -> str | None:
    """Return what an error says beyond the places: all of it, or why one that answers takes nobody."""
    if not lines[0].startswith(_NO_SERVER):
        return lines[0]
    answering = [f"{each.path}: " for each in found if each.what in {MUTE, STOPPED}]
    told = (line.strip() for line in lines[1:])
    return next((line.removeprefix(each) for line in told for each in answering if line.startswith(each)), None)


def _place(path: str, trusted: Container[str | None]) -> Place:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except OSError as error:
            full = isinstance(error, BlockingIOError)  # its backlog
            uid = owner(path)
            uid = owner(os.path.dirname(path)) if uid is None else uid
            return Place(path, MUTE if full else paths.found_at(path, error), uid)
        pid, uid = peers.credentials(probe)
    if path not in trusted and uid not in {os.getuid(), 0}:
        return Place(path, FOREIGN, uid, pid)
    stopped = peers.stat_of(pid)[:1] == [b"T"]  # by Ctrl-Z for one
    return Place(path, STOPPED if stopped else MUTE, uid, pid)


def described(client: Client) -> tuple[JsonObject, list[Goal]]:
    """Return how a server describes itself, and the goals that ended last, oldest first; TalkError where it goes away.

    A server that has just been started doesn't know its player yet, and tells nobody when it does.
    """
    end = time.monotonic() + _STARTING
    server, log = client.status().server, client.log(_LOG)
    while server.get("engine") == "starting" and time.monotonic() < end:
        time.sleep(_PAUSE)
        server = client.status().server
    return server, log


def process_here(client: Client) -> int | None:
    """Return the server's process; None where it runs elsewhere, behind a socket that ssh forwards for one.

    Of a socket unit's socket the kernel names systemd, which has made it, as the one who listens.
    """
    pid = client._connection.listener
    here = pid is not None and (pid == client.server_pid or peers.command_of(pid) == "systemd")
    return client.server_pid if here else None


def judge_places(found: Places) -> Finding:
    """Judge where the server is."""
    *tried, server = found.places
    if server.what == SERVER:
        before = [each for each in tried if each.what != ABSENT]
        by = f"{found.named}, " if found.named else ""
        words = f"the server is on {server.path} ({by}process {server.pid})"
        if before:
            passed = "; ".join(map(_shown, before))
            return warning("socket", f"{words}; before it: {passed}", f"remove what is in the way: {before[0].path}")
        return ok("socket", words)
    places = "; ".join(map(_shown, found.places))
    words = f"no server; {'named by ' + found.named if found.named else 'tried'}: {places}"
    if found.trouble is not None and not any(each.what == STOPPED for each in found.places):
        words = f"{words}; {found.trouble}"
    return failed("socket", words, _step(found))


def _shown(place: Place) -> str:
    whose = "" if place.uid is None or place.what not in {FOREIGN, FORBIDDEN} else f" (uid {place.uid})"
    return f"{place.path}: {place.what}{whose}"


def _step(found: Places) -> str:
    if found.elsewhere is not None:
        return f"{_OFF[found.named]}: a server is on {found.elsewhere}"
    place = next((each for what in _STEPS for each in found.places if each.what == what), None)
    if place is None:
        return _start(found)
    if place.what == MUTE and found.code in _ANSWERS:
        return _ANSWERS[found.code]
    if found.named is not None and place.what == DIRECTORY:
        return f"name the socket in it: {found.named}{_AS[found.named]}{place.path.rstrip('/')}/talk.sock"
    if found.named is not None and place.what == FILE:
        return f"{_OFF[found.named]}, or name a socket"
    whose = "its owner" if place.uid is None else f"uid {place.uid}"
    return _STEPS[place.what].format(whose=whose, **fields(place))


def _start(found: Places) -> str:
    if found.others:
        return f"talk serve; or use another user's server: talk --socket {found.others[0]} doctor"
    if found.named is None:
        return "talk serve"
    option = f" --socket {found.places[0].path}" if found.named == "--socket" else ""
    return f"{_OFF[found.named]}, or start a server there: talk serve{option}"


def gone(words: str) -> Finding:
    """Return what is to be said of a server that took this client and then did not answer."""
    return failed("server", words, "look at its log, and start it again: talk serve")


def judge(server: JsonObject, log: Sequence[Goal], now: float) -> list[Finding]:
    """Judge a server by its own description and by the goals that ended last, oldest first."""
    return [_itself(server), _settings(server), _recent(log, now, server)]


def _itself(server: JsonObject) -> Finding:
    version, engine, words = server.get("version"), server.get("engine"), summary(server)
    if server.get("paused") is True:
        return failed("server", f"speech is paused; {words}", "talk resume")
    if engine not in WORKING:
        return warning("server", words, remedy("engine_failed", words))
    if version != __version__:
        step = "start the server again, with the talk that is installed now"
        return warning("server", f"{words}; this is talk {__version__}", step)
    return ok("server", words)


def summary(server: JsonObject) -> str:
    """Return how a server describes itself, for people."""
    parts = [f"talk {server.get('version')}", f"up {span(server.get('uptime'))}", f"engine {server.get('engine')}"]
    parts += [f"{name} {server[name]}" for name in ("synthesizer", "player", "device") if server.get(name)]
    parts.append(f"{server.get('pending')} waiting, {server.get('clients')} of {server.get('max_clients')} clients")
    return "; ".join(parts)


def _settings(server: JsonObject) -> Finding:
    volume = server.get("volume")
    lead_in = [f"lead-in {server['lead_in']} ms"] if server.get("lead_in") else []
    words = ", ".join([*told(server), *lead_in])
    if isinstance(volume, int | float) and volume < _FAINT_SETTING:
        broken = failed if volume <= 0 else warning
        return broken("settings", words, "talk set --volume 1")
    return ok("settings", words)


def _recent(log: Sequence[Goal], now: float, server: JsonObject) -> Finding:
    if not log:
        return ok(_RECENT, "none yet")
    aborted = [each for each in log if each.state is State.ABORTED]
    many = "the last goal" if len(log) == 1 else f"the last {len(log)} goals"
    if not aborted:
        return ok(_RECENT, f"none of {many} failed" if len(log) > 1 else f"{many} did not fail")
    last = aborted[-1]
    words = (last.message or "").removeprefix("Talk aborted: ")
    when = "" if last.ended_at is None else f", {span(now - last.ended_at)} ago ({clock_time(last.ended_at)})"
    who = f"{many} ABORTED, {last.id}" if len(log) == 1 else f"{len(aborted)} of {many} ABORTED, last {last.id}"
    told = f"{who}{when}: {last.reason}: {words}"
    after = [each for each in log[log.index(last) + 1 :] if each.state is State.SUCCEEDED]
    if after:
        return ok(_RECENT, f"{told}; {len(after)} succeeded since")
    step = remedy(last.reason, words, server.get("player"), server.get("device"), last.text)
    return warning(_RECENT, told, step)


def span(seconds: object) -> str:
    """Return a length of time for people, in its largest unit."""
    if not isinstance(seconds, int | float):
        return "?"
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"
