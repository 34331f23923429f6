"""Paths of the socket, the neural voices, the cache and the history.

A server takes the socket path that platformdirs gives, which also checks the owner and mode of the directory. Importing
platformdirs would double the time that a client takes to start, so a client tries a fixed list of paths. A test
compares the two. Both work without XDG_RUNTIME_DIR, which cron, sudo, systemd and ssh commands don't set.
"""

from __future__ import annotations

import os
import stat
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping

#: File name of the socket.
SOCKET_NAME = "talk.sock"
#: Socket of the system-wide server. systemd creates its directory if the unit has `RuntimeDirectory=talk`.
SYSTEM_SOCKET = f"/run/talk/{SOCKET_NAME}"
#: State directory of the system-wide server. systemd creates it if the unit has `StateDirectory=talk`.
_SYSTEM_STATE_DIRECTORY = "/var/lib/talk"

#: Descriptions of paths to which no client can connect.
PLACE_ABSENT = "not found"
PLACE_FILE = "a file, not a socket"
PLACE_DIRECTORY = "a directory, not a socket"
PLACE_STALE = "no server responds (left over from an earlier server)"
PLACE_FORBIDDEN = "permission denied"


def named_socket(option: str | None) -> str | None:
    """Return the socket path from the option or from TALK_SOCKET, if one is set."""
    return option or os.environ.get("TALK_SOCKET") or None


def named_robot(option: str | None, socket: str | None) -> str | None:
    """Return the robot's name from --robot, or from TALK_ROBOT unless --socket is given.

    Return None if none is set. Both options take precedence over the variables, and TALK_ROBOT over TALK_SOCKET.
    """
    return option or (None if socket else os.environ.get("TALK_ROBOT") or None)


def client_sockets(named: str | None) -> list[str]:
    """Return the socket paths that a client tries, in order.

    If `named` is given, it is the only one.
    """
    if named:
        return [named]
    directories = [os.environ.get("XDG_RUNTIME_DIR"), *_runtime_directories(os.getuid())]
    places = [f"{each.rstrip('/')}/talk/{SOCKET_NAME}" for each in directories if each and os.path.isabs(each)]
    return list(dict.fromkeys([*places, SYSTEM_SOCKET]))


def connect_failure(path: str, error: OSError) -> str:
    """Return the reason why connecting to a socket path failed."""
    try:
        mode = os.stat(path).st_mode
    except OSError:  # `error` gives the reason, unless the file has just been removed
        mode = stat.S_IFSOCK
    if stat.S_ISDIR(mode):
        return PLACE_DIRECTORY
    if not stat.S_ISSOCK(mode):
        return PLACE_FILE
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return PLACE_ABSENT
    if isinstance(error, ConnectionRefusedError):
        return PLACE_STALE
    if isinstance(error, PermissionError):
        return PLACE_FORBIDDEN
    return error.strerror or str(error)


def closed_directory(path: str) -> str | None:
    """Return the first parent directory of a path that this user can't enter, if any."""
    from pathlib import Path  # rarely needed, and slow to import

    directories = reversed(Path(os.path.abspath(path)).parents)
    return next((str(each) for each in directories if not os.access(each, os.X_OK)), None)


def _runtime_directories(uid: int) -> list[str]:
    """Return the directories that platformdirs may use if XDG_RUNTIME_DIR isn't set."""
    if sys.platform == "darwin":
        return [os.path.expanduser("~/Library/Caches/TemporaryItems")]
    # If systemd's directory doesn't exist, platformdirs uses the first of these temporary directories that is writable.
    # A client can't know which directory the server used, so it tries all of them.
    temporary = [os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP")]
    fallbacks = [
        os.path.join(os.path.abspath(each), f"runtime-{uid}") for each in [*temporary, "/tmp", "/var/tmp"] if each
    ]
    return [f"/run/user/{uid}", *fallbacks]


def sudo_caller(environment: Mapping[str, str]) -> int | None:
    """Return the id of the user who started this process through sudo, if any."""
    caller = environment.get("SUDO_UID", "")
    return int(caller) if os.getuid() == 0 and caller.isdecimal() else None


def sudo_caller_socket() -> str | None:
    """Return the path of the socket of the user who ran sudo, if it exists."""
    caller = sudo_caller(os.environ)
    if caller is None:
        return None
    for directory in _runtime_directories(caller):
        path = f"{directory}/talk/{SOCKET_NAME}"
        try:
            owner = os.stat(path).st_uid
        except OSError:
            continue
        if owner == caller:
            return path
    return None


def server_socket(named: str | None) -> str:
    """Return the path for a server's socket. If it is the default path, create its directory.

    Raises:
        AddressInUse: the directory is missing or not safe.
    """
    from talkcli.errors import AddressInUse

    if named:
        try:
            return os.path.abspath(named)
        except FileNotFoundError as error:
            words = f"the current directory was removed, so the socket {named} needs an absolute path"
            raise AddressInUse(words) from error
    given = os.environ.get("RUNTIME_DIRECTORY")
    if given:
        return os.path.join(given.split(":")[0], SOCKET_NAME)
    import warnings

    import platformdirs

    with warnings.catch_warnings():
        # If XDG_RUNTIME_DIR isn't set, platformdirs prints a warning and uses another directory. Clients try that
        # directory, too.
        warnings.simplefilter("ignore", platformdirs.RuntimeDirWarning)
        try:
            return str(platformdirs.PlatformDirs("talk", appauthor=False).place_runtime_file(SOCKET_NAME))
        except OSError as error:
            raise AddressInUse(f"can't create a directory for the socket: {error}; use --socket PATH") from error


def voice_directories(environment: Mapping[str, str] | None = None) -> list[str]:
    """Return the directories to search for neural voices, in order. Some may not exist.

    The directories in TALK_VOICES, a list like PATH, come first. Then come the data directories of the user and of the
    system, as platformdirs gives them on Linux. A test compares the two. Importing platformdirs would slow down every
    start of an engine process.

    Args:
        environment: variables to use instead of those of this process.
    """
    environment = os.environ if environment is None else environment
    named = environment.get("TALK_VOICES", "").split(os.pathsep)
    system = environment.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    data = [_user_directory(environment.get("XDG_DATA_HOME"), "~/.local/share"), *system.split(os.pathsep)]
    places = [*named, *(os.path.join(each, "talk", "voices") for each in data if os.path.isabs(each))]
    return list(dict.fromkeys(os.path.abspath(each) for each in places if each))


def cache_directory() -> str:
    """Return the path of the cache directory, which may not exist yet."""
    given = os.environ.get("CACHE_DIRECTORY")
    if given:
        # CACHE_DIRECTORY names a symbolic link if the unit sets DynamicUser=.
        return os.path.realpath(given.split(":")[0])
    return os.path.join(_user_directory(os.environ.get("XDG_CACHE_HOME"), "~/.cache"), "talk")


def history_file(option: str, socket: str) -> str:
    """Return the path of a server's history file. The file's directory may not exist yet.

    Args:
        option: the value of --history, which is the path if it contains "/".
        socket: the path of the server's socket.
    """
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return option if "/" in option else os.path.join(given or _state_directory(), _history_name(socket))


def history_files(named: str | None) -> list[str]:
    """Return the possible paths of history files, for all servers that a client tries.

    If `named` is given, it is the path of the only server's socket. Otherwise, only the last one is the socket of the
    system-wide server.
    """
    names = [*map(_history_name, client_sockets(named))]
    places = [os.path.join(_state_directory(), name) for name in names]
    return [*places, os.path.join(_SYSTEM_STATE_DIRECTORY, names[-1])]


def _history_name(socket: str) -> str:
    """Return the name of the history file for the server with this socket."""
    path = os.path.realpath(socket).lstrip("/")
    return f"{path.replace('%', '%25').replace('-', '%2d').replace('/', '-')}.db"


def _state_directory() -> str:
    """Return the path of the user's state directory, which may not exist yet."""
    return os.path.join(_user_directory(os.environ.get("XDG_STATE_HOME"), "~/.local/state"), "talk")


def _user_directory(named: str | None, default: str) -> str:
    """Return `named` if it is an absolute path. Otherwise, return `default` with ~ expanded."""
    return named if named and os.path.isabs(named) else os.path.expanduser(default)
