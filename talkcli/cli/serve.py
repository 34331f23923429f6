"""The command `talk serve`, which runs the server or prints a systemd unit for it.

No other command imports the server.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli import units
from talkcli.cli.command import nearest
from talkcli.cli.show import note
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from typing import Any

    from talkcli.cli.show import CommonOptions

#: The warning that is printed at startup if there is no sound device.
_NO_DEVICE = (
    "no sound device is here, and no PulseAudio or PipeWire: plug in a loudspeaker, or hand it to the container ('talk "
    "doctor' says more); it is looked for with each sentence, which ends ABORTED until it is there; to speak without "
    "one: '--player file:PATH.wav', '--player null'"
)


def serve(options: CommonOptions, print_unit: str | None, **given: Any) -> int:
    """Run the server or print a systemd unit for it, and return the exit code.

    `given` contains all other options, by name.
    """
    if print_unit:
        units.print_server_unit(options, print_unit, given)
        return 0
    if not options.quiet:
        _warn_about_sound(given["player"] or "", given["driver"])
    from talkcli.goals.options import SETTINGS, Set
    from talkcli.server import run

    goals = Set(**{each.name: given.pop(each.name) for each in SETTINGS})
    return run.serve(run.ServerSettings(socket=paths.named_socket(options.socket), goals=goals, **given))


def _warn_about_sound(player: str, driver: str | None) -> None:
    """Warn if speech can't be heard because the sound device or the player is missing."""
    from talkcli.engine.players import PACKAGES, has_no_output, is_silent
    from talkcli.engine.voices import is_own_driver

    if is_silent(player) or not is_own_driver(driver):
        return  # other drivers play sound themselves, and the server reports this
    if (not player or player in PACKAGES) and has_no_output(os.environ):
        note(_NO_DEVICE)
    if player:
        _warn_about_player(player)


def _warn_about_player(player: str) -> None:
    """Warn if the player's name is misspelled or the player isn't installed."""
    from talkcli.engine.players import PACKAGES, PLAYERS, PlayerMissing, player_commands

    if player in PLAYERS and player not in PACKAGES:
        return  # this player isn't an external program, so it can't be missing
    try:
        player_commands(player, None, 0)
    except PlayerMissing as error:
        near = nearest(player, PLAYERS.keys() - {player})
        hint = f"did you mean '{near}'? " if near else ""
        note(f"{printable(str(error))}: {hint}nothing can be heard until it is there")
