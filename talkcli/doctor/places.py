"""The socket: where a client looks for a server, what is there, and on which of these places one is. Pure."""

from __future__ import annotations

from talkcli.doctor.findings import Finding, done, failed, warning
from talkcli.frozen import frozen
from talkcli.unreachable import ABSENT, DIRECTORY, FILE, FORBIDDEN, STALE

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


def judge(found: Places) -> Finding:
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
