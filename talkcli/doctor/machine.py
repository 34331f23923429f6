"""The machine: who runs this process or the server's, in what surroundings, and the sound cards that it may open.

Files tell it all. Nothing is started and no device is opened: that would wake it.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import re
import stat
import struct
from typing import TYPE_CHECKING

from talkcli import peers
from talkcli.doctor.report import Finding, ok, some, warning
from talkcli.engine import players
from talkcli.frozen import frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Any

#: The group that Debian's cards belong to.
_AUDIO = "audio"
#: Files that container runtimes leave in theirs.
_CONTAINER = ("/.dockerenv", "/run/.containerenv", "/run/systemd/container")
#: Parents that are looked at: a shell in a script in cron is three below it.
_GENERATIONS = 8
_CRON = frozenset({"cron", "crond", "cronie", "anacron"})
_SSH = frozenset({"ssh", "sshd"})
#: What is to be said where the server's surroundings can't be seen.
ELSEWHERE = ok(
    "session", "the server runs on another machine or in a container: run talk doctor there to look at its sound"
)
#: An entry of an access control list for one user, or for one group; and the bits for reading and writing.
_ACL_USER, _ACL_GROUP, _READ_WRITE = 2, 8, 6


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


@frozen
class Cards:
    """The sound cards of the kernel."""

    #: whether the kernel tells of any: a container, or a machine without a driver, does not
    kernel: bool
    names: tuple[str, ...] = ()
    #: what plays: /dev/snd/pcmC0D0p
    nodes: tuple[str, ...] = ()
    #: those of them that may not be opened
    forbidden: tuple[str, ...] = ()
    #: the group that they belong to
    group: str = _AUDIO
    #: whether this user is to be in that group from the next login on
    from_next_login: bool = False


def surroundings(server: int | None) -> tuple[Session, Mapping[str, str]]:
    """Return who runs the server, and its environment; of this process where there is none, or it is not to be read.

    The server's player is what plays, so where it can be seen, all that has to do with sound is looked at from there.
    """
    environment = None if server is None else _environment(server)
    if environment is None:
        return _session(os.environ, None), dict(os.environ)
    return _session(environment, server), environment


def names_a_player(server: int, env: Mapping[str, str]) -> bool:
    """Whether a server was told its player, so that it tries no other; `env`: its environment."""
    return bool(env.get("TALK_PLAYER") or re.search(r"\0--player[=\0]", _text(f"/proc/{server}/cmdline")))


def owner(path: str) -> int | None:
    """Return the user who owns a file, a process by its directory in /proc; None where it is not there."""
    with contextlib.suppress(OSError):
        return os.stat(path).st_uid
    return None


def _environment(pid: int) -> dict[str, str] | None:
    """Return the environment of a process of the same user; None for another's, whose sound server shuts us out."""
    data = peers.contents(f"/proc/{pid}/environ", -1)
    if data is None or owner(f"/proc/{pid}") != os.getuid():
        return None
    pairs = (each.partition("=") for each in os.fsdecode(data).split("\0") if "=" in each)
    return {name: value for name, _, value in pairs}


def _session(environment: Mapping[str, str], server: int | None) -> Session:
    uid = os.getuid()
    gids = _groups(server)
    caller = environment.get("SUDO_UID", "")
    runtime = environment.get("XDG_RUNTIME_DIR") or None
    usual = f"/run/user/{uid}"
    return Session(
        uid=uid,
        user=_name(pwd.getpwuid, uid),
        server=server,
        groups=tuple(_name(grp.getgrgid, each) for each in gids),
        gids=gids,
        sudo_uid=int(caller) if uid == 0 and caller.isdecimal() else None,
        kinds=tuple(_kinds(environment, server)),
        runtime=runtime,
        runtime_owner=None if runtime is None else owner(runtime),
        usual_runtime=usual if os.path.isdir(usual) else None,
    )


def _name(look_up: Callable[[int], tuple[Any, ...]], number: int) -> str:
    """Return the name of a user or a group, which comes first of all that is known of one; its number without one."""
    try:
        return str(look_up(number)[0])
    except KeyError:
        return str(number)


def _groups(pid: int | None) -> tuple[int, ...]:
    status = _text(f"/proc/{'self' if pid is None else pid}/status")
    found = re.search(r"^Groups:(.*)$", status, re.MULTILINE)
    mine = re.search(r"^Gid:\s+\d+\s+(\d+)", status, re.MULTILINE)
    if found and mine:
        return tuple(sorted({int(mine[1]), *map(int, found[1].split())}))
    return tuple(sorted({os.getegid(), *os.getgroups()}))


def _kinds(environment: Mapping[str, str], server: int | None) -> Iterable[str]:
    """Give what started it, that which says most first."""
    pid = os.getpid() if server is None else server
    if environment.get("container") or any(map(os.path.exists, _CONTAINER)):
        yield "a container"
    unit = re.search(r"system\.slice/(?:[^\n]*/)?([^/\n]+)\.service", _text(f"/proc/{pid}/cgroup"))
    service = unit[1] if unit else ""
    if service in _CRON or any(each.lower() in _CRON for each in _parents(pid)):
        yield "a cron job"
    elif service and service not in _SSH and environment.get("INVOCATION_ID"):
        yield "a system service"
    if environment.get("SSH_CONNECTION"):
        yield "an ssh session"


def _parents(pid: int) -> Iterable[str]:
    for _ in range(_GENERATIONS):
        parent = peers.stat_of(pid)[1:2]
        pid = int(parent[0]) if parent else 0
        if pid == 0:
            return
        yield peers.command_of(pid) or ""


def cards(session: Session, kernel: str = "/proc/asound", nodes: str = "/dev/snd") -> Cards:
    """Return the kernel's sound cards, and which of them this user may open."""
    # " 0 [Device         ]: USB-Audio - USB Audio Device", and a second line with its place
    names = re.findall(r"^\s*\d+ \[[^\]]*\]:.*? - (.*)$", _text(f"{kernel}/cards"), re.MULTILINE)
    playing = players.playback_devices(nodes)
    group = _AUDIO
    forbidden = []
    for each in playing:
        with contextlib.suppress(OSError):
            found = os.stat(each)
            group = _name(grp.getgrgid, found.st_gid) if found.st_gid else group
            if not _may_open(found, _access_list(each), session):
                forbidden.append(each)
    members: list[str] = []
    with contextlib.suppress(KeyError):
        members = grp.getgrnam(group).gr_mem
    return Cards(
        kernel=os.path.isdir(kernel),
        names=tuple(each.strip() for each in names),
        nodes=tuple(playing),
        forbidden=tuple(forbidden),
        group=group,
        from_next_login=session.user in members,
    )


def _may_open(found: os.stat_result, entries: list[tuple[int, int, int]], session: Session) -> bool:
    """Tell whether a user may read and write a file, by its mode or its access control list, as logind makes one."""
    mode = stat.S_IMODE(found.st_mode)
    if session.uid == 0:
        return True
    if session.uid == found.st_uid:
        return mode >> 6 & _READ_WRITE == _READ_WRITE
    named = {(_ACL_USER, session.uid), *((_ACL_GROUP, each) for each in session.gids)}
    if any((tag, holder) in named and permitted & _READ_WRITE == _READ_WRITE for tag, permitted, holder in entries):
        return True
    bits = mode >> 3 if found.st_gid in session.gids else mode
    return bits & _READ_WRITE == _READ_WRITE


def _access_list(path: str) -> list[tuple[int, int, int]]:
    """Return the entries of a file's access control list: kind, permissions, whose."""
    with contextlib.suppress(OSError):
        data = os.getxattr(path, "system.posix_acl_access")
        return list(struct.iter_unpack("<HHI", data[4 : 4 + (len(data) - 4) // 8 * 8]))
    return []


def _text(path: str) -> str:
    """Return a file under /proc; "" where it isn't there, or is another user's."""
    return (peers.contents(path, -1) or b"").decode(errors="replace")


def judge_session(session: Session) -> Finding:
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
            return ok("session", f"{who}; no XDG_RUNTIME_DIR, as there is no session of this user")
        again = "" if session.server is None else " where the server is started, and start it again"
        return warning(
            "session",
            f"{who}; XDG_RUNTIME_DIR is not set, as under cron, sudo, su and in system services: players find no "
            "PipeWire or PulseAudio of this user",
            f"export XDG_RUNTIME_DIR={session.usual_runtime}{again}",
        )
    words = f"{who}; XDG_RUNTIME_DIR is {session.runtime}"
    if session.runtime_owner is None:
        step = "log in as this user (not by su or sudo), or unset XDG_RUNTIME_DIR"
        return warning("session", f"{words}, which is not there", step)
    if session.runtime_owner != session.uid:
        return warning(
            "session",
            f"{words}, which is uid {session.runtime_owner}'s: its sound server takes nobody else",
            f"run this as the user who owns it: sudo -u '#{session.runtime_owner}' talk doctor",
        )
    return ok("session", words)


def judge_cards(cards: Cards, session: Session, *, served: bool) -> Finding:
    """Judge which cards there are; `served`: whether a sound server answers, which opens them itself."""
    if cards.names:
        return ok("cards", some(cards.names))
    if served:
        return ok("cards", "none of this machine's own; the sound server has what is needed")
    if "a container" in session.kinds:
        step = "start the container with --device /dev/snd, or with the sound server's socket: see the README"
        return warning("cards", "none in this container", step)
    words = "the kernel knows none" if cards.kernel else "the kernel has no sound (no /proc/asound)"
    return warning("cards", words, "plug in a loudspeaker or sound card, and look with: aplay -l")


def judge_access(cards: Cards, session: Session, *, served: bool) -> Finding:
    """Judge who may open the cards; `served`: as of `judge_cards`."""
    group = cards.group
    if not cards.nodes:
        return ok("group", f"nothing in /dev/snd to open, so the group {group} is not needed")
    if not cards.forbidden:
        member = "in the group {}" if group in session.groups else "not in the group {}, and needs not to be"
        return ok("group", f"user {session.user} may open the cards ({member.format(group)})")
    words = f"user {session.user} may not open {some(cards.forbidden)}: not in the group {group}"
    if served:
        return ok("group", f"{words}; the sound server opens them")
    if cards.from_next_login:
        step = "log out and in again" if session.server is None else "start the server again, from a new login"
        return warning("group", f"{words} yet, though it is to be from the next login on", step)
    return warning("group", words, f"sudo usermod -aG {group} {session.user}, and log in again")
