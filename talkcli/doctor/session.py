"""Who runs this, and from where: what decides which sound server and which socket can be reached. Pure."""

from __future__ import annotations

from talkcli.doctor.findings import Finding, done, warning
from talkcli.frozen import frozen


@frozen
class Session:
    """Facts about a process: this one, or the server's."""

    uid: int
    user: str
    #: the process whose surroundings were looked at, where it is the server's
    server: int | None = None
    #: names and numbers of its groups
    groups: tuple[str, ...] = ()
    gids: tuple[int, ...] = ()
    #: uid of the user who called sudo, as root
    sudo_uid: int | None = None
    #: what started it, for people: "a system service", "cron", "ssh", "a container"; the first says most
    kinds: tuple[str, ...] = ()
    #: XDG_RUNTIME_DIR; None where it is not set
    runtime: str | None = None
    #: uid of who owns that directory; None where it is not there
    runtime_owner: int | None = None
    #: the directory that it would be, where that is there
    usual_runtime: str | None = None


def elsewhere() -> Finding:
    """Return what is to be said where the server's surroundings can't be seen."""
    return done(
        "session", "the server runs on another machine or in a container: run talk doctor there to look at its sound"
    )


def seen_from(session: Session) -> str:
    """Return for people from where the sound was looked at."""
    return "from here" if session.server is None else f"from the server (process {session.server})"


def judge(session: Session) -> list[Finding]:
    """Judge where this runs."""
    who = f"user {session.user} (uid {session.uid})"
    if session.sudo_uid is not None:
        who += f" by sudo from uid {session.sudo_uid}"
    if session.kinds:
        who += f", in {' and '.join(session.kinds)}"
    if session.server is not None:
        who = f"the server's: {who}"
    if session.runtime is None:
        if session.usual_runtime is None:
            # As on a robot without logind: nothing is missing that there could be.
            return [done("session", f"{who}; no XDG_RUNTIME_DIR, as there is no session of this user")]
        return [
            warning(
                "session",
                f"{who}; XDG_RUNTIME_DIR is not set, as under cron, sudo, su and in system services: players find no "
                "PipeWire or PulseAudio of this user",
                f"export XDG_RUNTIME_DIR={session.usual_runtime}{_again(session)}",
            )
        ]
    if session.runtime_owner is None:
        return [
            warning(
                "session",
                f"{who}; XDG_RUNTIME_DIR is {session.runtime}, which is not there",
                "log in as this user (not by su or sudo), or unset XDG_RUNTIME_DIR",
            )
        ]
    if session.runtime_owner != session.uid:
        return [
            warning(
                "session",
                f"{who}; XDG_RUNTIME_DIR is {session.runtime}, which is uid {session.runtime_owner}'s: its sound "
                "server takes nobody else",
                f"run this as the user who owns it: sudo -u '#{session.runtime_owner}' talk doctor",
            )
        ]
    return [done("session", f"{who}; XDG_RUNTIME_DIR is {session.runtime}")]


def _again(session: Session) -> str:
    return "" if session.server is None else " where the server is started, and start it again"
