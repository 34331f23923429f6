"""Lines of JSON: splitting a stream into lines, their limits, and invalid JSON of all kinds."""

from __future__ import annotations

import contextlib
import itertools
import json
from typing import TYPE_CHECKING

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from talkcli.errors import BadRequest, LineTooLong
from talkcli.protocol.events import failure
from talkcli.protocol.lines import MAX_LINE_BYTES, LineSplitter, TruncatedLine, decode, encode

if TYPE_CHECKING:
    from talkcli.goals.goal import JsonObject

KIB = 1024

#: All characters except lone surrogates. In JSON, two of them in a row could be a surrogate pair.
whole_texts = st.text(st.characters(exclude_categories=["Cs"]))
texts = whole_texts | st.builds(
    lambda a, b, half: a + half + b, whole_texts, whole_texts, st.sampled_from("\ud800\udfff")
)
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**18), 10**18)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)
objects: st.SearchStrategy[JsonObject] = st.dictionaries(texts, values, max_size=5)

BAD_LINES = {
    "not JSON": (b"say hello", "bad_json"),
    "nothing": (b"", "bad_json"),
    "blanks": (b" \t\r", "bad_json"),
    "an array": (b"[]", "bad_json"),
    "an array of requests": (b'[{"request": "status"}]', "bad_json"),
    "a number": (b"5", "bad_json"),
    "a string": (b'"status"', "bad_json"),
    "null": (b"null", "bad_json"),
    "true": (b"true", "bad_json"),
    "half an object": (b'{"request": "say", "te', "bad_json"),
    "two objects": (b'{"request": "status"} {"request": "status"}', "bad_json"),
    "arrays 60,000 deep": (b"[" * 60_000, "bad_json"),
    "closed arrays 30,000 deep": (b"[" * 30_000 + b"]" * 30_000, "bad_json"),
    "objects 10,000 deep": (b'{"a":' * 10_000 + b"1" + b"}" * 10_000, "bad_json"),
    "an integer of 5,000 digits": (b'{"seq": ' + b"9" * 5_000 + b"}", "bad_json"),
    "a negative integer of 5,000 digits": (b'{"seq": -' + b"9" * 5_000 + b"}", "bad_json"),
    "a number too large for a float": (b'{"ttl": 1e999}', "bad_json"),
    "a negative number too large for a float": (b'{"ttl": -1e999}', "bad_json"),
    "a float of 5,000 digits": (b'{"ttl": ' + b"9" * 5_000 + b".0}", "bad_json"),
    "NaN": (b'{"ttl": NaN}', "bad_json"),
    "Infinity": (b'{"ttl": Infinity}', "bad_json"),
    "-Infinity": (b'{"ttl": -Infinity}', "bad_json"),
    "the same key twice": (b'{"request": "say", "text": "a", "text": "b"}', "bad_json"),
    "the same key twice in a nested object": (b'{"data": {"a": 1, "a": 1}}', "bad_json"),
    "invalid UTF-8": (b'{"request": "say", "text": "\xff"}', "bad_encoding"),
    "truncated UTF-8": (b'{"request": "say", "text": "\xe6\x97"}', "bad_encoding"),
    "a surrogate in UTF-8": (b'{"request": "say", "text": "\xed\xa0\x80"}', "bad_encoding"),
    "UTF-16": ('{"request": "status"}'.encode("utf-16"), "bad_encoding"),
    "NUL": (b"\0", "bad_json"),
    "NUL in a string": (b'{"request": "st\0tus"}', "bad_json"),
    "NUL after the object": (b'{"request": "status"}\0', "bad_json"),
    "an escape character in a string": (b'{"request": "\x1b"}', "bad_json"),
    "a byte order mark": (b'\xef\xbb\xbf{"request": "status"}', "bad_json"),
    "a TLS hello": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\x9a\xb4", "bad_encoding"),
    "an HTTP request": (b"GET / HTTP/1.1\r", "bad_json"),
}


@pytest.mark.parametrize(("line", "code"), BAD_LINES.values(), ids=BAD_LINES.keys())
def test_an_invalid_line_is_refused_with_an_error_code(line: bytes, code: str) -> None:
    with pytest.raises(BadRequest) as refused:
        decode(line)
    assert refused.value.code == code
    encode(failure(None, refused.value.code, refused.value.message))


def test_an_object_at_any_depth_of_nesting_is_read_or_refused() -> None:
    for depth in [*range(1, 40), *range(900, 1_100)]:
        with contextlib.suppress(BadRequest):
            assert isinstance(decode(b'{"a": ' + b"[" * depth + b"]" * depth + b"}"), dict)


json_pieces = st.sampled_from(
    [b"{", b"}", b"[", b"]", b'"', b":", b",", b"1", b"e999", b"-", b".", b"null", b"\\u", b"d8"]
)


@given(st.binary(max_size=40) | st.lists(json_pieces | st.binary(max_size=2), max_size=20).map(b"".join))
@example(b'{"a": 1e999}')
def test_any_bytes_are_read_as_an_object_or_refused(line: bytes) -> None:
    assert decode(encode(read(line))) == read(line)


def read(line: bytes) -> JsonObject:
    """Return the object in a line, or the server's error reply if there is none."""
    try:
        return decode(line)
    except BadRequest as refused:
        return failure(None, refused.code, refused.message)


@given(objects)
def test_an_object_is_written_as_one_line_and_read_back(message: JsonObject) -> None:
    line = encode(message)
    assert (line.endswith(b"\n"), line.count(b"\n")) == (True, 1)
    line.decode()
    assert decode(line) == message
    assert decode(line.rstrip(b"\n")) == message


@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_a_number_that_json_cannot_express_is_never_written(number: float) -> None:
    with pytest.raises(ValueError, match="float"):
        encode({"ttl": number})


# Splitting a stream into lines

LIMIT = 8

streams = st.lists(st.sampled_from([b"\n", b"a", b"\r", b"\xff", b"1234567", b"x" * 20]), max_size=30).map(b"".join)


def segments(stream: bytes, places: list[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[start:end] for start, end in itertools.pairwise(edges)]


@given(streams, st.lists(st.integers(0), max_size=20))
@example(b"12345678\n123456789\n" * 2, [3, 8, 9, 17, 20])
def test_any_segmentation_gives_the_same_lines(stream: bytes, places: list[int]) -> None:
    unlimited, limited = LineSplitter(), LineSplitter(LIMIT)
    lines, kept = [], []
    for segment in segments(stream, places):
        lines += unlimited.feed(segment)
        kept += limited.feed(segment)
        assert unlimited.size == limited.size
    *whole, rest = stream.split(b"\n")
    assert lines == whole
    assert unlimited.size == len(rest)
    assert unlimited.take_rest() == rest
    kept.append(limited.take_rest())
    assert kept == [line[:LIMIT] for line in (*whole, rest)]
    sizes = [*map(len, whole), len(rest)]
    assert [line.size if isinstance(line, TruncatedLine) else len(line) for line in kept] == sizes
    assert [isinstance(line, TruncatedLine) for line in kept] == [size > LIMIT for size in sizes]


@pytest.mark.parametrize("limit", [LIMIT, 100])
def test_a_splitter_can_be_used_again_after_its_rest_is_taken(limit: int) -> None:
    splitter = LineSplitter(limit)
    assert splitter.take_rest() == b""
    assert splitter.feed(b"123456789") == []
    assert splitter.take_rest() == b"123456789"[:limit]
    assert (splitter.size, splitter.take_rest()) == (0, b"")
    assert splitter.feed(b"a\nb") == [b"a"]


def test_only_the_start_of_an_endless_line_is_kept() -> None:
    splitter = LineSplitter(LIMIT)
    for _ in range(100):
        assert splitter.feed(b"x" * 65536) == []
    assert len(splitter._rest) == LIMIT
    assert splitter.size == 100 * 65536


def feed(stream: bytes, segment: int) -> list[bytes]:
    """Return the lines of a stream that arrives in segments of this size, including the incomplete last line."""
    splitter = LineSplitter(MAX_LINE_BYTES - 1)
    lines = [line for at in range(0, len(stream), segment) for line in splitter.feed(stream[at : at + segment])]
    return [*lines, splitter.take_rest()]


@pytest.mark.parametrize("segment", [7, 64 * KIB, 10 * KIB * KIB])
def test_the_longest_line_has_64_kib_including_its_newline(segment: int) -> None:
    assert MAX_LINE_BYTES == 64 * KIB
    line = b"a" * (64 * KIB - 1)
    assert feed(line + b"\n", segment) == [line, b""]
    too_long, _ = feed(line + b"a\n", segment)
    with pytest.raises(LineTooLong) as refused:
        decode(too_long)
    assert refused.value.code == "line_too_long"


@pytest.mark.parametrize("end", [b"", b"\n", b'\n{"request": "status"}\n'])
def test_lines_before_an_oversize_line_are_not_lost(end: bytes) -> None:
    first, blank, too_long, *_ = feed(b'{"request": "cancel"}\n\n' + b"[" * MAX_LINE_BYTES + end, 11)
    assert (first, blank) == (b'{"request": "cancel"}', b"")
    assert isinstance(too_long, TruncatedLine)


def test_the_longest_text_fits_into_a_line() -> None:
    for text in ("🤖" * 10_000, "日" * 10_000, "\x01" * 10_000, '"' * 10_000):
        assert len(encode({"seq": 1, "request": "say", "text": text, "wait": True})) <= MAX_LINE_BYTES


def test_json_from_other_writers_is_read() -> None:
    assert encode({"text": "é日🤖"}) == '{"text": "é日🤖"}\n'.encode()
    assert decode(b'{"seq": 18446744073709551615}') == {"seq": 2**64 - 1}
    for compact in (json.dumps({"text": "é"}), json.dumps({"text": "é"}, separators=(",", ":"), ensure_ascii=False)):
        assert decode(compact.encode() + b"\r") == {"text": "é"}
