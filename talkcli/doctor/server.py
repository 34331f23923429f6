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
from talkcli.doctor.report import Finding, done, failed, warning
from talkcli.doctor.sentence import remedy
from talkcli.errors import TalkError
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import told
from talkcli.goals.states import State
from talkcli.paths import ABSENT, DIRECTORY, FILE, FORBIDDEN, STALE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal, JsonObject

#: What this client calls itself.
_NAME = "talk doctor"
#: How an error begins that names every place: `Places` says that better.
_NO_SERVER = "no server"
#: Goals of the log that are looked at for failures.
_LOG = 100
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
    "busy": "end some of its clients, or give it more places: talk serve --max-clients 512",
    "permission_denied": "have its owner let you in: talk serve --socket-mode 0660, and join the socket's group",
}
#: By what names a socket: what stands between it and the name, and how it is not named any more.
_AS = {"TALK_SOCKET": "=", "--socket": " "}
_OFF = {"TALK_SOCKET": "unset TALK_SOCKET", "--socket": "leave --socket out"}
#: Volume below which a server's setting may be why nobody hears it.
_FAINT = 0.2


@frozen
class Place:
    """One path, and what is there."""

    path: str
    what: str
    #: who owns what is there: the uid of a server or of a file
    uid: int | None = None
    #: the process that listens, where that is known
    pid: int | None = None


@frozen
class Places:
    """All places that are tried, in order."""

    places: tuple[Place, ...]
    #: what named the only one: "--socket", "TALK_SOCKET"; None for the list
    named: str | None = None
    #: the server's process, where one was reached
    pid: int | None = None
    #: what a client's error says beyond the places, where none was, and its code
    trouble: str | None = None
    code: str | None = None
    #: a server of this user at a usual place, though another was named
    elsewhere: str | None = None
    #: sockets of other users' servers
    others: tuple[str, ...] = ()


def connect(option: str | None, interrupt: int | None) -> tuple[Client | None, Places]:
    """Return a client of the server, if one can be had, and what is at each place; `option`: --socket."""
    named = paths.named_socket(option)
    by = "--socket" if option else "TALK_SOCKET" if named else None
    tried = paths.client_sockets(named)
    try:
        client = Client.over(SocketConnection(option, name=_NAME, interrupt=interrupt))
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
    found = owner(path)
    return owner(os.path.dirname(path)) if found is None else found


def _server_among(places: list[str]) -> str | None:
    return next((each for each in places if _place(each, trusted=False).what == MUTE), None)


def _others(tried: list[str]) -> tuple[str, ...]:
    """Return the sockets of other users that can be seen: all of them for root, none for most."""
    return tuple(each for each in sorted(glob.glob(f"/run/user/*/talk/{paths.SOCKET}")) if each not in tried)


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
    server = next((each for each in found.places if each.what == SERVER), None)
    if server is not None:
        before = [each for each in found.places[: found.places.index(server)] if each.what != ABSENT]
        by = f"{found.named}, " if found.named else ""
        words = f"the server is on {server.path} ({by}process {found.pid})"
        if before:
            passed = "; ".join(map(_shown, before))
            return warning("socket", f"{words}; before it: {passed}", f"remove what is in the way: {before[0].path}")
        return done("socket", words)
    tried = "; ".join(map(_shown, found.places))
    words = f"no server; {'named by ' + found.named if found.named else 'tried'}: {tried}"
    if found.trouble is not None and not any(each.what == STOPPED for each in found.places):
        words = f"{words}; {found.trouble}"
    return failed("socket", words, _step(found))


def _shown(place: Place) -> str:
    whose = "" if place.uid is None or place.what not in {FOREIGN, FORBIDDEN} else f" (uid {place.uid})"
    return f"{place.path}: {place.what}{whose}"


def _step(found: Places) -> str:
    if found.elsewhere is not None:
        return f"{_OFF[found.named or '--socket']}: a server is on {found.elsewhere}"
    by_what = {each.what: each for each in reversed(found.places)}
    if FORBIDDEN in by_what:
        place = by_what[FORBIDDEN]
        whose = "its owner" if place.uid is None else f"uid {place.uid}"
        return f"have {whose} let you in: talk serve --socket-mode 0660, and join the socket's group; or start your own"
    if FOREIGN in by_what:
        place = by_what[FOREIGN]
        return f"remove it, and: talk serve; or if you trust uid {place.uid}: talk --socket {place.path} doctor"
    if STOPPED in by_what:
        return f"let it go on: kill -CONT {by_what[STOPPED].pid}"
    if MUTE in by_what:
        step = _ANSWERS.get(found.code or "")
        return step or f"restart the server on {by_what[MUTE].path}; if it is none of talk's, remove that"
    if FILE in by_what or DIRECTORY in by_what:
        return _no_socket(by_what.get(FILE) or by_what[DIRECTORY], found.named)
    if STALE in by_what:
        return "talk serve (it takes the place of what was left over)"
    if found.others:
        return f"talk serve; or use another user's server: talk --socket {found.others[0]} doctor"
    return _start(found)


def _no_socket(place: Place, named: str | None) -> str:
    if named is None:
        return f"remove {place.path}, and: talk serve"
    if place.what == DIRECTORY:
        return f"name the socket in it: {named}{_AS[named]}{place.path.rstrip('/')}/talk.sock"
    return f"{_OFF[named]}, or name a socket"


def _start(found: Places) -> str:
    if found.named is None:
        return "talk serve"
    option = f" --socket {found.places[0].path}" if found.named == "--socket" else ""
    return f"{_OFF[found.named]}, or start a server there: talk serve{option}"


def gone(words: str) -> Finding:
    """Return what is to be said of a server that took this client and then did not answer."""
    return failed("server", words, "look at its log, and start it again: talk serve")


def judge(server: JsonObject, log: Sequence[Goal], now: float) -> list[Finding]:
    """Judge a server by its own description and by the goals that ended last, oldest first."""
    return [_itself(server), _settings(server), _failures(log, now, server)]


def _itself(server: JsonObject) -> Finding:
    version, engine = server.get("version"), server.get("engine")
    parts = [f"talk {version}", f"up {_span(server.get('uptime'))}", f"engine {engine}"]
    parts += [f"{name} {server[name]}" for name in ("synthesizer", "player", "device") if server.get(name)]
    parts.append(f"{server.get('pending')} waiting, {server.get('clients')} of {server.get('max_clients')} clients")
    words = "; ".join(parts)
    if server.get("paused") is True:
        return failed("server", f"speech is paused; {words}", "talk resume")
    if engine not in {"ready", "starting"}:
        return warning("server", words, remedy("engine_failed", words))
    if version != __version__:
        step = "start the server again, with the talk that is installed now"
        return warning("server", f"{words}; this is talk {__version__}", step)
    return done("server", words)


def _settings(server: JsonObject) -> Finding:
    volume = server.get("volume")
    lead_in = [f"lead-in {server['lead_in']} ms"] if server.get("lead_in") else []
    words = ", ".join([*told(server), *lead_in])
    if isinstance(volume, int | float) and volume < _FAINT:
        broken = failed if volume <= 0 else warning
        return broken("settings", words, "talk set --volume 1")
    return done("settings", words)


def _failures(log: Sequence[Goal], now: float, server: JsonObject) -> Finding:
    if not log:
        return done("failures", "none: this server has spoken nothing yet")
    aborted = [each for each in log if each.state is State.ABORTED]
    many = "the last goal" if len(log) == 1 else f"the last {len(log)} goals"
    if not aborted:
        return done("failures", f"none in {many}")
    last = aborted[-1]
    words = (last.message or "").removeprefix("Talk aborted: ")
    when = "" if last.ended_at is None else f", {_when(last.ended_at, now)}"
    who = f"{many} ABORTED, {last.id}" if len(log) == 1 else f"{len(aborted)} of {many} ABORTED, last {last.id}"
    told = f"{who}{when}: {last.reason}: {words}"
    after = [each for each in log[log.index(last) + 1 :] if each.state is State.SUCCEEDED]
    if after:
        return done("failures", f"{told}; {len(after)} succeeded since")
    return warning("failures", told, remedy(last.reason, words, server.get("player"), server.get("device")))


def _when(at: float, now: float) -> str:
    ago = f"{_span(now - at)} ago"
    return f"{ago} ({time.strftime('%H:%M:%S', time.localtime(at))})"


def _span(seconds: object) -> str:
    """Return a length of time for people, in its largest unit."""
    if not isinstance(seconds, int | float):
        return "?"
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"
