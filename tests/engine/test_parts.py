"""The pure parts of the engine process: players' command lines, their complaints, words and the word clock."""

from __future__ import annotations

from pathlib import Path

import pytest

from talkcli.cli import complete
from talkcli.engine.clock import TimedWord, WordClock
from talkcli.engine.players.base import AudioFailed
from talkcli.engine.players.complaint import LONGEST_LINE, Complaint
from talkcli.engine.players.program import ProgramPlayer
from talkcli.engine.players.programs import PACKAGES, PLAYERS, commands
from talkcli.engine.players.which import Players
from talkcli.engine.protocol import Voice
from talkcli.engine.synthesizers.voices import find_voice, unknown_voice
from talkcli.engine.synthesizers.words import Words


def _complaint(text: str) -> str | None:
    complaint = Complaint()
    for byte in text.encode():
        complaint.feed(bytes([byte]))
    return complaint.line()


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ("", None),
        ("underrun!!! (at least 12.3 ms long)\n", None),
        ("ALSA lib conf.c:5180:(snd_config_expand) Evaluate error: No such file or directory\n", None),
        (
            "aplay: main:831: audio open error: No such file or directory\n",
            "aplay: audio open error: No such file or directory",
        ),
        (
            "aplay: set_params:1416: Unable to install hw params:\nACCESS:  RW_INTERLEAVED\nFORMAT:  S16_LE\n",
            "aplay: Unable to install hw params:",
        ),
        ("Connection failure: Connection refused\n", "Connection failure: Connection refused"),
        ("Stream error: No such entity", "Stream error: No such entity"),
        ("hello\nworld\n", "hello"),
        ("hello\npw-cat: error: Host is down\n", "pw-cat: error: Host is down"),
        ("caf\udcff\n".encode("utf-8", "surrogateescape").decode("latin-1"), "cafÃ¿"),
    ],
)
def test_the_line_that_names_the_error_is_found(said: str, line: str | None) -> None:
    if line == "cafÃ¿":
        said, line = "caf\xe9\n", "café"
    assert _complaint(said) == line


def test_a_flood_of_standard_error_is_not_kept() -> None:
    complaint = Complaint()
    for _ in range(100):
        complaint.feed(b"x" * 10_000)
    assert complaint.line() == "x" * LONGEST_LINE


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
        (opens,) = Players(name, None).candidates(22050)
        player = opens()
        assert player.name == name
        assert not isinstance(player, ProgramPlayer)
        player.kill()
        assert player.gone()


def test_what_people_are_told_of_players_is_in_their_table() -> None:
    assert {name: each.about for name, each in PLAYERS.items()} == complete.PLAYERS
    told = " ".join((Path(__file__).parents[1] / "golden" / "help-serve.txt").read_text().split()).lower()
    for name in PACKAGES:
        assert f"for {name} {PLAYERS[name].devices}".lower() in told


def test_a_command_line_is_split_without_a_shell() -> None:
    (command,) = commands("/opt/my player -r{rate} '{device} x' $HOME", None, 22050, lambda _: True, None)
    assert command.argv == ("/opt/my", "player", "-r22050", "default x", "$HOME")
    assert command.name == "my"


@pytest.mark.parametrize("player", ["pacat", "sox -", "", "  ", "'"])
def test_a_player_that_is_not_there_is_an_error(player: str) -> None:
    with pytest.raises(AudioFailed) as caught:
        commands(player, None, 22050, lambda _: False, None)
    assert caught.value.reason == "no_player"


def test_words_only_move_forward() -> None:
    words = Words("this one é 日本 😀 ! battery")
    reported = [(0, 4), (0, 4), (5, 0), (9, 1), (-1, 0), (11, 2), (11, 2), (3, 2), (13, 1), (14, 1), (16, 11), (18, 7)]
    found = [words.next(*place) for place in reported]
    assert [(word.start, word.end) for word in found if word] == [
        (0, 4),
        (9, 10),
        (11, 13),
        (14, 15),
        (16, 17),
        (18, 25),
    ]
    assert [word.number for word in found if word] == [1, 2, 3, 4, 5, 6]


def test_a_word_beyond_the_text_is_none() -> None:
    words = Words("a")
    assert words.next(5, 3) is None
    assert words.next(0, 50) is not None


def test_the_clock_stands_until_it_is_started_and_is_held_back_by_the_player() -> None:
    clock = WordClock()
    first, second = TimedWord(0, 1, 0.0), TimedWord(2, 1, 0.5)
    clock.add(first)
    clock.add(second)
    assert clock.due(100.0) == []
    assert clock.next_due() is None
    clock.start(100.0)
    assert clock.due(100.0) == [first]
    assert clock.next_due() == 100.5
    clock.hold(100.4, 0.1)
    assert clock.elapsed(100.4) == pytest.approx(0.1)
    assert clock.due(100.6) == []
    assert clock.next_due() == pytest.approx(100.8)
    clock.hold(100.5, 10.0)
    assert clock.next_due() == pytest.approx(100.8)
    assert clock.rest() == [second]
    assert clock.due(200.0) == []


def test_silence_in_the_stream_moves_the_words_after_it_and_is_not_heard() -> None:
    clock = WordClock()
    before, at, after = TimedWord(0, 1, 0.4), TimedWord(2, 1, 0.5), TimedWord(4, 1, 1.0)
    clock.begin(0.0)
    clock.insert(0.0, 0.25)
    clock.start(100.0)
    clock.add(before)
    clock.add(at)
    assert clock.heard(100.125) == 0.0
    assert clock.heard(100.5) == 0.25
    assert clock.next_due() == pytest.approx(100.65)
    clock.insert(0.5, 1.0)
    clock.insert(0.5, 1.0)
    clock.add(after)
    assert clock.next_due() == pytest.approx(100.65)
    assert clock.due(102.5) == [before]
    assert clock.heard(102.5) == 0.5
    assert clock.next_due() == pytest.approx(102.75)
    assert clock.due(102.76) == [at]
    assert clock.heard(103.0) == pytest.approx(0.75)
    assert clock.next_due() == pytest.approx(103.25)


def test_another_stream_begins_where_the_audio_goes_on() -> None:
    clock = WordClock()
    missed, word = TimedWord(0, 1, 1.0), TimedWord(2, 1, 2.5)
    clock.start(100.0)
    clock.insert(0.5, 3.0)
    clock.begin(2.0)
    clock.add(missed)
    clock.add(word)
    assert clock.next_due() is None
    assert clock.heard(200.0) == 2.0
    clock.insert(2.0, 0.25)
    clock.start(200.0)
    assert clock.due(200.0) == [missed]
    assert clock.next_due() == pytest.approx(200.75)
    assert clock.heard(200.5) == pytest.approx(2.25)


def test_a_voice_is_found_by_id_name_or_language() -> None:
    voices = (Voice("gmw/en", "en-gb", "English"), Voice("gmw/en-US", "en-us", "English (America)"))
    assert find_voice("GMW/EN-us", voices) == voices[1]
    assert find_voice("english", voices) == voices[0]
    assert find_voice("en-US", voices) == voices[1]
    assert find_voice("fr", voices) is None
    assert unknown_voice("en-uk", voices).startswith('unknown voice "en-uk": did you mean ')
    assert unknown_voice("qqq", voices) == 'unknown voice "qqq": "talk voices" lists them'
