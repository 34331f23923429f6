"""Checks of the server: its socket, its state, its settings and its recent failures.

The doctor connects like any client, with time limits.
"""

from __future__ import annotations

import glob
import os
import socket
import time

from talkcli import __version__, paths, peers
from talkcli.client.client import Client
from talkcli.client.connection import SocketConnection
from talkcli.doctor.report import Finding, failure, ok, warning
from talkcli.doctor.sentence import advise
from talkcli.doctor.sound import file_owner
from talkcli.doctor.voice import WORKING_STATES
from talkcli.errors import TalkError
from talkcli.frozen import TYPE_CHECKING, fields, frozen
from talkcli.goals.goal import message_details, read_seconds
from talkcli.goals.options import LONG_PAUSE_S, describe_settings
from talkcli.goals.reasons import Reason
from talkcli.goals.states import State
from talkcli.paths import PLACE_ABSENT, PLACE_DIRECTORY, PLACE_FILE, PLACE_FORBIDDEN, PLACE_STALE
from talkcli.polling import run_blocking
from talkcli.terminal.goals import clock_time, describe_pause

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from talkcli.goals.goal import Goal, JsonObject

#: The name under which the doctor connects to the server.
DOCTOR_NAME = "talk doctor"
#: The beginning of a client's error message if no server was found.
_NO_SERVER_PREFIX = "no server"
#: Number of recently ended goals to check for failures.
_LOG_GOALS_COUNT = 100
_RECENT_CHECK = "recent goals"
#: How long to wait for a starting engine, and how often to ask for its state.
_ENGINE_START_LIMIT_S, _ENGINE_POLL_S = 1.0, 0.05
#: Descriptions of paths that accept connections. The kernel accepts connections even if the process never answers.
PLACE_FOREIGN = "another user's server"
PLACE_LISTENING = "a process is listening"
PLACE_STOPPED = "a stopped process is listening"
#: Description of a path in a directory that this user can't enter.
PLACE_CLOSED = "permission denied for a directory of this path"
#: Advice if the server refuses the client, by error code.
_REFUSAL_ADVICE = {
    "protocol_mismatch": "install the same version of talk for the server and its clients, and restart the server",
    "busy": "end some clients, or raise the limit in the message: talk serve --max-clients 512, or LimitNOFILE=",
    "permission_denied": "ask its owner for access: talk serve --socket-mode 0660, and join the socket's group",
}
#: Advice for each kind of place. If several kinds were found, the first kind in this table counts.
_PLACE_ADVICE = {
    PLACE_FORBIDDEN: "ask {whose} for access: talk serve --socket-mode 0660, and join the socket's group; "
    "or start your own server",
    PLACE_CLOSED: "ask {whose} for access: talk serve --socket PATH --socket-mode 0660, with a PATH that you can "
    "reach; or start your own server",
    PLACE_FOREIGN: "remove {path}, and run: talk serve; or if you trust uid {uid}, run: talk --socket {path} doctor",
    PLACE_STOPPED: "continue the process: kill -CONT {pid}",
    PLACE_LISTENING: "restart the server on {path}; if the socket isn't talk's, remove it",
    PLACE_FILE: "remove {path}, and run: talk serve",
    PLACE_DIRECTORY: "remove {path}, and run: talk serve",
    PLACE_STALE: "talk serve (it replaces the old socket)",
}
#: How to set and unset the option or variable that names a socket.
_NAMING = {"TALK_SOCKET": "TALK_SOCKET=", "--socket": "--socket "}
_UNNAMING: dict[str | None, str] = {"TALK_SOCKET": "unset TALK_SOCKET", "--socket": "leave out --socket"}
#: Speech may be inaudible if the volume setting is lower than this. The maximum is 1.
_FAINT_VOLUME = 0.2


@frozen
class SocketPlace:
    """The result of probing a path where a server may listen."""

    path: str
    #: one of the PLACE texts, or the system's error message
    state: str
    #: owner of the process or the file, or None if unknown
    uid: int | None = None
    #: id of the listening process, or None if unknown
    pid: int | None = None


def connect(socket_option: str | None, interrupt: Mapping[int, int] | None) -> tuple[Client | None, Finding]:
    """Connect to the server. Return the client, if any, and the finding about the socket.

    Args:
        socket_option: the value of --socket.
        interrupt: descriptors that interrupt the wait.
    """
    named = paths.named_socket(socket_option)
    named_by = "--socket" if socket_option else "TALK_SOCKET" if named else None
    tried = paths.client_sockets(named)
    # At these places, clients trust a server of any user.
    trusted_paths = {named, paths.SYSTEM_SOCKET}
    try:
        client = Client.over(run_blocking(SocketConnection.open(socket_option, name=DOCTOR_NAME, interrupt=interrupt)))
    except TalkError as error:
        return None, explain_missing_server([_probe_path(each, trusted_paths) for each in tried], named_by, error)
    before = [_probe_path(each, trusted_paths) for each in tried[: tried.index(client.path)]]
    by = f"{named_by}, " if named_by else ""
    return client, judge_found_server(f"the server is on {client.path} ({by}process {client.server_pid})", before)


def _find_cause(error: TalkError, places: list[SocketPlace]) -> str | None:
    """Return the line of a client's error message that names the cause, or None if none does."""
    lines = error.message.splitlines()
    if not lines[0].startswith(_NO_SERVER_PREFIX):
        return lines[0]
    listening = [f"  {each.path}: " for each in places if each.state == PLACE_LISTENING]
    return next((line.removeprefix(each) for line in lines for each in listening if line.startswith(each)), None)


def _probe_path(path: str, trusted_paths: Container[str | None]) -> SocketPlace:
    """Connect to a socket path. Return what was found there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(path)
        except OSError as error:
            uid = file_owner(path)
            uid = file_owner(os.path.dirname(path)) if uid is None else uid
            if isinstance(error, BlockingIOError):  # the server's backlog is full
                return SocketPlace(path, PLACE_LISTENING, uid)
            state = paths.connect_failure(path, error)
            closed = state == PLACE_FORBIDDEN and paths.closed_directory(path)
            return SocketPlace(path, PLACE_CLOSED if closed else state, uid)
        pid, uid = peers.credentials(probe)
    if path not in trusted_paths and uid not in {os.getuid(), 0}:
        return SocketPlace(path, PLACE_FOREIGN, uid, pid)
    stopped = peers.process_stat(pid)[:1] == [b"T"]  # for example after Ctrl-Z
    return SocketPlace(path, PLACE_STOPPED if stopped else PLACE_LISTENING, uid, pid)


def request_status_and_log(client: Client) -> tuple[JsonObject, list[Goal]]:
    """Wait briefly for a server's engine to start. Return the server's status and its recently ended goals.

    The engine of a server that has just started hasn't reported its player yet.
    """
    end = time.monotonic() + _ENGINE_START_LIMIT_S
    server, log = client.status().server, client.log(_LOG_GOALS_COUNT, history=False)
    while server.get("engine") == "starting" and time.monotonic() < end:
        time.sleep(_ENGINE_POLL_S)  # no event reports when the engine is ready
        server = client.status().server
    return server, log


def local_pid(client: Client) -> int | None:
    """Return the server's process id. Return None if the server runs elsewhere.

    The server's socket may be forwarded by ssh, for example. If systemd created the socket, the kernel reports systemd
    as the listening process.
    """
    pid = client._connection.listener_pid
    is_local = pid is not None and (pid == client.server_pid or peers.command_name(pid) == "systemd")
    return client.server_pid if is_local else None


def judge_found_server(message: str, earlier_places: list[SocketPlace]) -> Finding:
    """Check the places that clients try before a server's socket. Return the finding.

    Args:
        message: the description of the server's socket.
        earlier_places: the places that clients try first.
    """
    obstacles = [each for each in earlier_places if each.state != PLACE_ABSENT]
    if not obstacles:
        return ok("socket", message)
    message = f"{message}; clients first try {'; '.join(map(_format_place, obstacles))}"
    return warning("socket", message, f"remove {obstacles[0].path}")


def explain_missing_server(places: list[SocketPlace], named_by: str | None, error: TalkError) -> Finding:
    """Create the finding for a missing server, with advice.

    Args:
        places: the places that were tried.
        named_by: the option or variable that named the only place to try, or None if the usual places were tried.
        error: why the client could not connect.
    """
    tried = f"{named_by} names" if named_by else "tried:"
    words = f"no server found; {tried} {'; '.join(map(_format_place, places))}"
    message = _find_cause(error, places)
    if message is not None and not any(each.state == PLACE_STOPPED for each in places):
        words = f"{words}; {message}"
    return failure("socket", words, _advise_on_missing_server(places, named_by, error.code))


def _format_place(place: SocketPlace) -> str:
    """Describe a socket path and what was found there."""
    whose = "" if place.uid is None or place.state not in {PLACE_FOREIGN, PLACE_FORBIDDEN} else f" (uid {place.uid})"
    return f"{place.path}: {place.state}{whose}"


def _advise_on_missing_server(places: list[SocketPlace], named_by: str | None, error_code: str) -> str:
    """Return advice for a user whose server wasn't found.

    `error_code` is the code of the client's error.
    """
    for each in paths.client_sockets(None) if named_by else []:
        if _probe_path(each, set()).state == PLACE_LISTENING:
            return f"{_UNNAMING[named_by]}, because a server is running on {each}"
    caller = paths.sudo_caller_socket()
    found = None if caller is None else _probe_path(caller, {caller})
    if found and found.state == PLACE_LISTENING and found not in places:
        return f"use the server of the user who called sudo: talk --socket {caller} doctor"
    place = next((each for state in _PLACE_ADVICE for each in places if each.state == state), None)
    if place is None:  # a new server could start at any of the places
        # Only root can see the sockets of all users.
        others = {*glob.glob(f"/run/user/*/talk/{paths.SOCKET_NAME}")}.difference(each.path for each in places)
        if others:
            return f"talk serve; or use another user's server: talk --socket {min(others)} doctor"
        if named_by is None:
            return "talk serve"
        option = f" --socket {places[0].path}" if named_by == "--socket" else ""
        return f"{_UNNAMING[named_by]}, or start a server there: talk serve{option}"
    if place.state == PLACE_LISTENING and error_code in _REFUSAL_ADVICE:
        return _REFUSAL_ADVICE[error_code]
    if named_by is not None and place.state == PLACE_DIRECTORY:
        return f"name the socket in this directory: {_NAMING[named_by]}{place.path.rstrip('/')}/talk.sock"
    if named_by is not None and place.state == PLACE_FILE:
        return f"{_UNNAMING[named_by]}, or name a socket instead of a file"
    whose = "its owner" if place.uid is None else f"uid {place.uid}"
    return _PLACE_ADVICE[place.state].format(whose=whose, **fields(place))


def judge_unresponsive_server(message: str) -> Finding:
    """Create the finding for a server that accepted the connection but didn't answer."""
    return failure("server", message, "read its log, and restart it: talk serve")


def judge_server(server: JsonObject, log: Sequence[Goal], now: float) -> list[Finding]:
    """Check the server's state, settings and recent failures. Return the findings.

    Args:
        server: the server's description of itself.
        log: the recently ended goals, oldest first.
        now: the current time in seconds since 1970.
    """
    history = _judge_history(server.get("history"))
    pronunciations = _judge_pronunciations(server.get("pronunciations"))
    recent = _judge_recent_goals(log, now, server)
    return [_judge_state(server, now), _judge_settings(server), *pronunciations, *history, recent]


def _judge_state(server: JsonObject, now: float) -> Finding:
    """Check the server's pause, engine and version. Return the finding."""
    version, words = server.get("version"), summarize_server(server)
    if server.get("paused") is True:
        words = f"{describe_pause(server)}; {words}"
        at, until = (read_seconds(server.get(name)) for name in ("paused_at", "paused_until"))
        if at is None or until is None:
            return failure("server", words, "talk resume")
        if max(now - at, until - now) > LONG_PAUSE_S:
            return warning("server", words, "talk resume")
    if server.get("engine") not in WORKING_STATES:
        return warning("server", words, advise(Reason.ENGINE_FAILED, words))
    if version != __version__:
        step = "restart the server, so that it runs the installed version"
        return warning("server", f"{words}; the installed version is {__version__}", step)
    return ok("server", words)


def summarize_server(server: JsonObject) -> str:
    """Return a one-line summary of a server's state."""
    up = format_span(server.get("uptime"))
    parts = [f"talk {server.get('version')}", f"up {up}", f"engine {server.get('engine')}"]
    parts += [f"{name} {server[name]}" for name in ("synthesizer", "player", "device") if server.get(name)]
    parts.append(f"{server.get('pending')} waiting, {server.get('clients')} of {server.get('max_clients')} clients")
    return "; ".join(parts)


def _judge_settings(server: JsonObject) -> Finding:
    """Check the volume setting. Return a finding that lists all of the server's settings.

    It is a warning or failure if the volume is too low.
    """
    volume = server.get("volume")
    lead_in = [f"lead-in {server['lead_in']} ms"] if server.get("lead_in") else []
    words = ", ".join([*describe_settings(server), *lead_in])
    if isinstance(volume, int | float) and volume < _FAINT_VOLUME:
        broken = failure if volume <= 0 else warning
        return broken("settings", words, "talk set --volume 1")
    return ok("settings", words)


def _judge_pronunciations(found: object) -> list[Finding]:
    """Check the file of pronunciations. Return one finding, or none if the server has no such file."""
    if not isinstance(found, dict):
        return []
    problems = [str(each) for each in found["problems"]]
    words = "; ".join(["{terms} terms from {file}".format(**found), *problems])
    step = "correct the file, and let the server's user read it; it is read again before the next sentence"
    return [warning("pronunciation", words, step) if problems else ok("pronunciation", words)]


def _judge_history(history: object) -> list[Finding]:
    """Check whether the server can write its history. Return one finding, or none if the server has no history."""
    if not isinstance(history, dict):
        return []
    path, error, replaced = (history.get(each) for each in ("path", "error", "replaced"))
    if error is None:
        texts = "" if history.get("with_text") else " without their texts"
        return [ok("history", f"goals are stored{texts} in {path}{f'; {replaced}' if replaced else ''}")]
    counts = f"{history.get('unwritten')} goals wait in memory, {history.get('dropped')} are lost"
    step = "free some space on its disk, and let the server's user write to the file; the server keeps trying"
    return [warning("history", f"can't write to {path}: {error}; {counts}", step)]


def _judge_recent_goals(goals: Sequence[Goal], now: float, server: JsonObject) -> Finding:
    """Check recent goals for failures. Return the finding.

    It is a warning if no goal has succeeded since the last failure.
    """
    if not goals:
        return ok(_RECENT_CHECK, "no goals yet")
    aborted = [each for each in goals if each.state is State.ABORTED]
    many = "the last goal" if len(goals) == 1 else f"the last {len(goals)} goals"
    if not aborted:
        return ok(_RECENT_CHECK, f"none of {many} failed" if len(goals) > 1 else f"{many} did not fail")
    last = aborted[-1]
    message = message_details(last.message)
    when = "" if last.ended_at is None else f", {format_span(now - last.ended_at)} ago ({clock_time(last.ended_at)})"
    which = f"{many}, {last.id}" if len(goals) == 1 else f"{len(aborted)} of {many}, most recently {last.id}"
    words = f"ABORTED: {which}{when}: {last.reason}: {message}"
    succeeded = sum(each.state is State.SUCCEEDED for each in goals[goals.index(last) + 1 :])
    if succeeded:
        return ok(_RECENT_CHECK, f"{words}; {succeeded} succeeded since then")
    step = advise(last.reason, message, server.get("player"), server.get("device"), last.text)
    return warning(_RECENT_CHECK, words, step)


def format_span(seconds: object) -> str:
    """Format a duration in a suitable unit, such as "3 min".

    Return "?" if it isn't a number.
    """
    if not isinstance(seconds, int | float):
        return "?"
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"
