"""Code that generates the systemd units for `talk serve` and `talk bridge`.

The templates are in the directory `systemd`. For example, `serve-user` is the template for `talk serve --print-unit
user`. A name in braces is replaced by its value, and a line such as `@supervision.conf` includes that file. The printed
units can be used unchanged. System units only give the process access to what it needs. This module doesn't install the
units.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.command import FILE_MODE, spelling
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import note, show
from talkcli.errors import UsageError
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.goals.options import Option

#: The group whose members may use the system-wide server. They can already use the sound card.
SOCKET_GROUP = "audio"
#: The environment files that contain the broker's address and login.
_BRIDGE_ENVIRONMENTS = {"user": "%h/.config/talk/bridge.env", "system": "/etc/talk/bridge.env"}

#: Characters that must not occur in a unit: control characters, line separators and surrogates.
_UNSAFE_CHARACTERS = "[\0-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"
#: Directories that systemd's ProtectHome= setting hides.
_HOME_DIRECTORIES = ("/home/", "/root/", "/run/user/")


def print_server_unit(options: CommonOptions, name: str, given: Mapping[str, Any]) -> None:
    """Print a systemd unit that runs `talk serve` with these options."""
    mode, words = given["socket_mode"], []
    if name.startswith("system") and "socket_mode" not in options.typed:
        mode = 0o660
        words.append("--socket-mode=0660")
    _print_unit(options, "serve", name, given, words, mode=f"{mode:04o}")


def print_bridge_unit(options: CommonOptions, name: str, given: Mapping[str, Any]) -> None:
    """Print a systemd unit that runs `talk bridge` with these options."""
    words = ["--insecure"] if options.insecure else []
    _print_unit(options, "bridge", name, given, words, environment=_BRIDGE_ENVIRONMENTS[name])


def _print_unit(
    options: CommonOptions, command: str, name: str, given: Mapping[str, Any], words: Sequence[str], **values: str
) -> None:
    """Print a systemd unit, and warn if the service's user can't access the program.

    Args:
        options: the common options, with the socket and the names of the options to copy into the unit.
        command: the command that the unit runs.
        name: the name of the unit for --print-unit.
        given: the values of the command's options, by name.
        words: further arguments for the unit's command line.
        values: further values for the template, by name.
    """
    row = COMMANDS[command]
    typed = [_assignment(each, given[each.name]) for each in row.options if each.name in options.typed & given.keys()]
    socket = os.path.abspath(options.socket) if options.socket else None
    socket_option = [f"--socket={socket}"] if socket else []
    usual_socket = paths.SYSTEM_SOCKET if name.startswith("system") else f"%t/talk/{paths.SOCKET_NAME}"
    escape = _escape_path if name.endswith("-socket") else printable
    program = _program(sys.argv[0])
    # The program's script, interpreter and package must all be accessible.
    files = (program[0], *map(os.path.realpath, (program[0], sys.executable, __file__)))
    unit = _template(f"{command}-{name}").format(
        command=" ".join(map(_quote, (*program, command, *words, *socket_option, *typed))),
        group=SOCKET_GROUP,
        home="read-only" if any(each.startswith(_HOME_DIRECTORIES) for each in files) else "yes",
        socket=escape(socket) if socket else usual_socket,
        **values,
    )
    show(unit.rstrip("\n"))
    hidden = _find_hidden(files) if name == "system" else None
    if hidden:
        file, directory = hidden
        note(
            f"this talk needs {printable(file)}, and the service's own user can't pass {printable(directory)}: install "
            "it for all, as with 'sudo /usr/bin/python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install .' in a "
            "checkout, then print the unit"
        )


def _template(name: str) -> str:
    """Return the text of a template with all included files inserted."""
    with open(os.path.join(os.path.dirname(__file__), "systemd", name), encoding="utf-8") as file:
        return "".join(_template(line[1:].strip()) if line.startswith("@") else line for line in file)


def _program(started_as: str) -> tuple[str, ...]:
    """Return the command that starts this program: the installed script or `python -m talkcli`."""
    script = os.path.join(os.path.dirname(sys.executable), "talk")
    found = shutil.which(started_as if os.path.basename(started_as) == "talk" else script)
    return (os.path.abspath(found),) if found else (sys.executable, "-m", "talkcli")


def _assignment(option: Option, value: object) -> str:
    """Format an option and its value as one command-line argument."""
    if value is True:
        return spelling(option)
    return f"{spelling(option)}={value:04o}" if option.kind is FILE_MODE else f"{spelling(option)}={value}"


def _find_hidden(files: Sequence[str]) -> tuple[str, str] | None:
    """Find a file that other users can't access.

    Return the file and the directory that blocks access, or None if all files can be accessed.
    """
    for path in files:
        steps = path.split(os.sep)
        for count in range(2, len(steps)):
            directory = os.sep.join(steps[:count])
            if not os.stat(directory).st_mode & stat.S_IXOTH:
                return path, directory
    return None


def _quote(word: str) -> str:
    """Quote an argument for the command line in a unit."""
    word = word.replace("%", "%%").replace("$", "$$")  # systemd would expand specifiers and variables
    if word and all(each.isalnum() or each in "/._-+=:,@%{}" for each in word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{re.sub(_UNSAFE_CHARACTERS, _as_bytes, escaped)}"'


def _as_bytes(found: re.Match[str]) -> str:
    return "".join(f"\\x{each:02x}" for each in os.fsencode(found[0]))


def _escape_path(path: str) -> str:
    """Escape a path for use as a setting in a unit, where quotes aren't allowed.

    Raises:
        UsageError: systemd would misread the path.
    """
    if re.search(_UNSAFE_CHARACTERS, path) or path.endswith(("\\", " ")):
        raise UsageError(f"a socket's unit can't name {printable(path)}: name a path without such signs")
    return path.replace("%", "%%")  # systemd would expand specifiers
