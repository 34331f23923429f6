"""Makes texts that nobody would say: sentences of many scripts and known crashers, mutated, without end.

Pure: all that it makes depends on the seed alone. It must not know the guard, whose author has seen it: `dated` makes
texts that he has not.
"""

from __future__ import annotations

import datetime as dt
import random
import sys
import unicodedata
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from talkcli.goals.text import fault

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

#: Sentences as people write them.
SENTENCES = (
    "Battery low, returning to the docking station.",
    "It's 10:30 on 2024-05-01; the U.S.A. and e.g. Mr. Smith's well-known e-mail: a.b@example.org (see http://x.y/z?a=1).",
    "Die Tür zum Wohnzimmer ist geöffnet, bitte schließen Sie sie z. B. bis 17:45 Uhr.",
    "L’homme est là, n'est-ce pas ? C’est « très bien ».",
    "El robot llegó a la cocina. ¿Qué quiere usted? ¡Ay, niño!",
    "Dell'acqua c'è, però l'ho già bevuta.",
    "A bateria está fraca; não há ninguém em casa às 8h.",
    "Bateria jest słaba, wracam do stacji dokującej. Źdźbło, gżegżółka.",
    "Příliš žluťoučký kůň úpěl ďábelské ódy.",
    "Батарея разряжена, возвращаюсь на станцию: т.е. к 5-му ч.",
    "Η μπαταρία είναι χαμηλή, επιστρέφω στη βάση.",
    "البطارية منخفضة، سأعود إلى القاعدة ٣ مرات.",
    "הסוללה חלשה, אני חוזר לבסיס.",
    "बैटरी कम है, मैं वापस जा रहा हूँ।",
    "ব্যাটারি কম, আমি ফিরে যাচ্ছি।",
    "பேட்டரி குறைவாக உள்ளது.",
    "బ్యాటరీ తక్కువగా ఉంది.",
    "ബാറ്ററി കുറവാണ്, ഞാൻ മടങ്ങുന്നു.",
    "แบตเตอรี่อ่อน กำลังกลับฐาน",
    "电池电量低，正在返回充电站。",
    "バッテリー残量が少ないです。充電に戻ります。",
    "배터리가 부족합니다. 충전소로 돌아갑니다.",
    "Pin yếu, tôi đang trở về trạm sạc.",
    "Pil zayıf, İstanbul'a dönüyorum.",
    "ბატარეა დაბალია, ვბრუნდები.",
    "Մարտկոցը ցածր է։ Վերադառնում եմ՞",
    "ባትሪው ዝቅተኛ ነው።",
    "Donaudampfschifffahrtselektrizitätenhauptbetriebswerkbauunterbeamtengesellschaft",
    "lentokonesuihkuturbiinimoottoriapumekaanikkoaliupseerioppilas",
    "1,234,567.89 € + 50% = 3/4 ≈ ½ × 10⁻³ °C, № 5 & §7",
    "👩‍🚀 🤖 👨‍👩‍👧‍👦 🏳️‍🌈 ok",
    "MMXXIV XLIV iv II. ABCs NASA's iPhone fooBar foo_bar",
)
#: Texts that kill some version of libespeak-ng, and what looks like a command to it.
CRASHERS = (
    "a." * 85,
    "e.g. " * 60,
    "http://" + "x." * 100,
    "\x01s\x01100A\x01VX \x01B1",
    "<speak><audio src='x'/><voice name='de'>hallo</voice></speak>",
    "[[h@'loU]] [[_^_de]]",
    "e\u0301" * 90 + "\u0301" * 90,
    "a" * 170 + "ing",
    "1" * 130 + "," + "1," * 40,
    "\u0530\u0557\ue000\ue028",
)
_PIECES = (
    *(
        ".",
        ",",
        "'",
        "-",
        "_",
        "^",
        "…",
        "!?",
        "。",
        "՞",
        "\u2019",
        "\n",
        "\n\n",
        "\t",
        " ",
        "  ",
        "«",
        "(",
        '"',
        "/",
        "*",
    ),
    *(
        "\x01",
        "\x01+10S",
        "\x01V",
        "\x02",
        "\x7f",
        "\x85",
        "\xa0",
        "\xad",
        "\u200b",
        "\u200d",
        "\ufe0f",
        "\u202e",
        "\ufeff",
    ),
    *(
        "\u0301",
        "\u0327",
        "\u064b",
        "\u0e49",
        "\u0530",
        "\u0557",
        "\ue000",
        "\ufffd",
        "\uffff",
        "\U0001f3fb",
        "\U0010ffff",
    ),
    *(
        "a.",
        "I.",
        "1.",
        "x@",
        "://",
        "0",
        "000",
        "1,000",
        "½",
        "²",
        "IV",
        "Mr.",
        "'s",
        "ß",
        "ſ",
        "ı",
        "İ",
        "ﬁ",
        "㎏",
        "Ⅷ",
        "&#x41;",
        "<a>",
    ),
)
_BLANKS = (".", ",", "", "-", ". ", " . ", "'", "\u00a0", "_", "\n")
#: Characters that a text has at most, most of the time, often enough, and now and then: a long one takes a hundred
#: times as long to speak, and few ways to kill the library need one.
_SHORT, _MEDIUM, _LONG = 24, 220, 1500


@dataclass(frozen=True, slots=True)
class Case:
    """A text, and the voice that is to speak it."""

    voice: str
    text: str


def dated() -> int:
    """Return a seed that nobody has seen before today."""
    return dt.datetime.now(dt.timezone.utc).date().toordinal()


def cases(seed: int, voices: Sequence[str], same_voice: int = 20) -> Iterator[Case]:
    """Return cases without end; a voice speaks some of them before it is another's turn, and all have their turn."""
    source = random.Random(seed)
    while True:
        for voice in source.sample(voices, len(voices)):
            for _ in range(same_voice):
                yield Case(voice, _valid(source))


def _valid(source: random.Random) -> str:
    """Return a text that the server would take."""
    while True:
        text = made(source)
        if fault(text) is None:
            return text


def made(source: random.Random) -> str:
    """Return one mutated text."""
    longest = source.choices((_SHORT, _MEDIUM, _LONG), (78, 20, 2))[0]
    text = source.choice(_ORIGINS)(source)[:longest]
    for _ in range(source.choice((0, 1, 1, 2, 3, 5, 8))):
        if not text:
            break
        text = source.choice(_MUTATIONS)(source, text)[:longest]
    return text


# -- what is mutated


def _sentence(source: random.Random) -> str:
    return source.choice(SENTENCES)


def _crasher(source: random.Random) -> str:
    return source.choice(CRASHERS)


def _salad(source: random.Random) -> str:
    """Words of several languages, as a robot that reads out names has them."""
    words = [source.choice(_sentence(source).split()) for _ in range(source.randrange(1, 12))]
    return source.choice((" ", " ", ".", "", "-", ", ")).join(words)


def _of_one_block(source: random.Random) -> str:
    """Neighbours in the Unicode tables, with blanks here and there."""
    assigned = _assigned()
    start = source.randrange(len(assigned))
    block = assigned[start : start + source.choice((3, 20, 100))]
    letters = [source.choice(block) for _ in range(source.randrange(1, 150))]
    for place in range(source.randrange(2, 12), len(letters), source.randrange(2, 12)):
        letters[place] = source.choice(" .,-")
    return "".join(letters)


def _of_all_blocks(source: random.Random) -> str:
    assigned = _assigned()
    return "".join(source.choice(assigned) for _ in range(source.randrange(1, 60)))


def _of_pieces(source: random.Random) -> str:
    return "".join(source.choice(_PIECES) for _ in range(source.randrange(1, 40)))


def _repeated(source: random.Random) -> str:
    """A short motif again and again: what fills a table or a buffer."""
    motif = source.choice((_of_pieces, _of_all_blocks, _sentence, _salad))(source)
    start = source.randrange(len(motif) + 1)
    motif = motif[start : start + source.randrange(1, 6)] + source.choice(_BLANKS) * source.randrange(2)
    return motif * source.choice((5, 30, 90, 130, 220)) if motif else "a"


@cache
def _assigned() -> str:
    """Return the characters that have a meaning; of the 90,000 of Chinese and Korean, which are all alike, some."""
    found = []
    for code in range(1, sys.maxunicode + 1):
        category = unicodedata.category(chr(code))
        if category in {"Cn", "Cs", "Co"} or (0x3400 <= code < 0xA000 or 0x17000 <= code < 0x19000 or code > 0x1FFFF):
            if category == "Lo" and code % 97 == 0:
                found.append(chr(code))
            continue
        if 0xAC00 <= code < 0xD7A4 and code % 31:
            continue
        found.append(chr(code))
    return "".join(found)


# -- how it is mutated


def _doubled(source: random.Random, text: str) -> str:
    place = source.randrange(len(text))
    piece = text[place : place + source.randrange(1, 8)]
    return text[:place] + piece * source.choice((2, 3, 10, 50, 100)) + text[place:]


def _cut(source: random.Random, text: str) -> str:
    place = source.randrange(len(text))
    return text[:place] + text[place + source.randrange(1, 12) :]


def _with_piece(source: random.Random, text: str) -> str:
    place = source.randrange(len(text) + 1)
    return text[:place] + source.choice(_PIECES) * source.choice((1, 1, 1, 3, 40)) + text[place:]


def _spliced(source: random.Random, text: str) -> str:
    other = source.choice(_ORIGINS)(source)
    return text[: source.randrange(len(text) + 1)] + other[source.randrange(len(other) + 1) :]


def _other_blanks(source: random.Random, text: str) -> str:
    return text.replace(" ", source.choice(_BLANKS))


def _spelled(source: random.Random, text: str) -> str:
    return source.choice((".", " ", ". ", "-", "'", "\u0301", "\u200d", ",", "_")).join(text)


def _interspersed(source: random.Random, text: str) -> str:
    piece, every = source.choice(_PIECES), source.randrange(1, 9)
    return piece.join(text[at : at + every] for at in range(0, len(text), every))


def _cased(source: random.Random, text: str) -> str:
    return source.choice((str.upper, str.title, str.swapcase, str.lower))(text)


def _normalised(source: random.Random, text: str) -> str:
    return unicodedata.normalize(source.choice(("NFD", "NFKD", "NFC")), text)


def _backwards(_: random.Random, text: str) -> str:
    return text[::-1]


def _changed(source: random.Random, text: str) -> str:
    letters = list(text)
    for _ in range(source.choice((1, 2, 8))):
        other = source.choice((source.choice(_assigned()), chr(source.randrange(1, 0x250))))
        letters[source.randrange(len(letters))] = other
    return "".join(letters)


_ORIGINS: tuple[Callable[[random.Random], str], ...] = (
    *(_sentence, _sentence, _crasher, _salad, _of_one_block, _of_all_blocks, _of_pieces, _repeated),
)
_MUTATIONS: tuple[Callable[[random.Random, str], str], ...] = (
    *(_doubled, _cut, _with_piece, _with_piece, _spliced, _other_blanks, _spelled, _interspersed, _cased, _normalised),
    *(_backwards, _changed),
)


# -- what kills the library for certain, or nearly so


def crashers(source: random.Random) -> Iterator[tuple[str | None, str]]:
    """Return texts of each known kind in turn, without end, with the voice where one is needed."""
    while True:
        between = source.choice((".", ". ", ".,", " . ", "..", ".՞", ".;"))
        before = source.choice(("", "Hello, ", "http://", "5 ", "« "))
        yield None, before + "".join(_letter(source) + between for _ in range(source.randrange(95, 180)))
        yield None, before + f"{_letter(source)}.{_letter(source) * source.randrange(165, 300)}"
        ending = source.choice(("ing", "s", "er", "en", "erne"))
        yield "gmq/da", before + source.choice("abdeoåø") * source.randrange(165, 400) + ending
        sign = source.choice(("'", "…", "°", "_", "₤", "–"))
        yield source.choice(("aav/vi", "gmq/da")), source.choice(("", "xin! ", " ")) + f"{sign}-{source.choice('oaie')}"
        yield "gmw/en", before + _letter(source) + "'s" * source.randrange(80, 200)


def _letter(source: random.Random) -> str:
    return source.choice("abcdefghijklmnopqrstuvwxyzéßжшλ")
