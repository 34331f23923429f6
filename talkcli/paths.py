"""Where the socket is, and the voices, and what is kept of them: the one place for it.

A client looks in the places of a list that is made without platformdirs, which would double its start; a server takes
the place that platformdirs gives, after its checks of owner and mode. A test compares the two. cron, sudo, systemd and
ssh commands run without XDG_RUNTIME_DIR, so both know what to do without it.
"""

from __future__ import annotations

import errno
import os
import stat
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping

#: The name of the socket in its directory.
SOCKET = "talk.sock"
#: That of a server for the whole machine, in the directory that systemd makes for `RuntimeDirectory=talk`.
SYSTEM_SOCKET = f"/run/talk/{SOCKET}"

#: What there may be at a place where a client reaches nobody.
ABSENT = "not there"
FILE = "a file, and no socket"
DIRECTORY = "a directory, and no socket"
STALE = "nobody answers: left over from a server that ended"
FORBIDDEN = "no permission"


def named_socket(option: str | None) -> str | None:
    """Return the socket that the user named, by option or by variable."""
    return option or os.environ.get("TALK_SOCKET") or None


def named_robot(option: str | None, socket: str | None) -> str | None:
    """Return the robot of a fleet that the user named, by option or by variable; `socket`: the option for that.

    What is typed goes before a variable, and of the variables the one for a robot goes first.
    """
    return option or (None if socket else os.environ.get("TALK_ROBOT") or None)


def client_sockets(named: str | None) -> list[str]:
    """Return the places where a client looks for a server, in this order: the one that was named and no other."""
    if named:
        return [named]
    directories = [os.environ.get("XDG_RUNTIME_DIR"), *_runtime_directories(os.getuid())]
    places = [f"{each.rstrip('/')}/talk/{SOCKET}" for each in directories if each and os.path.isabs(each)]
    return list(dict.fromkeys([*places, SYSTEM_SOCKET]))


def found_at(path: str, error: OSError) -> str:
    """Return what is at a place where a connection failed: one of the words above, else the system's words."""
    try:
        mode = os.stat(path).st_mode
    except OSError:  # `error` tells why; or it was removed just now
        mode = stat.S_IFSOCK
    if stat.S_ISDIR(mode):
        return DIRECTORY
    if not stat.S_ISSOCK(mode):
        return FILE
    if error.errno in {errno.ENOENT, errno.ENOTDIR}:
        return ABSENT
    if error.errno == errno.ECONNREFUSED:
        return STALE
    if error.errno in {errno.EACCES, errno.EPERM}:
        return FORBIDDEN
    return error.strerror or str(error)


def _runtime_directories(uid: int) -> list[str]:
    if sys.platform == "darwin":
        return [os.path.expanduser("~/Library/Caches/TemporaryItems")]
    # Without a directory of systemd's, platformdirs falls back to one under the temporary directory, which is the first
    # of these that can be written; the client can't know which one that was for the server, so it tries them all.
    temporary = [os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP")]
    fallbacks = [
        os.path.join(os.path.abspath(each), f"runtime-{uid}") for each in [*temporary, "/tmp", "/var/tmp"] if each
    ]
    return [f"/run/user/{uid}", *fallbacks]


def sudo_hint() -> str | None:
    """Return the socket that the user who called sudo would have, if root was reached that way."""
    caller = os.environ.get("SUDO_UID", "")
    if os.getuid() != 0 or not caller.isdecimal():
        return None
    return f"/run/user/{caller}/talk/{SOCKET}"


def server_socket(named: str | None) -> str:
    """Return where a server listens, with its directory made; AddressInUse where that directory is not safe."""
    from talkcli.errors import AddressInUse

    if named:
        try:
            return os.path.abspath(named)
        except FileNotFoundError as error:
            words = f"the working directory is gone, and the socket {named} would be in it: name its whole path"
            raise AddressInUse(words) from error
    given = os.environ.get("RUNTIME_DIRECTORY")
    if given:
        return os.path.join(given.split(":")[0], SOCKET)
    import warnings

    import platformdirs

    with warnings.catch_warnings():
        # It warns where XDG_RUNTIME_DIR isn't set; clients know the place that it takes then.
        warnings.simplefilter("ignore", platformdirs.RuntimeDirWarning)
        try:
            return str(platformdirs.PlatformDirs("talk", appauthor=False).place_runtime_file(SOCKET))
        except OSError as error:
            raise AddressInUse(f"no directory for the socket: {error}; name a socket with --socket PATH") from error


def voice_directories(environment: Mapping[str, str] | None = None) -> list[str]:
    """Return where neural voices are looked for, besides installed packages: in this order, whether there or not.

    What TALK_VOICES names, a list like PATH, then the user's own data and the system's. They are platformdirs' places
    on Linux (a test compares), written down here, as the engine process looks in each of its starts. `environment`:
    the variables, if not this process's.
    """
    environment = os.environ if environment is None else environment
    named = environment.get("TALK_VOICES", "").split(os.pathsep)
    system = environment.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    data = [_own(environment.get("XDG_DATA_HOME"), "~/.local/share"), *system.split(os.pathsep)]
    places = [*named, *(os.path.join(each, "talk", "voices") for each in data if os.path.isabs(each))]
    return list(dict.fromkeys(os.path.abspath(each) for each in places if each))


def cache_directory() -> str:
    """Return where what can be made again is kept; it need not be there. Platformdirs' place, but for systemd's."""
    given = os.environ.get("CACHE_DIRECTORY")
    if given:
        return os.path.realpath(given.split(":")[0])  # a link, for a service with a user of its own (DynamicUser=)
    return os.path.join(_own(os.environ.get("XDG_CACHE_HOME"), "~/.cache"), "talk")


def _own(named: str | None, default: str) -> str:
    """Return a directory of the user's, by a variable's value; not one that depends on where this runs."""
    return named if named and os.path.isabs(named) else os.path.expanduser(default)
