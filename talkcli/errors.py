"""The exceptions of `talk`. Each class has an error code for programs and an exit code for the command.

Rules for this file:

- It imports no other module of `talk`.
- Add a class only if a program has to distinguish the case. Never reuse an error code for something else.
- Messages are in lower case. They name the thing, the problem and the next step.
- The README has the same table of exit codes.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_DIFFER = 13
EXIT_TIMEOUT = 124  # the same as timeout(1)
EXIT_SIGNAL = 128  # plus the number of the signal, like in a shell
EXIT_SIGINT = EXIT_SIGNAL + 2
EXIT_SIGPIPE = EXIT_SIGNAL + 13  # standard output was closed


class TalkError(Exception):
    """Base class of all errors that `talk` reports. `code` is for programs, and `message` is for people."""

    code = "error"
    exit_code = EXIT_ERROR

    @property
    def message(self) -> str:
        return str(self)


class UsageError(TalkError):
    """The command or call makes no sense: an invalid value, or options that exclude each other."""

    code = "usage"
    exit_code = EXIT_USAGE


class ServerUnavailable(TalkError):
    """No server accepted the request. Nothing was sent, so it is safe to try again."""

    code = "no_server"
    exit_code = 3


class AccessDenied(TalkError):
    """The user may not use this server, or must not trust the process that listens on its socket."""

    code = "permission_denied"
    exit_code = 10


class Lost(TalkError):
    """The connection ended after a goal was sent. The goal may still be spoken."""

    code = "lost"
    exit_code = 12


class TimedOut(TalkError):
    """The goal or request did not finish in time."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT


class AddressInUse(TalkError):
    """`talk serve` can't use the socket: another server uses it, or its directory is not safe."""

    code = "address_in_use"
    exit_code = 11


class ProtocolMismatch(TalkError):
    """The client and the server use different versions of the protocol."""

    code = "protocol_mismatch"
    exit_code = 9


class Unreadable(ProtocolMismatch, ValueError):
    """The server sent a malformed message."""


class RequestRefused(TalkError):
    """The server answered a request with an error.

    Attributes:
        code: the error code that the server sent.
        items: the list items that the server sent before the error.
    """

    code = "refused"

    def __init__(self, message: str, code: str | None = None, items: list[dict[str, object]] | None = None) -> None:
        super().__init__(message)
        self.code = code or self.code
        self.items = items or []


class UnknownGoal(RequestRefused):
    """The server knows no goal with this id: it never existed, belongs to an earlier server, or is too old."""

    code = "unknown_goal"
    exit_code = 8


class Busy(RequestRefused):
    """The server has reached its limit of clients."""

    code = "busy"
    exit_code = 5


class BadOption(RequestRefused):
    """The server refused a setting: its value is out of range, or the voice doesn't exist."""

    code = "bad_option"
    exit_code = EXIT_USAGE


class BadRequest(RequestRefused):
    """A client sent an invalid request. `code` gives the problem."""

    code = "bad_request"


class LineTooLong(BadRequest):
    """A line is longer than the protocol allows."""

    code = "line_too_long"


#: The exception that a client raises for each of the server's error codes. The default is RequestRefused.
_ERRORS_BY_CODE: dict[str, type[RequestRefused]] = {
    **{each.code: each for each in (UnknownGoal, Busy, BadOption)},
    "unknown_voice": BadOption,
}


def refusal(code: str, message: str, items: list[dict[str, object]] | None = None) -> RequestRefused:
    """Return the exception for a server's error reply. The arguments become its attributes."""
    return _ERRORS_BY_CODE.get(code, RequestRefused)(message, code, items)


def memory_limits() -> str:
    """Return the end of a message about too little memory: the limit of this process, or where to find it."""
    import resource  # here, so that it doesn't slow down the start of every command

    # Each limit with its unit, and with the shell command and the systemd option that set it.
    for number, what, where in (
        (resource.RLIMIT_DATA, "bytes of memory", "ulimit -d, LimitDATA="),
        (resource.RLIMIT_AS, "bytes of address space", "ulimit -v, LimitAS="),
    ):
        allowed = resource.getrlimit(number)[0]
        if allowed != resource.RLIM_INFINITY:
            return f"it is limited to {allowed:,} {what} ({where})"
    return "see 'free', 'ulimit -u', and MemoryMax= and TasksMax= of its unit"
