"""Which requests send a growing text, without a server."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.cli.command import replace_bad_bytes
from talkcli.cli.stream import InputDecoder
from talkcli.client.growing import TextSender
from talkcli.goals.options import MAX_TEXT_CHARS, Append, Say

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

#: Ends the text in the tables below.
END = None
FACE = "\N{GRINNING FACE}"
LONG = "x" * MAX_TEXT_CHARS


def sent(sender: TextSender) -> Iterator[Say | Append]:
    """Accept and yield all requests that can be sent now."""
    while request := sender.request_to_send():
        assert sender.request_to_send() is request  # it can be sent again until it is answered
        sender.accepted("a")
        yield request


def requests(writes: Iterable[str | None]) -> list[list[Say | Append]]:
    """Return the requests that follow from each write."""
    sender = TextSender(Say("", more=True, rate=80))
    found = []
    for text in writes:
        if text is END:
            sender.ended = True
        else:
            sender.write(text)
        found.append(list(sent(sender)))
        assert sender.finished == (text is END)
    return found


def say(text: str, *, more: bool = True) -> Say:
    return Say(text, more=more, rate=80)


@pytest.mark.parametrize(
    ("writes", "expected"),
    [
        (["Hel", "lo", END], [[say("Hel")], [Append("a", "lo", 3)], [Append("a", "", 5, end=True)]]),
        (["", " ", "\n\u200b", "Hi", " ", END], [
            [], [], [], [say(" \n\u200bHi")], [Append("a", " ", 5)], [Append("a", "", 6, end=True)],
        ]),
        ([END], [[say("", more=False)]]),
        ([" ", END], [[], [say(" ", more=False)]]),
        (["\ud83d", "\ude00 ", "a\ud83d", "\ude00", END], [
            [], [say(f"{FACE} ")], [Append("a", "a", 2)], [Append("a", FACE, 3)], [Append("a", "", 4, end=True)],
        ]),
        (["a", "\ude00", "b\ud83d", END], [
            [say("a")], [Append("a", "\ude00", 1)], [Append("a", "b", 2)], [Append("a", "\ud83d", 3, end=True)],
        ]),
        ([LONG + "abc", END], [[say(LONG), Append("a", "abc", MAX_TEXT_CHARS)], [
            Append("a", "", MAX_TEXT_CHARS + 3, end=True),
        ]]),
        ([" " * MAX_TEXT_CHARS + "a"], [[say(" " * MAX_TEXT_CHARS), Append("a", "a", MAX_TEXT_CHARS)]]),
    ],
    ids=["tokens", "blanks first", "nothing", "blanks", "pairs", "lone halves", "long", "long blanks"],
)  # fmt: skip
def test_text_is_sent_at_once_if_it_can_be_spoken(writes: list[str | None], expected: list[list[Say | Append]]) -> None:
    assert requests(writes) == expected


@given(st.lists(st.text(st.sampled_from(f"a \n{FACE}é"), max_size=4)))
def test_the_server_gets_the_whole_text_with_its_offsets(writes: list[str]) -> None:
    text = ""
    last = True
    for request in [each for some in requests([*writes, END]) for each in some]:
        if isinstance(request, Append):
            assert request.at == len(text)
        text += request.text
        last = request.end if isinstance(request, Append) else not request.more
    assert text == "".join(writes)
    assert last


def test_text_that_the_server_refused_is_dropped() -> None:
    sender = TextSender(Say("", more=True))
    sender.write("One. ")
    sender.request_to_send()
    sender.accepted("a")
    sender.write("\0")
    sender.request_to_send()
    sender.refused()
    assert sender.request_to_send() is None
    sender.write("Two.")
    assert sender.request_to_send() == Append("a", "Two.", 5)


# Standard input


@pytest.mark.parametrize(
    ("pieces", "expected", "problem"),
    [
        ([b"Hel", b"lo"], ["Hel", "lo", ""], None),
        ([b"\xc3", b"\xa4", b"\xf0\x9f", b"\x98\x80!"], ["", "ä", "", f"{FACE}!", ""], None),
        ([b"a\n", b"\r\n", b"b\n\n"], ["a", "", "\n\r\nb", ""], None),
        ([b"a" + b"\n" * 101, b"b"], ["a" + "\n" * 101, "b", ""], None),
        ([b"ab\ncd\xff", b"\xfe"], ["ab\ncd\ufffd", "\ufffd", ""], "line 2, column 3: the byte 0xff"),
        ([b"caf\xc3"], ["caf", "\ufffd"], "line 1, column 4: the byte 0xc3"),
    ],
    ids=["pieces", "split characters", "line breaks", "many line breaks", "invalid", "invalid end"],
)
def test_input_is_decoded_piece_by_piece(pieces: list[bytes], expected: list[str], problem: str | None) -> None:
    decoder = InputDecoder()
    assert [decoder.decode(each) for each in [*pieces, b""]] == expected
    assert (decoder.problem or "").startswith(problem or "")
    assert (decoder.problem is None) == (problem is None)


@given(st.binary(max_size=30), st.lists(st.integers(0, 30), max_size=5))
def test_the_text_does_not_depend_on_how_the_input_is_split(data: bytes, places: list[int]) -> None:
    ends = [*sorted(places), len(data)]
    decoder = InputDecoder()
    pieces = [data[start:end] for start, end in zip([0, *ends], ends, strict=False)]
    text = "".join(decoder.decode(each) for each in [*filter(None, pieces), b""])
    # `talk say -` reads the whole input in the same way.
    assert text == replace_bad_bytes(data.decode(errors="surrogateescape").rstrip("\r\n"))[0]
