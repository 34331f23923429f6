"""Words, told against heard: by where the sound comes up behind a pause, and by a recognizer of speech in running text.

The first is the sound itself, but only of a word that has a pause before it. The second knows where each word of a text
begins, by a model of speech that has nothing to do with the one that speaks: of libespeak-ng's sentences, whose places
the library tells, it is right to 5 ms in the median. Both are asked about both voices.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from tests.bench.arithmetic import first_sound
from tests.bench.table import Limit, Row
from tests.bench.voices_heard import HEARD, pauses
from tests.bench.voices_stage import VOICES
from tests.support.espeak import RATE
from tests.support.listener import WORD, align

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.bench.voices_stage import VoiceStage
    from tests.support.processes import Talk
    from tests.support.recording import Recording

#: Twenty words each, a pause before each; none begins so softly that its beginning is a matter of opinion.
APART = (
    "One, two, three, four, five, six, seven, eight, nine, ten, eleven, twelve, thirteen, fourteen, fifteen, sixteen, "
    "seventeen, eighteen, nineteen, twenty.",
    "Battery. Door. Table. Kitchen. Garden. Charger. Camera. Gripper. Doctor. Teacher. Paper. Basket. Button. Corner. "
    "Carpet. Bottle. Pocket. Ticket. Dinner. Breakfast.",
)
#: Running text, as a robot speaks it: 25 or so words each.
RUNNING = (
    "I have found the small red box on the table in the kitchen and will bring it to you now, so keep the door open",
    "Please step aside because I am carrying a heavy package to the second floor and cannot see what is before me",
    "My battery is low and I will return to the charging station in five minutes, but the last delivery comes first",
    "Good morning and welcome to the museum, my name is Joe and I will show you the paintings in the next three rooms",
)
_MEDIAN = 30


def words(stage: VoiceStage) -> list[Row]:
    """Measure by how much words are told before or after they are heard: the figures are without their sign."""
    rows = []
    rounds = max(1, stage.options.rounds // 5)
    with stage.server() as talk:
        for texts, heard, what in (
            (APART, _onsets, "of words behind a pause, told against where the sound comes up"),
            (RUNNING, _aligned, "of words in running text, told against a recognizer"),
        ):
            found: dict[str, list[float]] = {each: [] for each in VOICES}
            for _ in range(rounds):
                for text in texts:
                    for name, voice in VOICES.items():
                        found[name] += _measured(stage, talk, text, voice, heard)
            sizes = {name: tuple(abs(each) * 1000 for each in late) for name, late in found.items()}
            limit = Limit("median", _MEDIAN)
            rows.append(Row("words", f"{what}, joe", "ms", sizes["joe"], "espeak", sizes["espeak"], (limit,)))
            middle = {name: tuple(each * 1000 for each in late) for name, late in found.items()}
            rows.append(Row("words", "… with its sign: late is more", "ms", middle["joe"], "espeak", middle["espeak"]))
    return rows


def _measured(
    stage: VoiceStage,
    talk: Talk,
    text: str,
    voice: str,
    heard: Callable[[Recording, str], dict[int, float]],
) -> list[float]:
    """Speak a text, and return by how many seconds each word was told after it was heard."""
    with stage.sink.record() as recording:
        done = talk.run("say", "--wait", "--voice", voice, "--", text, timeout=60)
        assert (done.code, talk.goal(done.id)["voice"]) == (0, voice), done
    told = talk.watcher.words(done.id)
    found = heard(recording, text)
    # Words that a voice says as one have one event: the others are not told.
    return [talk.watcher.arrived(each) - found[each["start"]] for each in told if each["start"] in found]


def _onsets(recording: Recording, text: str) -> dict[int, float]:
    """Return when each word began to be heard, by where it is in the text: where it is loud again behind a pause."""
    samples = recording.samples
    first = first_sound(samples, HEARD)
    assert first is not None
    begins = [each.start() for each in re.finditer(r"\w+", text)]
    loud = [first, *(end for _, end in pauses(samples, len(begins) - 1))]
    return {start: recording.time_of(sample) for start, sample in zip(begins, loud, strict=True)}


def _aligned(recording: Recording, text: str) -> dict[int, float]:
    """Return when each word began to be heard, by where it is in the text, as the recognizer has it."""
    begins = [each.start() for each in WORD.finditer(text.lower())]
    found = align(recording.samples, text)
    return {
        start: recording.time_of(max(0, round(each.begin * RATE))) for start, each in zip(begins, found, strict=True)
    }
