"""Speak mutated texts with all voices in engine processes, as `say -o` does, and count the crashes.

    python -m tests.tools.fuzz_texts --count 20000 [--seed N | --seed today] [--seconds N] [--growing]

It prints each text that crashed a process as a Python literal. The exit code is 1 if a goal didn't have exactly one
end, if a process hung or printed a traceback, if a word isn't in its place, or if a text overflowed a buffer in spite
of the guard. The texts only depend on the seed. They must not depend on the guard. With `--growing`, each text is sent
in pieces of a few characters while it is spoken.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime as dt
import itertools
import os
import random
import sys
import tempfile
import time
import unicodedata
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING
from unittest import mock

from talkcli.engine import protocol
from talkcli.engine.parent import process
from talkcli.engine.parent.process import EngineFailed, PrivateEngine
from talkcli.goals.options import bad_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

#: Words per minute. The fastest rate makes the fewest samples.
_RATE = 450
#: Much longer than the longest text takes, so that a busy machine doesn't cause a failure.
_START_LIMIT_S, _HANG_LIMIT_S = 20.0, 60.0
#: Pause between two pieces after which the end of the first piece may end a sentence, and how often there is a pause.
_PAUSE_S, _PAUSE_CHANCE = 0.12, 0.02
#: Signal that ends a process that wrote past the end of a buffer. The guard must prevent this.
OVERFLOW = "SIGABRT"
_WITHOUT_GUARD = "from talkcli.engine.child.synthesizers import guard; guard.guarded = lambda text, voice: text; "
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
#: Texts that crash some version of libespeak-ng, and texts that look like commands to it.
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
    *(".", ",", "'", "-", "_", "^", "…", "!?", "。", "՞", "\u2019", "\n", "\n\n", "\t", " ", "  ", "«", "("),
    *('"', "/", "*", "\x01", "\x01+10S", "\x01V", "\x02", "\x7f", "\x85", "\xa0", "\xad", "\u200b", "\u200d"),
    *("\ufe0f", "\u202e", "\ufeff", "\u0301", "\u0327", "\u064b", "\u0e49", "\u0530", "\u0557", "\ue000"),
    *("\ufffd", "\uffff", "\U0001f3fb", "\U0010ffff", "a.", "I.", "1.", "x@", "://", "0", "000", "1,000", "½"),
    *("²", "IV", "Mr.", "'s", "ß", "ſ", "ı", "İ", "ﬁ", "㎏", "Ⅷ", "&#x41;", "<a>"),
)
_BLANKS = (".", ",", "", "-", ". ", " . ", "'", "\u00a0", "_", "\n")
#: Most texts are short. Long texts take a hundred times as long, and few crashes need them.
_SHORT_CHARS, _MEDIUM_CHARS, _LONG_CHARS = 24, 220, 1500


@dataclass(frozen=True, slots=True)
class Case:
    voice: str
    text: str


def daily_seed() -> int:
    return dt.datetime.now(dt.timezone.utc).date().toordinal()


def cases(seed: int, voices: Sequence[str]) -> Iterator[Case]:
    """Yield valid texts for all voices, twenty for each voice in turn."""
    source = random.Random(seed)
    while True:
        for voice in source.sample(voices, len(voices)):
            for _ in range(20):
                while bad_text(text := random_text(source)) is not None:
                    pass
                yield Case(voice, text)


def random_text(source: random.Random) -> str:
    limit = source.choices((_SHORT_CHARS, _MEDIUM_CHARS, _LONG_CHARS), (78, 20, 2))[0]
    text = source.choice(_ORIGINS)(source)[:limit]
    for _ in range(source.choice((0, 1, 1, 2, 3, 5, 8))):
        if not text:
            break
        text = source.choice(_MUTATIONS)(source, text)[:limit]
    return text


# -- original texts


def _sentence(source: random.Random) -> str:
    return source.choice(SENTENCES)


def _words_of_several_languages(source: random.Random) -> str:
    words = [source.choice(_sentence(source).split()) for _ in range(source.randrange(1, 12))]
    return source.choice((" ", " ", ".", "", "-", ", ")).join(words)


def _neighbouring_characters(source: random.Random) -> str:
    assigned = _assigned()
    start = source.randrange(len(assigned))
    block = assigned[start : start + source.choice((3, 20, 100))]
    letters = [source.choice(block) for _ in range(source.randrange(1, 150))]
    for place in range(source.randrange(2, 12), len(letters), source.randrange(2, 12)):
        letters[place] = source.choice(" .,-")
    return "".join(letters)


def _any_characters(source: random.Random) -> str:
    return "".join(source.choice(_assigned()) for _ in range(source.randrange(1, 60)))


def _pieces(source: random.Random) -> str:
    return "".join(source.choice(_PIECES) for _ in range(source.randrange(1, 40)))


def _repeated(source: random.Random) -> str:
    """Repeat a few characters, to fill the library's tables and buffers."""
    motif = source.choice((_pieces, _any_characters, _sentence, _words_of_several_languages))(source)
    start = source.randrange(len(motif) + 1)
    motif = motif[start : start + source.randrange(1, 6)] + source.choice(_BLANKS) * source.randrange(2)
    return motif * source.choice((5, 30, 90, 130, 220)) if motif else "a"


@cache
def _assigned() -> str:
    """Return all assigned characters, but only some of the 90,000 Chinese and Korean ones."""
    characters = []
    for code in range(1, sys.maxunicode + 1):
        category = unicodedata.category(chr(code))
        if category in {"Cn", "Cs", "Co"} or (0x3400 <= code < 0xA000 or 0x17000 <= code < 0x19000 or code > 0x1FFFF):
            if category == "Lo" and code % 97 == 0:
                characters.append(chr(code))
        elif not (0xAC00 <= code < 0xD7A4 and code % 31):
            characters.append(chr(code))
    return "".join(characters)


# -- mutations


def _double(source: random.Random, text: str) -> str:
    place = source.randrange(len(text))
    piece = text[place : place + source.randrange(1, 8)]
    return text[:place] + piece * source.choice((2, 3, 10, 50, 100)) + text[place:]


def _cut(source: random.Random, text: str) -> str:
    place = source.randrange(len(text))
    return text[:place] + text[place + source.randrange(1, 12) :]


def _insert(source: random.Random, text: str) -> str:
    place = source.randrange(len(text) + 1)
    return text[:place] + source.choice(_PIECES) * source.choice((1, 1, 1, 3, 40)) + text[place:]


def _splice(source: random.Random, text: str) -> str:
    other = source.choice(_ORIGINS)(source)
    return text[: source.randrange(len(text) + 1)] + other[source.randrange(len(other) + 1) :]


def _intersperse(source: random.Random, text: str) -> str:
    piece, every = source.choice(_PIECES), source.randrange(1, 9)
    return piece.join(text[at : at + every] for at in range(0, len(text), every))


def _change_letters(source: random.Random, text: str) -> str:
    letters = list(text)
    for _ in range(source.choice((1, 2, 8))):
        other = source.choice((source.choice(_assigned()), chr(source.randrange(1, 0x250))))
        letters[source.randrange(len(letters))] = other
    return "".join(letters)


_ORIGINS: tuple[Callable[[random.Random], str], ...] = (
    *(_sentence, _sentence, lambda source: source.choice(CRASHERS), _words_of_several_languages),
    *(_neighbouring_characters, _any_characters, _pieces, _repeated),
)
_MUTATIONS: tuple[Callable[[random.Random, str], str], ...] = (
    *(_double, _cut, _insert, _insert, _splice),
    lambda source, text: text.replace(" ", source.choice(_BLANKS)),
    lambda source, text: source.choice((".", " ", ". ", "-", "'", "\u0301", "\u200d", ",", "_")).join(text),
    _intersperse,
    lambda source, text: source.choice((str.upper, str.title, str.swapcase, str.lower))(text),
    lambda source, text: unicodedata.normalize(source.choice(("NFD", "NFKD", "NFC")), text),
    lambda _source, text: text[::-1],
    _change_letters,
)


# -- speaking


@dataclass(slots=True)
class Tally:
    texts: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    deaths: list[str] = field(default_factory=list)  # crashes, with the voice and the text
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        ended = ", ".join(f"{count} {name}" for name, count in self.outcomes.most_common())
        return f"{self.texts} texts: {ended}; {len(self.deaths)} crashes of the engine process"

    @property
    def overflows(self) -> list[str]:
        """The crashes that the guard must prevent."""
        return [death for death in self.deaths if OVERFLOW in death]


def engine_command(guarded: bool) -> list[str]:
    """Return the command of an engine process, with or without the guard for the library."""
    *program, code = process.engine_command()
    return [*program, code if guarded else code.replace("from talkcli", f"{_WITHOUT_GUARD}from talkcli", 1)]


def speak_all(texts: Iterable[Case], *, guarded: bool, seconds: float = float("inf"), growing: bool = False) -> Tally:
    """Speak texts, whole or in pieces, until all are spoken or the time is over."""
    tally = Tally()
    command = engine_command(guarded)
    remaining = iter(texts)
    end = time.monotonic() + seconds
    with (
        tempfile.TemporaryDirectory(prefix="talk-") as directory,
        mock.patch.multiple(
            process, engine_command=lambda: command, START_LIMIT_S=_START_LIMIT_S, HANG_LIMIT_S=_HANG_LIMIT_S
        ),
    ):
        while _speak_until_crash(remaining, end, f"{directory}/spoken.wav", tally, growing=growing):
            pass
    return tally


def split(text: str, source: random.Random) -> Iterator[str]:
    """Yield pieces of a text. The first one is a valid text."""
    most, place, end = source.choice((1, 4, 8, 60)), 0, 0
    while end < len(text):
        end += source.randint(1, most)
        if place or bad_text(text[:end]) is None:
            yield text[place:end]
            place = end


def speak_growing(engine: PrivateEngine, goal: str, case: Case, pieces: Sequence[str], source: random.Random) -> None:
    """Send a text in pieces, some of them after a pause."""
    engine.speak(protocol.Speak(goal, pieces[0], _RATE, 1.0, case.voice, 50, more=True))
    for piece in pieces[1:]:
        if source.random() < _PAUSE_CHANCE:
            time.sleep(_PAUSE_S)
        engine._process.send(protocol.Append(goal, piece, end=False))
    engine._process.send(protocol.Append(goal, "", end=True))


def find_misplaced_word(text: str, words: Iterable[protocol.Word]) -> str | None:
    """Return an error message if a word of a goal is not in its place."""
    before = 0
    for number, word in enumerate(words, 1):
        if word.number != number or not before <= word.start < word.end <= len(text):
            return f"{word} is not in its place, after {before}"
        before = word.end
    return None


def _speak_until_crash(texts: Iterator[Case], end: float, path: str, tally: Tally, *, growing: bool) -> bool:
    """Speak texts in one engine process. Return whether it crashed."""
    with PrivateEngine(protocol.Configure(os.getpid(), None, f"file:{path}", None, None)) as engine:
        engine.wait_for(protocol.Ready)
        # At least one text is spoken, even if the start has used up the time.
        for number, case in enumerate(texts):
            tally.texts += 1
            goal, words = f"f{number}", []
            try:
                if growing:
                    source = random.Random(case.text)
                    speak_growing(engine, goal, case, list(split(case.text, source)), source)
                else:
                    engine.speak(protocol.Speak(goal, case.text, _RATE, 1.0, case.voice, 50))
                while not isinstance(event := next(engine.events), protocol.Ended):
                    words += [event] if isinstance(event, protocol.Word) else []
                ended = event
            except EngineFailed as error:
                death = f"{error}: {case.voice} {case.text!a}"
                tally.deaths.append(death)
                if error.reason != "engine_crashed" or "Traceback" in str(error) or "exited" in str(error):
                    tally.faults.append(death)
                return True
            outcome = ended.reason or ended.outcome
            tally.outcomes[outcome] += 1
            wrong = find_misplaced_word(case.text, words)
            if ended.id != goal or outcome == "engine_failed" or wrong:
                tally.faults.append(f"{wrong or ended}: {case.voice} {case.text!a}")
            with contextlib.suppress(FileNotFoundError):  # the text had no sound
                os.unlink(path)
            if time.monotonic() >= end:
                break
    return False


def list_voices() -> list[str]:
    configure = protocol.Configure(os.getpid(), None, "null", None, None, list_voices=True)
    with PrivateEngine(configure) as engine:
        return [voice.id for voice in engine.wait_for(protocol.VoiceList).voices if not voice.id.startswith("+")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", default="1", help='a number, or "today"')
    parser.add_argument("--growing", action="store_true", help="send each text in pieces")
    options = parser.parse_args()
    seed = daily_seed() if options.seed == "today" else int(options.seed)
    texts = itertools.islice(cases(seed, list_voices()), options.count)
    tally = speak_all(texts, guarded=True, seconds=options.seconds, growing=options.growing)
    print(*tally.deaths, *map("fault: {}".format, tally.faults), sep="\n")
    print(f"seed {seed}: {tally}, {len(tally.overflows)} overflows")
    return 1 if tally.faults or tally.overflows else 0


if __name__ == "__main__":
    sys.exit(main())
