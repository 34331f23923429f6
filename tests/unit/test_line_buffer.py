"""The buffer of lines that were read from standard input and not sent yet, with their numbers and deadlines."""

from __future__ import annotations

from talkcli.cli.stdin import LineBuffer


def test_the_ttl_of_a_line_starts_when_its_newline_is_read() -> None:
    buffer = LineBuffer(ttl=10)
    for data, now in ((b"one\ntw", 100.0), (b"o\n\n", 103.0), (b"four", 104.0), (b"", 105.0)):
        buffer.feed(data, now)
    assert [(line.number, line.text) for line in buffer.take_expired(109.9)] == []
    assert [(line.number, line.text) for line in buffer.take_expired(110.0)] == [(1, "one")]
    assert buffer.first is not None
    assert (buffer.first.number, buffer.first.expires_at) == (2, 113.0)
    assert [(line.number, line.expires_at) for line in buffer.take_expired(1000.0)] == [(2, 113.0), (4, 115.0)]
    assert buffer.first is None
    assert buffer.ended


def test_expired_lines_are_taken_in_batches_so_that_signals_do_not_wait() -> None:
    buffer = LineBuffer(ttl=10)
    buffer.feed(b"a\n" * 2_500, 0.0)
    assert [len(list(buffer.take_expired(10.0))) for _ in range(4)] == [1_000, 1_000, 500, 0]


def test_without_a_ttl_no_line_expires() -> None:
    for ttl in (None, 0.0):
        buffer = LineBuffer(ttl)
        buffer.feed(b"one\n", 0.0)
        assert list(buffer.take_expired(1e9)) == []
        assert buffer.take().expires_at == float("inf")


def test_blank_lines_are_skipped_but_numbered_and_oversize_lines_are_kept() -> None:
    buffer = LineBuffer()
    buffer.feed(b"\n\r\n" + "\u3000\n".encode() + b"x" * 300_000 + b"\nlast", 0.0)
    buffer.feed(b"", 0.0)
    assert buffer.first is not None
    lines = [buffer.take() for _ in range(2) if buffer.first]
    assert [(line.number, line.oversize_bytes) for line in lines] == [(4, 300_000), (5, 0)]


def test_the_size_counts_bytes_that_are_not_yet_split_into_lines() -> None:
    buffer = LineBuffer(ttl=10)
    for _ in range(3):
        buffer.feed(b"a\n" * 100, 0.0)
    assert buffer.size == 600
    assert buffer.first
    assert buffer.size == 400
