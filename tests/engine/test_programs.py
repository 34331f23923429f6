"""Players that have a name: their table, which are tried, and the command lines of those that are programs."""

from __future__ import annotations

import pytest

from talkcli.engine import protocol
from talkcli.engine.players import PACKAGES, PLAYERS, commands
from talkcli.engine.players.base import CannotSpeak
from talkcli.engine.players.choice import Players
from talkcli.engine.players.program import ProgramPlayer


def _names(player: str | None, there: set[str], last: str | None = None) -> list[str]:
    return [command.name for command in commands(player, None, 22050, there.__contains__, last)]


def test_what_is_there_is_tried_and_what_worked_comes_first() -> None:
    there = {"aplay", "pw-cat", "pacat"}
    assert _names(None, there) == ["aplay", "pacat", "pw-cat"]
    assert _names(None, there, "pw-cat") == ["pw-cat", "aplay", "pacat"]
    assert _names(None, {"pacat"}) == ["pacat"]
    assert _names("pacat", there, "aplay") == ["pacat"]


@pytest.mark.parametrize(
    ("player", "expected"),
    [("aplay", ["-D", "usb"]), ("pacat", ["-d", "usb"]), ("pw-cat", ["--target=usb", "-"])],
)
def test_the_device_is_given_in_the_players_own_words(player: str, expected: list[str]) -> None:
    (command,) = commands(player, "usb", 16000, lambda _: True, None)
    assert list(command.argv[-len(expected) :]) == expected
    assert "16000" in " ".join(command.argv) or b"\x80\x3e\x00\x00" in command.preamble


def test_a_player_with_a_name_that_is_no_program_is_built_in() -> None:
    for name in PLAYERS.keys() - PACKAGES.keys():
        (opens,) = Players(protocol.Configure(0, None, name, None, None)).candidates(22050)
        player = opens()
        assert player.name == name
        assert not isinstance(player, ProgramPlayer)
        player.kill()
        assert player.gone()


def test_a_command_line_is_split_without_a_shell() -> None:
    (command,) = commands("/opt/my player -r{rate} '{device} x' $HOME", None, 22050, lambda _: True, None)
    assert command.argv == ("/opt/my", "player", "-r22050", "default x", "$HOME")
    assert command.name == "my"


@pytest.mark.parametrize("player", ["pacat", "sox -", "", "  ", "'"])
def test_a_player_that_is_not_there_is_an_error(player: str) -> None:
    with pytest.raises(CannotSpeak) as caught:
        commands(player, None, 22050, lambda _: False, None)
    assert caught.value.reason == "no_player"
