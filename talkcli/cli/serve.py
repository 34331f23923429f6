"""`talk serve`: its options and its help; it runs the server, or prints a unit. No other module imports the server."""

from __future__ import annotations

import os
import re
import sys

import click
from click.core import ParameterSource

from talkcli.cli import complete, units
from talkcli.cli.common import common, common_options, number, seconds, talk_command, word
from talkcli.cli.show import note, show
from talkcli.cli.usage import Number, WholeNumber
from talkcli.goals.text import MAX_CHARACTERS
from talkcli.server.settings import MAX_CLIENTS, MAX_QUEUE, Settings

#: As `admission` has them, which imports what printing a unit doesn't need; a test compares the two.
RATES, VOLUMES, PITCHES = (80, 450), (0.0, 1.0), (0, 100)
#: Milliseconds of silence before a sentence: no output needs longer to wake.
MAX_LEAD_IN = 5000

#: What is said at the start where nothing could sound.
NO_DEVICE = (
    "no sound device is here, and no PulseAudio or PipeWire: plug in a loudspeaker, or hand it to the container ('talk "
    "doctor' says more); it is looked for with each sentence, which ends ABORTED until it is there; to speak without "
    "one: '--player file:PATH.wav', '--player null'"
)


def _mode(context: click.Context, parameter: click.Parameter, value: str) -> int:
    """Return the mode of a file; the owner must be able to use the socket, and nobody executes it."""
    mode = int(value, 8) if re.fullmatch("[0-7]{3,4}", value) else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        words = f"{value!r} is not a mode such as 0600 (mine alone), 0660 (my group's) or 0666"
        raise click.BadParameter(words, context, parameter)
    return mode


@talk_command(
    "serve",
    examples="""
        talk serve --rate 150
        talk serve --player null       no sound, same timing: for simulation and CI
        talk serve --print-unit user   a service for systemd, with how to install it
    """,
    exit_codes={
        0: "ended by SIGTERM or SIGINT; by a second one 128+n",
        1: "anything not named here; a bug says so",
        2: "usage: an option or a voice that there isn't",
        11: "this socket is served already, or its directory is not safe",
    },
)
@click.option(
    "--rate",
    type=WholeNumber(*RATES),
    default=200,
    show_default=True,
    envvar="TALK_RATE",
    show_envvar=True,
    help="Words per minute.",
)
@click.option(
    "--volume",
    type=Number(*VOLUMES),
    callback=number,
    default=1.0,
    show_default=True,
    envvar="TALK_VOLUME",
    show_envvar=True,
    help="Loudness.",
)
@click.option(
    "--voice",
    metavar="VOICE",
    envvar="TALK_VOICE",
    show_envvar=True,
    callback=word,
    shell_complete=complete.voices,
    help="Voice by id, name or language: see 'talk voices'.",
)
@click.option(
    "--pitch", type=WholeNumber(*PITCHES), default=50, show_default=True, help="Pitch of the voice; 50 is its own."
)
@click.option("--preempt", is_flag=True, help="Every goal stops the one before it, unless it says --queue.")
@click.option(
    "--ttl",
    type=Number(0),
    callback=seconds,
    default=0,
    show_default=True,
    metavar="SEC",
    help="A goal that has not begun after SEC seconds is recalled; it may bring its own --ttl; 0: no limit.",
)
@click.option(
    "--max-queue",
    type=WholeNumber(1),
    default=MAX_QUEUE,
    show_default=True,
    help="Goals that may wait.",
)
@click.option(
    "--max-text",
    type=WholeNumber(1, MAX_CHARACTERS),
    default=MAX_CHARACTERS,
    show_default=True,
    help="Characters of one text.",
)
@click.option(
    "--max-clients",
    type=WholeNumber(1),
    default=MAX_CLIENTS,
    show_default=True,
    help="Clients at once.",
)
@click.option(
    "--player",
    metavar="PLAYER",
    envvar="TALK_PLAYER",
    show_envvar=True,
    shell_complete=complete.players,
    help="What plays the sound. One of aplay, pacat and pw-cat; null (silent, in real time); file:PATH.wav; or a "
    "command that reads 16-bit mono PCM, with {rate} for its rate and {device} for the --device. [default: the first "
    "of the three that works]",
)
@click.option(
    "--device",
    metavar="NAME",
    help="Device, by the player's own name for it. For aplay one that 'aplay -L' lists, such as plughw:1,0; for pacat "
    "one of 'pactl list short sinks'; for pw-cat the name of a node, as in 'pw-cli ls Node'. Name the --player, too.",
)
@click.option(
    "--lead-in",
    type=WholeNumber(0, MAX_LEAD_IN),
    default=0,
    show_default=True,
    metavar="MS",
    help="Milliseconds of silence before a sentence; only where the output was idle: HDMI, USB and Bluetooth outputs "
    "fall asleep, and swallow what comes while they wake.",
)
@click.option("--driver", metavar="NAME", help="A driver of pyttsx3's. [default: the one for this system]")
@click.option(
    "--socket-mode",
    metavar="MODE",
    callback=_mode,
    default="0600",
    show_default=True,
    help="Who may connect: the socket's file mode.",
)
@click.option("--greeting", metavar="TEXT", help="A sentence to speak at the start.")
@click.option(
    "--print-unit",
    type=click.Choice(list(units.UNITS)),
    metavar="UNIT",
    help=f"Print a systemd unit with these options, and end. One of {', '.join(units.UNITS)}; it says where it goes.",
)
@common_options
@click.pass_context
def command(context: click.Context, /, print_unit: str | None, **options: object) -> int:
    """Run the server, in the foreground, until SIGTERM or Ctrl-C.

    It queues sentences and speaks one at a time; its log is on standard error. For systemd it prints its own units.
    """
    player = str(options["player"] or "")
    if options["device"] and player.startswith(("null", "file:")):
        raise click.UsageError(f"--device means nothing to the player {player}", context)
    if player == "file:":
        raise click.UsageError("--player file: names no file: write file:PATH.wav", context)
    if print_unit:
        _print_unit(context, print_unit)
        return 0
    if not common(context).quiet:
        _warn_of_sound(player, options["driver"])
    from talkcli import paths
    from talkcli.server.run import serve

    return serve(Settings(socket=paths.named_socket(common(context).socket), **options))  # type: ignore[arg-type]


def _warn_of_sound(player: str, driver: object) -> None:
    """Tell what would be in the way of every sentence: no device, or a player that there isn't.

    With a device and no player named it only looks at the names of files, so that the start is not kept waiting.
    """
    from talkcli.engine.devices import nothing_sounds

    if player == "null" or player.startswith("file:"):
        return
    silent = player in {"", *complete.PLAYERS} and nothing_sounds(os.environ)
    if not player and not silent:
        return
    from talkcli.engine.start import is_own

    if not is_own(None if driver is None else str(driver)):
        return  # it plays by itself, and the server says so
    if silent:
        note(NO_DEVICE)
    if player:
        _warn_of_player(player)


def _warn_of_player(player: str) -> None:
    """Tell of a player that there isn't: a word that was mistyped, or a program that is not installed yet."""
    from talkcli.cli.nearest import nearest
    from talkcli.engine.players.base import AudioFailed
    from talkcli.engine.players.programs import commands, on_path
    from talkcli.terminal.printable import printable

    try:
        commands(player, None, 0, on_path, None)
    except AudioFailed as error:
        near = nearest(player, set(complete.PLAYERS) - {player})
        hint = f"did you mean '{near}'? " if near else ""
        note(f"{printable(str(error))}: {hint}nothing can be heard until it is there")


def _print_unit(context: click.Context, name: str) -> None:
    from talkcli.terminal.printable import printable

    given = {each.name: each for each in context.command.params if _is_given(context, each)}
    mode = context.params["socket_mode"] if "socket_mode" in given else None
    options = [_written(each, context.params[each.name or ""]) for each in given.values()]
    wanted = units.wanted(sys.argv[0], options, common(context).socket, mode)
    show(units.UNITS[name](wanted).rstrip("\n"))
    hidden = units.hidden_from_others(wanted.files) if name == "system" else None
    if hidden:
        file, directory = hidden
        note(
            f"this talk needs {printable(file)}, and the service's own user can't pass {printable(directory)}: install "
            "it for all, as with 'sudo /usr/bin/python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install .' in a "
            "checkout, then print the unit"
        )


def _is_given(context: click.Context, parameter: click.Parameter) -> bool:
    """Return whether an option of the server's stands on the command line."""
    source = context.get_parameter_source(parameter.name or "")
    return parameter.expose_value and parameter.name != "print_unit" and source is ParameterSource.COMMANDLINE


def _written(parameter: click.Parameter, value: object) -> str:
    """Return an option as it is written on a command line."""
    option = parameter.opts[-1]
    if value is True:
        return option
    return f"{option}={value:04o}" if parameter.name == "socket_mode" else f"{option}={value}"
