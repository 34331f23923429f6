"""The commands `talk serve` and `talk bridge`, and their systemd units.

The templates of the units are in the directory `systemd`. For example, `serve-user` is the template for `talk serve
--print-unit user`. A name in braces is replaced by its value, and a line such as `@supervision.conf` includes that
file. The printed units can be used unchanged. System units only give the process access to what it needs. Members of
the group `audio` may use the system-wide server, because they can already use the sound card. This module doesn't
install the units.

No other command imports the server or the bridge.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.command import FILE_MODE, long_flag, nearest
from talkcli.cli.commands import COMMANDS
from talkcli.cli.show import note, show
from talkcli.errors import EXIT_OK, UsageError
from talkcli.goals.options import PATH
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from talkcli.cli.show import CommonOptions
    from talkcli.goals.options import Option

#: The warning that is printed at startup if there is no sound device.
_NO_DEVICE = (
    "no sound device or sound server found, so sentences will be ABORTED until there is one; see 'talk doctor', or run "
    "without sound with '--player file:PATH.wav' or '--player null'"
)
#: The environment files that contain the broker's address and login.
_BRIDGE_ENVIRONMENTS = {"user": "%h/.config/talk/bridge.env", "system": "/etc/talk/bridge.env"}
#: The settings for the directory of the history in the unit of the system-wide server.
_STATE_DIRECTORY = "# The history of goals.\nStateDirectory=talk\nStateDirectoryMode=0700\n"
#: Characters that must not occur in a unit: control characters, line separators and surrogates.
_UNSAFE_CHARACTERS = "[\0-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"
#: Directories that systemd's ProtectHome= setting hides.
_HOME_DIRECTORIES = ("/home/", "/root/", "/run/user/")
#: Directories to which the system-wide server can write.
_WRITABLE_DIRECTORIES = ("/run/talk/", "/var/cache/talk/")
#: Advice for a path to which the system-wide service can't write, by option. If the service can't read a path, the
#: advice is `_LET_READ`.
_HIDDEN_PATH_ADVICE = dict.fromkeys(("--socket", "--player file:"), "choose a path in /run/talk")
_HIDDEN_PATH_ADVICE["--history"] = "leave out the path, so that the history is in /var/lib/talk"
_LET_READ = "copy it into /etc/talk, and let everybody read it"


def serve(options: CommonOptions, print_unit: str | None, **given: Any) -> int:
    """Run the server, or print a systemd unit for it.

    `given` contains all other options, by name.
    """
    history = given["history"] or ""
    if "/" in history:
        given["history"] = os.path.abspath(history)
    given |= {each: os.path.abspath(given[each]) for each in ("sounds", "pronounce") if given[each]}
    if print_unit:
        mode, words = given["socket_mode"], []
        if print_unit.startswith("system") and "socket_mode" not in options.typed:
            mode = 0o660
            words.append("--socket-mode=0660")
        state = _STATE_DIRECTORY if history and "/" not in history else ""
        return _print_unit(options, "serve", print_unit, given, words, mode=f"{mode:04o}", state=state)
    if given["sounds"] and not os.access(os.path.join(given["sounds"], ""), os.R_OK | os.X_OK):
        raise UsageError(f"--sounds: {printable(given['sounds'])} is not a readable directory")
    if not options.quiet:
        _warn_about_sound(given["player"] or "", given["driver"])
    from talkcli.goals.options import SETTINGS, Set
    from talkcli.server import run

    goals = Set(**{each.name: given.pop(each.name) for each in SETTINGS})
    return run.serve(run.ServerSettings(socket=paths.named_socket(options.socket), goals=goals, **given))


def _warn_about_sound(player: str, driver: str | None) -> None:
    """Print a warning if there is no sound device or if the player isn't installed."""
    from talkcli.engine.players import PACKAGES, PLAYERS, PlayerMissing, has_no_output, is_silent, player_commands
    from talkcli.engine.voices import is_own_driver

    if is_silent(player) or not is_own_driver(driver):
        return  # the server reports sound problems of other drivers
    if (not player or player in PACKAGES) and has_no_output(os.environ):
        note(_NO_DEVICE)
    if not player or (player in PLAYERS and player not in PACKAGES):
        return  # the player isn't an external program, so it can't be missing
    try:
        player_commands(player, None, 0)
    except PlayerMissing as error:
        near = nearest(player, PLAYERS.keys() - {player})
        hint = f"; did you mean '{near}'?" if near else ""
        note(f"{printable(str(error))}; nothing can be heard{hint}")


def bridge(options: CommonOptions, print_unit: str | None, print_acl: bool, print_addon_acl: bool, **given: Any) -> int:
    """Run the bridge, or print its systemd unit or the broker's access rules.

    Return the exit code.
    """
    from talkcli.fleet import topics
    from talkcli.fleet.bridge.policy import ALLOWABLE_REQUESTS

    allow = [each.strip() for each in given["allow"].split(",")]
    groups = [each.strip() for each in given["group"].split(",")] if given["group"] else []
    for flag, name in (("--name", given["name"]), *(("--group", each) for each in groups)):
        fault = None if name is None else topics.name_fault(name)
        if fault:
            raise UsageError(f"{flag}: '{printable(name)}' is not a valid name; it {fault}")
    if print_acl or print_addon_acl:
        homeassistant = given["homeassistant"]
        show(topics.access_rules(homeassistant=homeassistant, addon=print_addon_acl, name=given["name"]))
        return EXIT_OK
    for each in allow:
        if each not in ALLOWABLE_REQUESTS:
            near = nearest(each, ALLOWABLE_REQUESTS)
            hint = f"did you mean '{near}'?" if near else f"choose from {', '.join(ALLOWABLE_REQUESTS)}"
            raise UsageError(f"--allow: unknown request '{printable(each)}'; {hint}")
    if print_unit:
        words = ["--insecure"] if options.insecure else []
        return _print_unit(options, "bridge", print_unit, given, words, environment=_BRIDGE_ENVIRONMENTS[print_unit])
    options.broker()  # check the settings and the package that the next import needs
    from talkcli.fleet.bridge.main import BridgeSettings, run_bridge

    settings = BridgeSettings(
        given["name"],
        tuple(allow),
        tuple(groups),
        options.socket,
        with_text=not given["no_text"],
        homeassistant=given["homeassistant"],
    )
    run_bridge(settings, options.broker)
    return EXIT_OK


def _print_unit(
    options: CommonOptions, command: str, kind: str, given: Mapping[str, Any], arguments: Sequence[str], **values: str
) -> int:
    """Print a systemd unit, and warn if the service's user can't access the program.

    Return the exit code.

    Args:
        options: the common options, with the socket and the names of the options to copy into the unit.
        command: the command that the unit runs.
        kind: the value of --print-unit, such as user or system-socket.
        given: the values of the command's options, by name.
        arguments: further arguments for the unit's command line.
        values: further values for the template, by name.
    """
    row = COMMANDS[command]
    typed = [
        _format_option(each, given[each.name]) for each in row.options if each.name in options.typed & given.keys()
    ]
    socket = os.path.abspath(options.socket) if options.socket else None
    socket_option = [f"--socket={socket}"] if socket else []
    usual_socket = paths.SYSTEM_SOCKET if kind.startswith("system") else f"%t/talk/{paths.SOCKET_NAME}"
    escape = _escape_path if kind.endswith("-socket") else printable
    program = _find_program(sys.argv[0])
    # The program's script, interpreter and package must all be accessible.
    files = (program[0], *map(os.path.realpath, (program[0], sys.executable, __file__)))
    home = "read-only" if any(each.startswith(_HOME_DIRECTORIES) for each in files) else "yes"
    unit = _read_template(f"{command}-{kind}").format(
        command=" ".join(map(_quote_argument, (*program, command, *arguments, *socket_option, *typed))),
        home=home,
        socket=escape(socket) if socket else usual_socket,
        **values,
    )
    show(unit.rstrip("\n"))
    if kind != "system":
        return EXIT_OK
    player, colon, file = (given.get("player") or "").partition("file:")
    named = {long_flag(each): given[each.name] for each in row.options if each.kind is PATH}
    named |= {"--socket": socket, "--player file:": colon and os.path.abspath(file), "--player": player.split(" ")[0]}
    for flag, path in named.items():
        if path and os.path.isabs(path) and (problem := _path_fault(flag, path, hides_home=home == "yes")):
            note(f"{flag} names {printable(path)}, but {problem}; {_HIDDEN_PATH_ADVICE.get(flag, _LET_READ)}")
    if hidden := _find_inaccessible_file(files):
        file, directory = hidden
        note(
            f"talk needs {printable(file)}, but the service's user can't enter {printable(directory)}; install "
            "talk for all users with 'sudo /usr/bin/python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install .' in "
            "a checkout, and print the unit with /opt/talk/bin/talk"
        )
    return EXIT_OK


def _read_template(name: str) -> str:
    """Return the template of a systemd unit, with all included files inserted."""
    with open(os.path.join(os.path.dirname(__file__), "systemd", name), encoding="utf-8") as file:
        return "".join(_read_template(line[1:].strip()) if line.startswith("@") else line for line in file)


def _find_program(started_as: str) -> tuple[str, ...]:
    """Return the words of the command that starts this program."""
    script = os.path.join(os.path.dirname(sys.executable), "talk")
    found = shutil.which(started_as if os.path.basename(started_as) == "talk" else script)
    return (os.path.abspath(found),) if found else (sys.executable, "-m", "talkcli")


def _format_option(option: Option, value: object) -> str:
    """Format an option and its value as one command-line argument."""
    if value is True or value == option.bare_value is not None:
        return long_flag(option)
    return f"{long_flag(option)}={value:04o}" if option.kind is FILE_MODE else f"{long_flag(option)}={value}"


def _path_fault(flag: str, path: str, *, hides_home: bool) -> str | None:
    """Return why the system-wide service can't use the path in an option, or None if it can.

    Args:
        flag: the option.
        path: the absolute path.
        hides_home: whether the unit hides home directories.
    """
    if path.startswith(("/tmp/", "/var/tmp/")):
        return "the service has a /tmp of its own (PrivateTmp=)"
    if hides_home and path.startswith(_HOME_DIRECTORIES):
        return "the unit hides home directories (ProtectHome=)"
    if flag in _HIDDEN_PATH_ADVICE:
        return None if path.startswith(_WRITABLE_DIRECTORIES) else "the service can't write there (ProtectSystem=)"
    inside = os.path.join(path, "") if os.path.isdir(path) else path
    is_readable = not os.path.exists(path) or os.stat(path).st_mode & stat.S_IROTH
    if not (is_readable and _find_inaccessible_file([inside]) is None):
        return "the service's user can't read it (DynamicUser=)"
    return None


def _find_inaccessible_file(files: Sequence[str]) -> tuple[str, str] | None:
    """Find the first file that other users can't reach. Return the file and the blocking directory."""
    for path in files:
        steps = path.split(os.sep)
        for count in range(2, len(steps)):
            directory = os.sep.join(steps[:count])
            if os.path.exists(directory) and not os.stat(directory).st_mode & stat.S_IXOTH:
                return path, directory
    return None


def _quote_argument(word: str) -> str:
    """Quote an argument for the command line in a unit."""
    word = word.replace("%", "%%").replace("$", "$$")  # systemd would expand specifiers and variables
    if word and all(each.isalnum() or each in "/._-+=:,@%{}" for each in word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{re.sub(_UNSAFE_CHARACTERS, _escape_match, escaped)}"'


def _escape_match(found: re.Match[str]) -> str:
    """Return the matched characters as hexadecimal escapes."""
    return "".join(f"\\x{each:02x}" for each in os.fsencode(found[0]))


def _escape_path(path: str) -> str:
    """Escape a path for a systemd unit. Raise UsageError if a unit can't contain it."""
    if re.search(_UNSAFE_CHARACTERS, path) or path.endswith(("\\", " ")):
        raise UsageError(
            f"a socket unit can't contain the path {printable(path)}; choose one without control characters"
        )
    return path.replace("%", "%%")  # systemd would expand specifiers
