"""Neural voices as files: where they are, whether they may be trusted, and what stands in the JSON beside a model.

A voice is NAME.onnx with NAME.onnx.json, in one of the directories of `paths.voice_directories` or in an installed
package `…_piper_voice`. It is named by its file alone, never by a path, so that who may have something spoken can't
have any file read. No model is run here, and nothing is kept: what is put there is found the next time.
"""

from __future__ import annotations

import json
import os
import stat
import sys

from talkcli.engine.protocol import Voice
from talkcli.engine.synthesizers.voices import NEURAL, SPEAKER
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.paths import voice_directories

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

_MODEL, JSON = ".onnx", ".json"
#: How packages with voices are called, and where in one they may be.
_PACKAGE, _IN_PACKAGE = "_piper_voice", ("", "data")
#: Bytes of the JSON beside a model: one with a thousand speakers has 30,000.
_LONGEST_JSON = 1 << 20
#: Samples per second that a player can be asked for.
_RATES = range(4000, 192001)
#: What a model takes between two sounds, before the first and behind the last, by its names in `phoneme_id_map`.
PAD, BEGIN, END = "_", "^", "$"


class BadFile(Exception):
    """A file of a voice is not there, not safe, or not what it should be: the text names it, and the next step."""


@frozen
class Description:
    """What stands in the JSON beside a model."""

    rate: int  # samples per second
    speller: str  # libespeak-ng's voice that knows the sounds
    language: str | None  # as libespeak-ng writes it: "en-us"
    name: str  # for people: "joe, medium"
    speakers: int
    speaker_names: Mapping[str, int]
    sounds: Mapping[str, tuple[int, ...]]  # the model's numbers for each character of IPA
    noise: float  # of the sound, and of how long each sound lasts; 0 makes a text the same each time
    noise_of_durations: float
    pace: float  # what durations are multiplied with, for the voice's own pace


def found() -> dict[str, str]:
    """Return the models that there are: the path of each by its name, the first directory's where two have it."""
    result: dict[str, str] = {}
    for place in _places():
        try:
            names = sorted(os.listdir(place))
        except OSError:  # not there, as most of them, or not to be read
            continue
        for each in names:
            name = each.removesuffix(_MODEL)
            if name != each and name and not name.startswith(".") and SPEAKER not in name:
                result.setdefault(name, os.path.join(place, each))
    return result


def voices() -> tuple[Voice, ...]:
    """Return the voices that there are, those included that can't be loaded: an attempt says why."""
    return tuple(_voice(name, path) for name, path in found().items())


def describe(path: str) -> Description:
    """Read what stands beside a model; BadFile."""
    beside = path + JSON
    with open_checked(beside, missing="it belongs to the model: get it from where that came from") as file:
        try:
            raw = file.read(_LONGEST_JSON + 1)
        except OSError as error:
            raise BadFile(f"{beside} cannot be read: {error.strerror}") from error
    try:
        if len(raw) > _LONGEST_JSON:
            raise ValueError("it is too long")
        return _described(json.loads(raw))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        why = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise BadFile(f"{beside} does not describe a voice of Piper's ({why[:200]}): get it anew") from error


def open_checked(path: str, missing: str = "put it there again") -> Any:
    """Open a file to read its bytes, if nobody but root and this user can have written it; BadFile."""
    try:
        _check_way(path)
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise BadFile(f"{path} is not there: {missing}") from error
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror}") from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise BadFile(f"{path} is no file: put the voice's there")
        _check(path, status)
        return open(descriptor, "rb", closefd=True)
    except BaseException:
        os.close(descriptor)
        raise


def _check_way(path: str) -> None:
    """Look at the directories on the way to a file, and where it is a link, on the way to what that points to.

    Above the file's own a directory may be everybody's that has the sticky bit, as /tmp has: what is in it can be
    replaced by nobody but its owner.
    """
    for each in {os.path.abspath(path), os.path.realpath(path)}:
        directory = os.path.dirname(each)
        _check(directory, os.stat(directory))
        while (parent := os.path.dirname(directory)) != directory:
            directory = parent
            _check(directory, os.stat(directory), sticky=True)


def _check(path: str, status: os.stat_result, *, sticky: bool = False) -> None:
    if status.st_uid not in {0, os.geteuid()}:
        words = f"{path} is another user's (#{status.st_uid}), who could change the voice"
        raise BadFile(f"{words}: put it into a directory of your own")
    writable = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if writable and not (sticky and status.st_mode & stat.S_ISVTX):
        raise BadFile(f"{path} can be written by others, who could change the voice: chmod go-w {path}")


def _places() -> Iterator[str]:
    yield from voice_directories()
    for directory in sys.path:
        try:
            packages = sorted(each for each in os.listdir(directory) if each.endswith(_PACKAGE))
        except OSError:
            continue
        for package in packages:
            yield from (os.path.join(os.path.abspath(directory), package, each).rstrip("/") for each in _IN_PACKAGE)


def _voice(name: str, path: str) -> Voice:
    try:
        found = describe(path)
    except BadFile:
        return Voice(NEURAL + name, None, name)
    return Voice(NEURAL + name, found.language, found.name)


def _described(found: Any) -> Description:
    """Return what a JSON says; KeyError, TypeError, ValueError, AttributeError where it doesn't."""
    if found.get("phoneme_type", "espeak") != "espeak":
        raise ValueError(f"its sounds are not libespeak-ng's, but {found['phoneme_type']!r}")
    sounds = {str(key): tuple(map(_number, value)) for key, value in found["phoneme_id_map"].items()}
    for each in (PAD, BEGIN, END):
        if not sounds.get(each):
            raise ValueError(f"phoneme_id_map has no {each}")
    rate = _number(found["audio"]["sample_rate"])
    if rate not in _RATES:
        raise ValueError(f"{rate} samples a second")
    inference = found.get("inference", {})
    names = found.get("speaker_id_map") or {}
    parts = [found.get("dataset"), found["audio"].get("quality")]
    speakers = _number(found.get("num_speakers", 1))
    shown = [str(each) for each in parts if each] + ([f"{speakers} speakers"] if speakers > 1 else [])
    code = found.get("language", {}).get("code") or found["espeak"]["voice"]
    return Description(
        rate=rate,
        speller=str(found["espeak"]["voice"]),
        language=str(code).replace("_", "-").lower(),
        name=", ".join(shown) or "Piper",
        speakers=speakers,
        speaker_names={str(key): _number(value) for key, value in names.items()},
        sounds=sounds,
        noise=_factor(inference.get("noise_scale", 0.667)),
        noise_of_durations=_factor(inference.get("noise_w", 0.8)),
        pace=_factor(inference.get("length_scale", 1.0), least=0.1),
    )


def _number(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise ValueError(f"{value!r} is no number of a kind that is expected")
    return value


def _factor(value: object, least: float = 0.0) -> float:
    if not isinstance(value, int | float) or not least <= value <= 10:
        raise ValueError(f"{value!r} is no factor")
    return float(value)
