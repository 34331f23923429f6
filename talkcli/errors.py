"""The errors of `talk`: one tree, each class with its code on the wire and the exit code of the command.

Rules for this file: no imports of other modules of `talk`; a class is added where a program has to tell a case from
another, with a code that is never used again for anything else. Texts are lower-case and name the thing and the next
step. The exit codes are the table of the README. `limits` ends the sentence of one that comes of too little memory.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_DIFFER = 13
EXIT_TIMEOUT = 124  # as timeout(1)
EXIT_SIGNAL = 128  # plus the signal's number, as a shell reports it
EXIT_SIGINT = EXIT_SIGNAL + 2
EXIT_SIGPIPE = EXIT_SIGNAL + 13  # standard output was closed


class TalkError(Exception):
    """Anything that `talk` itself can say is wrong. `code` is for programs, the text for people."""

    code = "error"
    exit_code = EXIT_ERROR

    @property
    def message(self) -> str:
        return str(self)


class UsageError(TalkError):
    """What was asked for has no meaning: an option's value, a combination."""

    code = "usage"
    exit_code = EXIT_USAGE


class ServerUnavailable(TalkError):
    """No server took the request: nothing was sent that it could act on later, so trying again is safe."""

    code = "no_server"
    exit_code = 3


class AccessDenied(TalkError):
    """There is a server, or something in its place, and this user may not use it or must not trust it."""

    code = "permission_denied"
    exit_code = 10


class Lost(TalkError):
    """The connection ended after a goal was sent: what became of it is not known, it may still be spoken."""

    code = "lost"
    exit_code = 12


class TimedOut(TalkError):
    """What was asked for had not ended when the time for it was over."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT


class AddressInUse(TalkError):
    """`serve` cannot serve here: the socket is served already, or its directory is not safe."""

    code = "address_in_use"
    exit_code = 11


class ProtocolMismatch(TalkError):
    """Client and server speak different versions of the protocol."""

    code = "protocol_mismatch"
    exit_code = 9


class Unreadable(ProtocolMismatch, ValueError):
    """What a server sent is no message of the protocol, or has no goal where it should have one."""


class RequestRefused(TalkError):
    """The server answered a request with an error; `code` is the server's, `items` what it listed before."""

    code = "refused"

    def __init__(self, message: str, code: str | None = None, items: list[dict[str, object]] | None = None) -> None:
        super().__init__(message)
        self.code = code or self.code
        self.items = items or []


class UnknownGoal(RequestRefused):
    """No goal of that id is known: it was never sent, or was sent to an earlier server, or is too long ago."""

    code = "unknown_goal"
    exit_code = 8


class Busy(RequestRefused):
    """The server has as many clients as it takes."""

    code = "busy"
    exit_code = 5


class BadOption(RequestRefused):
    """A setting that the server doesn't take: a value out of its range, or a voice that it doesn't have."""

    code = "bad_option"
    exit_code = EXIT_USAGE


class BadRequest(RequestRefused):
    """A line on the wire that is no request. `code` says in which way."""

    code = "bad_request"


class LineTooLong(BadRequest):
    """A line past its limit."""

    code = "line_too_long"


#: Classes that a client raises for an error code of the server's; any other code is a RequestRefused.
BY_CODE: dict[str, type[RequestRefused]] = {
    **{each.code: each for each in (UnknownGoal, Busy, BadOption)},
    "unknown_voice": BadOption,
}


def refusal(code: str, message: str, items: list[dict[str, object]] | None = None) -> RequestRefused:
    """Return the error that a server's error reply stands for; `items`: what it listed before."""
    return BY_CODE.get(code, RequestRefused)(message, code, items)


def limits() -> str:
    """Return what this process is limited to in memory, or where else to look: the end of an error's sentence."""
    import resource  # no start pays for it

    # What each limit is of, and where it is set: in a shell, in a systemd unit.
    for number, what, where in (
        (resource.RLIMIT_DATA, "bytes of memory", "ulimit -d, LimitDATA="),
        (resource.RLIMIT_AS, "bytes of address space", "ulimit -v, LimitAS="),
    ):
        allowed = resource.getrlimit(number)[0]
        if allowed != resource.RLIM_INFINITY:
            return f"it is limited to {allowed:,} {what} ({where})"
    return "see 'free', 'ulimit -u', and MemoryMax= and TasksMax= of its unit"
