"""Markdown, reduced to what is spoken: marks become blanks of the same length, however the text arrives."""

from __future__ import annotations

import itertools
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from talkcli.engine.markdown import MarkdownReader, blank_markdown

#: Markdown texts, and what is heard of them. Runs of blanks count as one blank.
CASES = {
    # emphasis, and what only looks like it
    "**Note:** it is *hot*, _very_ ***hot***": "Note: it is hot , very hot",
    "__init__ is ~~not~~ *one\nlong* word": "init is not one\nlong word",
    "**S**ystem, *强调*文字": "S ystem, 强调 文字",
    "2 * 3 * 4, 2*3*4, 2**3, a*b*c": "2 * 3 * 4, 2*3*4, 2**3, a*b*c",
    "snake_case_name, a_b, _private": "snake_case_name, a_b, _private",
    "5 €* per month\n\n*plus tax": "5 €* per month\n\n*plus tax",
    r"\*not emphasised\* and C:\dir": "*not emphasised * and C:\\dir",
    "~/path --option #1 C# 5 > 3 x < y $5 e.g. ~5": "~/path --option #1 C# 5 > 3 x < y $5 e.g. ~5",
    # code
    "Run `talk.say(*args)` or ``a`b``, `open": "Run talk.say(*args) or a`b , open",
    "So:\n\n```python\nprint('hi')\n# *done*\n```\n\nNow **you**": "So:\n\n\n\nNow you",
    "So\n~~~~\n~~~\n```\n~~~~\nnow": "So。\nnow",
    "- a\n  ```\n  x\n  ```\n- b": "a。\nb",
    "So:\n```\nnever closed": "So:",
    # links, images, footnotes, addresses
    'See [the *docs*](https://a.b/c_d "t"), [this][ref] or [foo (bar)](<x y>)': "See the docs , this or foo (bar)",
    "[Foo](https://en.org/Foo_(bar)) ![a cat](cat.png) [![Badge](b.svg)](x)": "Foo a cat Badge",
    "Look [1], [sic] [x] f[0](a, b) Wow![z](q)": "Look [1], [sic] [x] f[0](a, b) Wow! z",
    "Foo[^1] bar\n\n[^1]: A note\n[ref]: https://a.b 'x'\n[Anna]: Hello": "Foo bar\n\nA note。\n[Anna]: Hello",
    "<https://www.a.b/c_d_e> <me@a.b> https://a.b/c_d_e, www.a.b": "a.b/c_d_e me@a.b a.b/c_d_e, a.b",
    # HTML, emoji
    'a<br/>b <b>c</b> <a href="x > y">d</a> <!-- e --> List<String> <name>': "a b c d List<String> <name>",
    "Great! 😀 👩🏽‍🚀 🇩🇪 🏴󠁧󠁢󠁳󠁣󠁴󠁿 ❤️ 1️⃣ done ♯ ✓": "Great! 1 done ♯ ✓",
    # headings, rules, quotes
    "# Title\nText\n\n## More? ##\nText\n### C#\n\nText": "Title。Text\n\nMore?\nText。 C#\n\nText",
    "Title\n=====\nText\n\n---\n***\n* * *\nText": "Title。\nText\n\n\n\n\nText",
    "> quoted *text\n> more*\n>> deeper": "quoted text\nmore\ndeeper",
    # lists
    "Buy:\n- milk\n- *eggs*!\n+ tea\n  or 2\n* [ ] salt\n• [x] oil": "Buy:\nmilk。 eggs !\ntea\nor 2。 salt。 oil",
    "1. one\n2. two\n   more\n10) ten": "1， one。2， two\nmore。10， ten",
    "It was in\n2024. On\n3. Mai, in\n- 5 days": "It was in\n2024. On\n3. Mai, in。 5 days",
    # tables
    "| a | b |\n|---|:-:|\n| **1** |  |\n|x|y.|\nend": "a ， b 。\n1 ，\nx，y.\nend",
    "a | b\n--|--\n1 | 2 \\| 3\n\nc | d": "a | b。\n1 ， 2 | 3\n\nc | d",
    # nothing to hear
    "": "",
    "---\n***": "",
    "😀 ![](x.png)": "",
}
MARKS = ["*", "**", "_", "`", "```", "~~", "[", "](a)", "!", "![", "<b>", "<", "|", "#", "# ", "- ", "1. ", "> ", "\\"]
PIECES = [*MARKS, "\n", "\n\n", " ", "a", "Word", "é", "3", ".", ":", "(", ")", "]", "---", "😀", "\u200d", "\ufe0f"]
TEXTS = st.lists(st.sampled_from([*PIECES, "https://a_b"]), max_size=40).map("".join)


@pytest.mark.parametrize("text", CASES)
def test_marks_become_blanks_and_everything_else_is_kept(text: str) -> None:
    found = blank_markdown(text)
    assert len(found) == len(text)
    assert "\n".join(" ".join(line.split()) for line in found.split("\n")).strip() == CASES[text]


@given(TEXTS, st.lists(st.integers(1, 6), min_size=1))
def test_the_result_has_the_same_length_and_does_not_depend_on_how_the_text_was_divided(
    text: str, sizes: list[int]
) -> None:
    reader, found, at, whole = MarkdownReader(), "", 0, blank_markdown(text)
    for size in itertools.cycle(sizes):
        if at >= len(text):
            break
        found += reader.read(text[at : at + size])
        at += size
        assert found == whole[: len(found)]
    found += reader.read("", ended=True)
    assert found == whole
    assert len(found) == len(text)
    assert {new for old, new in zip(text, found, strict=True) if old != new} <= {" ", "。", "，"}


@given(st.from_regex(r"([A-Za-zéß日本][A-Za-zéß日本0-9]*(?:[.,;:!?'’&%@/=()$€-]|\.{3})?[ \n])+", fullmatch=True))
def test_ordinary_text_is_unchanged(text: str) -> None:
    found = blank_markdown(text)
    assert found == text


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("Hello there", "Hello there"),
        ("Hello! ", "Hello! "),
        ("It is **ho", "It is   ho"),
        ("It is *ho", "It is "),
        ("It is *hot* ", "It is  hot  "),
        ("See [the docs](https://a", "See "),
        ("See [sic] ", "See [sic] "),
        ("Hello.\n", "Hello."),
        ("Hello.\n- ", "Hello."),
        ("So:\n```py\nx = 1\n", "So:\n            "),
    ],
)
def test_text_is_held_back_only_until_its_marks_are_known(text: str, known: str) -> None:
    reader = MarkdownReader()
    assert "".join(map(reader.read, text)) == known


@pytest.mark.parametrize(
    "block",
    ["plain text. ", "**a** *b* `e`\n- f\n\n", "*a ", "[a](b ", "[", "`a ", "<a ", "| a ", "```\nx\n", "> ", " "],
)
def test_a_long_text_takes_linear_time(block: str) -> None:
    text = "\n" + (block * 50_000)[:50_000] + "b"
    reader, began = MarkdownReader(), time.process_time()
    for at in range(0, len(text), 1_000):
        reader.read(text[at : at + 1_000])
    reader.read("", ended=True)
    assert time.process_time() - began < 0.6, "it usually takes less than 0.2 s"
