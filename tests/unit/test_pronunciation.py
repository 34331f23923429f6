"""Pronunciations: which words match a term, where they come from, and how the file is read."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.pronunciation import MAX_FILE_BYTES, PronunciationFile, Pronunciations, parse_pronunciations
from talkcli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

TERMS = {
    "charger": "[[tS'A@dZ3]]",
    "GmbH": "gay em bay ha",
    "ROS": "ross",
    "ROS 2": "ross two",
    "C++": "see plus plus",
    ".NET": "dot net",
    "US": "you ess",
    "us": "uss",
    "café": "ka fay",
    "cafe": "coffee",
    "充电桩": "桩",
    "24/7": "all day",
}
#: Texts, and how they are said.
SAID = {
    # the longest whole words
    "ROS 2, ROS and ROS  2": "ross two, ross and ross two",
    "ROS\n2 ROS\n\n2": "ross two ross\n\n2",
    "ROS2 XROS ROS_x microROS": "ROS2 XROS ROS_x microROS",
    "ROS 2.5, ROS 2. 5:2 ROS-based": "ross 2.5, ross two. 5:2 ross-based",
    "GmbH's (GmbH) «GmbH»": "gay em bay ha's (gay em bay ha) «gay em bay ha»",
    "C++, .NET 24/7 124/7": "see plus plus, dot net all day 124/7",
    # accents, and scripts without blanks
    "café cafe\u0301 cafe\u0301s cafe": "ka fay cafe\u0301 cafe\u0301s coffee",
    "我去充电桩了": "我去桩了",
    # a term without capital letters matches any case, and an exact match comes first
    "gmbh GMBH US us Us CAFÉ": "gmbh GMBH you ess uss uss ka fay",
    # a sender's brackets are text
    "[[h@'loU]] [ROS]": "[[h@'loU]] [ross]",
    "A [[b]] Charger": "A ((b)) [[tS'A@dZ3]]",
    "(charger), charger-x": "( [[tS'A@dZ3]] ), [[tS'A@dZ3]] -x",
    "nothing": "nothing",
}


@pytest.mark.parametrize("text", SAID)
def test_terms_are_replaced_as_whole_words(text: str) -> None:
    spoken = Pronunciations(TERMS).apply(text)
    assert (spoken.text, spoken.has_phonemes, spoken.end) == (SAID[text], "tS" in SAID[text], len(text))


BRACKETS = str.maketrans("[]", "()")
WORDS = st.sampled_from(["ROS", "2", "ROS 2", "charger", "GmbH", "a", "é", "[", "-", ",", " ", "\n", "桩", "充电桩"])


@given(st.lists(WORDS, max_size=12).map("".join), st.integers(0, 20), st.integers(0, 20))
def test_each_word_of_the_spoken_text_is_located_in_the_sent_text(text: str, start: int, length: int) -> None:
    end = min(len(text), start + length)
    spoken = Pronunciations(TERMS).apply(text, min(start, end), end)
    places = [(said, spoken.locate(at, 1)) for at, said in enumerate(spoken.text)]
    assert places == sorted(places, key=lambda each: each[1])
    kept = [(said, text[place]) for said, (place, chars) in places if chars == 1 and not said.isspace()]
    assert [said.translate(BRACKETS) for said, _ in kept] == [sent.translate(BRACKETS) for _, sent in kept]
    terms = {" ".join(text[place:][:chars].split()) for _, (place, chars) in places if chars > 1}
    assert terms <= TERMS.keys()


def test_a_part_ends_after_a_term_that_it_would_cut() -> None:
    text = "now ROS 2 drives"
    spoken = Pronunciations(TERMS).apply(text, 4, 7)
    assert (spoken.text, spoken.end) == ("ross two", 9)
    assert Pronunciations(TERMS).apply(text, 9).text == " drives"
    assert Pronunciations(TERMS).apply("xcharger", 1).text == "charger"


def test_replacements_lengthen_a_text_by_a_limited_number_of_characters() -> None:
    spoken = Pronunciations({"a": "b" * 200}).apply("a " * 5_000)
    assert 10_000 < len(spoken.text) <= 20_300
    assert spoken.text.endswith("a a a ")


@pytest.mark.parametrize("text", ["a " * 5_000, "a" + " " * 9_999, "a b " * 2_500])
def test_many_similar_terms_are_found_quickly_in_a_long_text(text: str) -> None:
    began = time.monotonic()
    assert Pronunciations({f"a {number}": "x" for number in range(1_500)}).apply(text).text == text
    assert time.monotonic() - began < 2


FILE = """\ufeff# names of the site

charger = a-[[tS'A@dZ3]]-b
 ROS  2=ross = two\r
faulty
xy =
= z
half = [[x
bracket = a [b]
accent = [[é]]
charger = again
control = \x07
long = {}
""".format("x" * 201)
FAULTS = {
    **dict.fromkeys((5, 6, 7), "write it like this: WORD = how it is said"),
    **dict.fromkeys((8, 9, 10), "phonemes are 1 to 60 ASCII characters between [[ and ]]"),
    11: "'charger' is already in an earlier line",
    12: "it has a control character, or is not valid UTF-8",
    13: "it has more than 200 characters",
    14: "it has a control character, or is not valid UTF-8",
}


def test_faulty_lines_are_named_and_left_out() -> None:
    terms, faults = parse_pronunciations(FILE.encode() + b"b\xe9 = x")
    assert terms == {"charger": "a- [[tS'A@dZ3]] -b", "ROS 2": "ross = two"}
    assert faults == [f"line {number}: {fault}" for number, fault in FAULTS.items()]


def test_a_changed_file_is_read_again_and_a_lost_one_is_reported_once(tmp_path: Path) -> None:
    path, log = tmp_path / "names.txt", list[str]()

    def refresh() -> tuple[Mapping[str, str], list[str]]:
        log.clear()
        return file.refresh().terms, log

    path.write_text("a = b\nfaulty\n" * 12)
    file = PronunciationFile(str(path), log.append)
    fault = "line 2: write it like this: WORD = how it is said"
    assert (len(log), log[0]) == (10, f"{path}, {fault}; the line is left out")
    assert refresh() == ({"a": "b"}, [])
    path.write_text("a = c\n")
    assert refresh() == ({"a": "c"}, [])
    path.unlink()
    problem = "can't be read: No such file or directory"
    assert refresh() == ({"a": "c"}, [f"{path} {problem}; the terms that were read last stay in use"])
    assert refresh() == ({"a": "c"}, [])
    assert file.describe() == {"file": str(path), "terms": 1, "problems": [problem]}
    os.mkfifo(path)
    assert "it is not a regular file" in refresh()[1][0]
    assert refresh() == ({"a": "c"}, [])
    path.unlink()
    path.write_text("a = d\nfaulty\n")
    assert file.describe() == {"file": str(path), "terms": 1, "problems": [fault]}
    assert refresh() == ({"a": "d"}, [])


@pytest.mark.parametrize("kind", ["missing", "directory", "pipe", "device", "large"])
def test_a_file_that_cannot_be_read_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path = tmp_path / kind
    if kind == "directory":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(MAX_FILE_BYTES + 1)
    began = time.monotonic()
    with pytest.raises(UsageError, match=r"^--pronounce: .* can't be read: "):
        PronunciationFile("/dev/zero" if kind == "device" else str(path), print)
    assert time.monotonic() - began < 1
