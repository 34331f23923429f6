"""The buffer of lines that were read from standard input and not sent yet, with their numbers and deadlines."""

from __future__ import annotations

from talkcli.cli.stdin import LineBuffer


def test_a_line_has_its_ttl_from_when_its_newline_was_read() -> None:
    buffer = LineBuffer(ttl=10)
    for data, now in ((b"one\ntw", 100.0), (b"o\n\n", 103.0), (b"four", 104.0), (b"", 105.0)):
        buffer.feed(data, now)
    assert [(each.number, each.text) for each in buffer.take_expired(109.9)] == []
    assert [(each.number, each.text) for each in buffer.take_expired(110.0)] == [(1, "one")]
    assert buffer.first is not None
    assert (buffer.first.number, buffer.first.end) == (2, 113.0)
    assert [(each.number, each.end) for each in buffer.take_expired(1000.0)] == [(2, 113.0), (4, 115.0)]
    assert buffer.first is None
    assert buffer.ended


def test_no_more_late_lines_are_taken_at_once_than_a_signal_can_wait_for() -> None:
    buffer = LineBuffer(ttl=10)
    buffer.feed(b"a\n" * 2_500, 0.0)
    assert [len(list(buffer.take_expired(10.0))) for _ in range(4)] == [1_000, 1_000, 500, 0]


def test_without_a_ttl_no_line_is_ever_late() -> None:
    for ttl in (None, 0.0):
        buffer = LineBuffer(ttl)
        buffer.feed(b"one\n", 0.0)
        assert list(buffer.take_expired(1e9)) == []
        assert buffer.take().end == float("inf")


def test_lines_without_a_word_and_lines_that_are_too_long_keep_their_numbers() -> None:
    buffer = LineBuffer()
    buffer.feed(b"\n\r\n" + "\u3000\n".encode() + b"x" * 300_000 + b"\nlast", 0.0)
    buffer.feed(b"", 0.0)
    assert buffer.first is not None
    found = [buffer.take() for _ in range(2) if buffer.first]
    assert [(each.number, each.oversize_bytes) for each in found] == [(4, 300_000), (5, 0)]


def test_what_waits_is_counted_until_it_is_cut_into_lines() -> None:
    buffer = LineBuffer(ttl=10)
    for _ in range(3):
        buffer.feed(b"a\n" * 100, 0.0)
    assert buffer.size == 600
    assert buffer.first
    assert buffer.size == 400
