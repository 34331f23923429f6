"""Lines from any segmentation of a stream, and how much is kept of one that is too long."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from talkcli.protocol.lines import Cut, LineSplitter

MOST = 8

streams = st.lists(st.sampled_from([b"\n", b"a", b"\r", b"\xff", b"1234567", b"x" * 20]), max_size=30).map(b"".join)


def segments(stream: bytes, places: list[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[start:end] for start, end in itertools.pairwise(edges)]


@given(streams, st.lists(st.integers(0), max_size=20))
@example(b"12345678\n123456789\n" * 2, [3, 8, 9, 17, 20])
def test_any_segmentation_gives_the_same_lines(stream: bytes, places: list[int]) -> None:
    everything, beginnings = LineSplitter(), LineSplitter(MOST)
    lines, kept = [], []
    for segment in segments(stream, places):
        lines += everything.feed(segment)
        kept += beginnings.feed(segment)
        assert everything.size == beginnings.size
    *whole, rest = stream.split(b"\n")
    assert lines == whole
    assert everything.size == len(rest)
    assert everything.end() == rest
    kept.append(beginnings.end())
    assert kept == [line[:MOST] for line in (*whole, rest)]
    assert [each.size if isinstance(each, Cut) else len(each) for each in kept] == [*map(len, whole), len(rest)]
    assert all(isinstance(each, Cut) == (len(line) > MOST) for each, line in zip(kept, (*whole, rest), strict=True))


@pytest.mark.parametrize("most", [MOST, 100])
def test_a_stream_goes_on_after_its_end(most: int) -> None:
    splitter = LineSplitter(most)
    assert splitter.end() == b""
    assert splitter.feed(b"123456789") == []
    assert splitter.end() == b"123456789"[:most]
    assert (splitter.size, splitter.end()) == (0, b"")
    assert splitter.feed(b"a\nb") == [b"a"]


def test_a_line_that_never_ends_is_not_kept() -> None:
    splitter = LineSplitter(MOST)
    for _ in range(100):
        assert splitter.feed(b"x" * 65536) == []
    assert len(splitter._begun) == MOST
    assert splitter.size == 100 * 65536


def test_ten_thousand_blank_lines_are_ten_thousand_lines() -> None:
    assert LineSplitter().feed(b"\n" * 10_000) == [b""] * 10_000
