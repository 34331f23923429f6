"""The exceptions that `talk` raises.

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
EXIT_DIFFER = 13  # several robots failed with different exit codes
EXIT_TIMEOUT = 124  # the same exit code as timeout(1)
EXIT_SIGNAL = 128  # the signal's number is added, as in a shell
EXIT_SIGINT = EXIT_SIGNAL + 2
EXIT_SIGPIPE = EXIT_SIGNAL + 13  # used if standard output is closed


class TalkError(Exception):
    """Base class for all errors.

    `code` is machine-readable, and `message` is human-readable.
    """

    code = "error"
    exit_code = EXIT_ERROR

    @property
    def message(self) -> str:
        """The human-readable message of the error."""
        return str(self)


class UsageError(TalkError):
    """A value is invalid, or two options can't be used together."""

    code = "usage"
    exit_code = EXIT_USAGE


class ServerUnavailable(TalkError):
    """No server answered. The request had no lasting effect, so it is safe to try again."""

    code = "no_server"
    exit_code = 3


class AccessDenied(TalkError):
    """The user has no access to the server, or the server's process isn't trusted."""

    code = "permission_denied"
    exit_code = 10


class Lost(TalkError):
    """A request was sent, but its result is unknown. A goal may still be spoken."""

    code = "lost"
    exit_code = 12


class TimedOut(TalkError):
    """The goal or request did not finish in time."""

    code = "timeout"
    exit_code = EXIT_TIMEOUT


class AddressInUse(TalkError):
    """The server's socket or the robot's name is already in use, or the socket's path is unsafe."""

    code = "address_in_use"
    exit_code = 11


class ProtocolMismatch(TalkError):
    """The server uses another version of the protocol, or lacks a feature."""

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
    """The server doesn't know a goal with this id.

    The goal never existed, belonged to an earlier server, or is too old.
    """

    code = "unknown_goal"
    exit_code = 8


class Busy(RequestRefused):
    """The server or the bridge has reached its limit of clients, or of unanswered requests."""

    code = "busy"
    exit_code = 5


class BadOption(RequestRefused):
    """The server refused the value of a setting.

    The value is out of range, or the voice doesn't exist.
    """

    code = "bad_option"
    exit_code = EXIT_USAGE


class BadRequest(RequestRefused):
    """A client's request is invalid or not allowed. `code` says what is wrong."""

    code = "bad_request"


class LineTooLong(BadRequest):
    """A line is longer than the protocol allows."""

    code = "line_too_long"


#: The exception for each error code of the server. Clients raise RequestRefused for any other code.
_ERRORS_BY_CODE: dict[str, type[RequestRefused]] = {
    **{each.code: each for each in (UnknownGoal, Busy, BadOption)},
    "unknown_voice": BadOption,
}


def refusal(code: str, message: str, items: list[dict[str, object]] | None = None) -> RequestRefused:
    """Return the exception for an error reply, with any list items that were sent before the reply."""
    return _ERRORS_BY_CODE.get(code, RequestRefused)(message, code, items)


def memory_hint() -> str:
    """Return words for an error message: this process's memory limit, or what to check if there is none."""
    import resource  # rarely needed, and slow to import

    # Each memory limit, its unit, and the shell command and systemd option that change it.
    for number, what, where in (
        (resource.RLIMIT_DATA, "bytes of memory", "ulimit -d, LimitDATA="),
        (resource.RLIMIT_AS, "bytes of address space", "ulimit -v, LimitAS="),
    ):
        allowed = resource.getrlimit(number)[0]
        if allowed != resource.RLIM_INFINITY:
            return f"the limit is {allowed:,} {what} ({where})"
    return "check 'free', 'ulimit -u', and MemoryMax= and TasksMax= of its unit"
