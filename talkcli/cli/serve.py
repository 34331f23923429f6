"""`talk serve`."""

from __future__ import annotations

import re
import sys

import click
from click.core import ParameterSource

from talkcli.cli import complete, units
from talkcli.cli.common import common, common_options, filled, number, seconds
from talkcli.cli.show import note, show
from talkcli.server.settings import MAX_CLIENTS, MAX_QUEUE, Settings

#: Milliseconds of silence before a sentence: no output needs longer to wake.
MAX_LEAD_IN = 5000


def _mode(context: click.Context, parameter: click.Parameter, value: str) -> int:
    """Return the mode of a file; the owner must be able to use the socket, and nobody executes it."""
    mode = int(value, 8) if re.fullmatch("[0-7]{3,4}", value) else 0
    if mode & ~0o666 or mode & 0o600 != 0o600:
        words = f"{value!r} is not a mode such as 0600 (mine alone), 0660 (my group's) or 0666."
        raise click.BadParameter(words, context, parameter)
    return mode


@click.command("serve")
@click.option(
    "--rate",
    type=click.IntRange(80, 450),
    default=200,
    show_default=True,
    envvar="TALK_RATE",
    show_envvar=True,
    help="Words per minute.",
)
@click.option(
    "--volume",
    type=click.FloatRange(0, 1),
    callback=number,
    default=1.0,
    show_default=True,
    envvar="TALK_VOLUME",
    show_envvar=True,
    help="Loudness.",
)
@click.option(
    "--voice",
    envvar="TALK_VOICE",
    show_envvar=True,
    callback=filled,
    shell_complete=complete.voices,
    help="Voice by id, name or language: see 'talk voices'.",
)
@click.option("--pitch", type=click.IntRange(0, 100), default=50, show_default=True, help="Pitch of the voice.")
@click.option("--preempt", is_flag=True, help="Every goal stops the one before it, unless it says --queue.")
@click.option(
    "--ttl",
    type=click.FloatRange(0),
    callback=seconds,
    default=0,
    show_default=True,
    metavar="SEC",
    help="A goal that has not begun after SEC seconds is recalled, unless it brings its own --ttl; 0: no limit.",
)
@click.option(
    "--max-queue",
    type=click.IntRange(1),
    default=MAX_QUEUE,
    show_default=True,
    help="Goals that may wait.",
)
@click.option(
    "--max-text",
    type=click.IntRange(1, 10_000),
    default=10_000,
    show_default=True,
    help="Characters of one text.",
)
@click.option(
    "--max-clients",
    type=click.IntRange(1),
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
    help="aplay, pacat or pw-cat; null (silent, in real time); file:PATH.wav; or a command that reads 16-bit mono PCM, "
    "with {rate} for its rate and {device} for the --device. [default: the first of the three that works]",
)
@click.option(
    "--device",
    metavar="NAME",
    help="Device, by the player's own name for it: for aplay one that 'aplay -L' lists, such as plughw:1,0; for pacat "
    "one of 'pactl list short sinks'; for pw-cat the name of a node, as in 'pw-cli ls Node'. Name the --player, too.",
)
@click.option(
    "--lead-in",
    type=click.IntRange(0, MAX_LEAD_IN),
    default=0,
    show_default=True,
    metavar="MS",
    help="Milliseconds of silence before a sentence, where the output was idle: HDMI, USB and Bluetooth outputs fall "
    "asleep, and swallow what comes while they wake.",
)
@click.option("--driver", metavar="NAME", help="pyttsx3 driver. [default: the one for this system]")
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
    help="Print a unit for systemd that serves with the options given here, and end; it says where it goes.",
)
@common_options
@click.pass_context
def command(context: click.Context, /, print_unit: str | None, **options: object) -> int:
    """Run the server, in the foreground, until SIGTERM or Ctrl-C.

    It queues sentences and speaks one at a time; its log is on standard error. For systemd it prints its own units.

    \b
      talk serve --rate 150
      talk serve --player null      no sound, same timing: for simulation and CI
      talk serve --print-unit user  a service for systemd, with how to install it

    Exit codes: 0 ended by SIGTERM or SIGINT; 2 usage; 11 another server serves already, or the socket's directory is
    not safe.
    """
    if options["device"] and str(options["player"] or "").startswith(("null", "file:")):
        raise click.UsageError(f"--device means nothing to the player {options['player']}", context)
    if print_unit:
        _print_unit(context, print_unit)
        return 0
    from talkcli import paths
    from talkcli.server.run import serve

    return serve(Settings(socket=paths.named_socket(common(context).socket), **options))  # type: ignore[arg-type]


def _print_unit(context: click.Context, name: str) -> None:
    given = {each.name: each for each in context.command.params if _is_given(context, each)}
    mode = context.params["socket_mode"] if "socket_mode" in given else None
    options = [_written(each, context.params[each.name or ""]) for each in given.values()]
    wanted = units.wanted(sys.argv[0], options, common(context).socket, mode)
    show(units.UNITS[name](wanted).rstrip("\n"))
    hidden = units.hidden_from_others(wanted.files) if name == "system" else None
    if hidden:
        note(
            f"this talk is in {hidden}, where the service's own user can't get: install it for all, as with "
            "'sudo python3 -m venv /opt/talk && sudo /opt/talk/bin/pip install talkcli', and print the unit with that"
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
