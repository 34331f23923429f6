"""Neural voices as files: where they are, whether they may be trusted, and what stands in the JSON beside a model.

A voice is NAME.onnx with NAME.onnx.json, in one of the directories of `paths.voice_directories` or in an installed
package `…_piper_voice`. It is named by its file alone, never by a path, so that who may have something spoken can't
have any file read. No model is run here, and nothing is kept: what is put there is found the next time.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import sys

from talkcli import install
from talkcli.engine.protocol import Voice
from talkcli.engine.voices import NEURAL
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import SPEAKER
from talkcli.paths import voice_directories

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: The packages that a model needs.
NEEDED = install.NEURAL_PACKAGES
#: From version 1.30 on, onnxruntime writes a device id into ~/.cache/Microsoft when it is imported, and contacts a
#: telemetry host some seconds later. A robot's voice reports to nobody, so a user's own value is overwritten.
NO_TELEMETRY = {"ORT_DISABLE_TELEMETRY": "1"}

_MODEL, JSON = ".onnx", ".json"
#: How packages with voices are called, and where in one they may be.
_PACKAGE, _IN_PACKAGE = "_piper_voice", ("", "data")
#: Bytes of the JSON beside a model: one with a thousand speakers has 30,000.
_LONGEST_JSON = 1 << 20
#: Speakers of one model: the largest of Piper's has 904.
_MOST_SPEAKERS = 4096
#: Characters of what a JSON calls something that are shown, and the longest name that a speaker is called by.
_SHOWN, _LONGEST_NAME = 40, 64
#: Samples per second that a player can be asked for.
_RATES = range(4000, 192001)
#: Links that are followed on the way to a file, as many as Linux follows.
_MOST_LINKS = 40
#: Numbers of a sound: Piper's voices have one. What a model needs grows with the square of all in a sentence.
_MOST_NUMBERS = 4
#: What a model takes between two sounds, before the first and behind the last, by its names in `phoneme_id_map`.
PAD, BEGIN, END = "_", "^", "$"


class BadFile(Exception):
    """A file of a voice is not there, not safe, or not what it should be: the text names it, and the next step."""


@frozen
class Description:
    """What stands in the JSON beside a model."""

    rate: int  # samples per second
    speller: str  # libespeak-ng's voice that knows the sounds
    #: what the voice's maker calls it, written as libespeak-ng writes languages: "en-us". Libespeak-ng may know the
    #: language by another code, as "cmn" for "zh-cn": what it has of the same language is `speller`.
    language: str
    name: str  # for people: "joe, medium", "thorsten, medium, 8 speakers"
    quality: str | None  # "medium"
    speakers: int
    speaker_names: Mapping[str, int]
    sounds: Mapping[str, tuple[int, ...]]  # the model's numbers for each character of IPA
    noise: float  # of the sound, and of how long each sound lasts; 0 makes a text the same each time
    noise_of_durations: float
    pace: float  # what durations are multiplied with, for the voice's own pace


def missing() -> str | None:
    """Return which package that is needed is missing, and the next step; None if all are installed."""
    from importlib.util import find_spec

    lacking = next((each for each in NEEDED if find_spec(each) is None), None)
    return None if lacking is None else f"{lacking} is missing: {install.neural()}"


def found(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the models that there are: the path of each by its name, the first directory's where two have it.

    None whose name has what nobody can type, or what a terminal would obey. `environment`: as in `voice_directories`.
    """
    result: dict[str, str] = {}
    for place in _places(environment):
        try:
            names = sorted(os.listdir(place))
        except OSError:  # not there, as most of them, or not to be read
            continue
        for each in names:
            name = each.removesuffix(_MODEL)
            if name != each and name and not name.startswith(".") and SPEAKER not in name and name.isprintable():
                result.setdefault(name, os.path.join(place, each))
    return result


def voices() -> tuple[Voice, ...]:
    """Return the voices that there are, those included that can't be loaded: an attempt says why."""
    return tuple(_voice(name, path) for name, path in found().items())


def undescribed(environment: Mapping[str, str] | None = None) -> tuple[Voice, ...]:
    """Return the voices that there are by their names alone, without a look into their files."""
    return tuple(Voice(NEURAL + name, None, name) for name in found(environment))


def describe(path: str) -> Description:
    """Read what stands beside a model; BadFile."""
    beside = path + JSON
    with open_checked(beside, missing="it belongs to the model: get it from where that came from", model=path) as file:
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


def open_checked(path: str, missing: str = "put it there again", model: str | None = None) -> Any:
    """Open a file to read its bytes, if nobody but root and this user can have written it; BadFile.

    `model`: the one that it belongs to, so that what is to be changed of both is said at once.
    """
    try:
        _look_at(path, *([] if model is None else [model]))
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise BadFile(f"{path} is not there: {missing}") from error
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror}") from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise BadFile(f"{path} is no file: put the voice's there")
        if _is_others(path, status, descriptor):
            raise _writable(path)
        return open(descriptor, "rb", closefd=True)
    except BaseException:
        os.close(descriptor)
        raise


def _look_at(*paths: str) -> None:
    """Look at files, and at all that is gone through on the way to each; BadFile.

    A directory may be everybody's that has the sticky bit, as /tmp has, unless the file is in it, or a link in the
    file's place: what is in it can be replaced by nobody but its owner.
    """
    ways: dict[str, bool] = {}  # whether it may be everybody's so
    for path in paths:
        for each, may_be_sticky in reversed([*_way(path)]):
            ways[each] = ways.get(each, True) and may_be_sticky
    wrong = []
    for each, may_be_sticky in ways.items():
        status = os.stat(each)
        if _is_others(each, status, each) and not (may_be_sticky and status.st_mode & stat.S_ISVTX):
            wrong.append(each)
    if wrong:
        raise _writable(*wrong)


def _way(path: str) -> Iterator[tuple[str, bool]]:
    """Yield the directories that are gone through to a file, and it, each without links, and whether it leads further.

    It ends before what is not there: whoever opens the file says so. BadFile if a link is another user's.
    """
    at, links = os.sep, 0
    parts = os.path.join("" if os.path.isabs(path) else os.getcwd(), path).split(os.sep)[::-1]
    while parts:
        part = parts.pop()
        if part in {"", os.curdir}:
            continue
        yield at, bool(parts)
        if part == os.pardir:
            at = os.path.dirname(at)
            continue
        each = os.path.join(at, part)
        try:
            status = os.lstat(each)
        except FileNotFoundError:
            return
        if not stat.S_ISLNK(status.st_mode):
            at = each
            continue
        links += 1
        if links > _MOST_LINKS:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), path)
        _refuse_anothers(each, status)
        target = os.readlink(each)
        at = os.sep if os.path.isabs(target) else at
        parts += target.split(os.sep)[::-1]
    yield at, False


def _is_others(path: str, status: os.stat_result, file: str | int) -> bool:
    """Tell whether others than root and this user may write a file, which is called `path`; BadFile if it is theirs."""
    _refuse_anothers(path, status)
    if status.st_mode & stat.S_IWOTH:
        return True
    if not status.st_mode & stat.S_IWGRP:
        return False
    return _has_list(file) or not any(_is_alone(each, status.st_gid) for each in {0, os.geteuid()})


def _refuse_anothers(path: str, status: os.stat_result) -> None:
    if status.st_uid not in {0, os.geteuid()}:
        words = f"{path} is another user's (#{status.st_uid}), who could change the voice"
        raise BadFile(f"{words}: put it into a directory of your own")


def _has_list(file: str | int) -> bool:
    """Tell whether there is an access control list: the group's bits are the most then that anybody of it may do."""
    try:
        return hasattr(os, "listxattr") and "system.posix_acl_access" in os.listxattr(file)
    except OSError as error:
        return error.errno != errno.ENOTSUP


def _is_alone(user: int, group: int) -> bool:
    """Tell whether a user is alone in a group: in the one that Debian, Ubuntu and Fedora give each, by its name."""
    import grp
    import pwd

    try:
        itself, whole = pwd.getpwuid(user), grp.getgrgid(group)
    except KeyError:
        return False
    if itself.pw_gid != group or whole.gr_name != itself.pw_name or {*whole.gr_mem} - {itself.pw_name}:
        return False
    return all(each.pw_uid == user for each in pwd.getpwall() if each.pw_gid == group)


def _writable(*paths: str) -> BadFile:
    """Return the refusal of what others may write, with the one command that mends all of it."""
    import shlex  # for this alone: an engine process looks at voices at each of its starts

    names = f"{', '.join(paths[:-1])} and {paths[-1]}" if len(paths) > 1 else paths[0]
    roots = os.geteuid() != 0 and any(os.stat(each).st_uid == 0 for each in paths)
    command = f"{'sudo ' if roots else ''}chmod go-w {shlex.join(paths)}"
    return BadFile(f"{names} can be written by others, who could change the voice: {command}")


def _places(environment: Mapping[str, str] | None) -> Iterator[str]:
    yield from voice_directories(environment)
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
    names = {number: each for each, number in found.speaker_names.items()}
    speakers = [names.get(number, "") for number in range(found.speakers if found.speakers > 1 else 0)]
    called = (
        each if each.isprintable() and 0 < len(each) <= _LONGEST_NAME else str(number)
        for number, each in enumerate(speakers)
    )
    return Voice(NEURAL + name, found.language, found.name, found.quality, tuple(called) or None)


def _described(found: Any) -> Description:
    """Return what a JSON says; KeyError, TypeError, ValueError, AttributeError where it doesn't."""
    if found.get("phoneme_type", "espeak") != "espeak":
        raise ValueError(f"its sounds are not libespeak-ng's, but {found['phoneme_type']!r}")
    sounds = {str(key): tuple(map(_number, value)) for key, value in found["phoneme_id_map"].items()}
    if max(map(len, sounds.values()), default=0) > _MOST_NUMBERS:
        raise ValueError(f"phoneme_id_map has more than {_MOST_NUMBERS} numbers for a sound")
    for each in (PAD, BEGIN, END):
        if not sounds.get(each):
            raise ValueError(f"phoneme_id_map has no {each}")
    rate = _number(found["audio"]["sample_rate"])
    if rate not in _RATES:
        raise ValueError(f"{rate} samples a second")
    inference = found.get("inference", {})
    names = found.get("speaker_id_map") or {}
    quality = _cut(found["audio"].get("quality") or "")
    speakers = _number(found.get("num_speakers", 1))
    if speakers > _MOST_SPEAKERS:
        raise ValueError(f"{speakers} speakers")
    parts = [_cut(found.get("dataset") or ""), quality, f"{speakers} speakers" if speakers > 1 else ""]
    code = found.get("language", {}).get("code") or found["espeak"]["voice"]
    return Description(
        rate=rate,
        speller=_cut(found["espeak"]["voice"]),
        language=_cut(code).replace("_", "-").lower(),
        name=", ".join(filter(None, parts)) or "Piper",
        quality=quality or None,
        speakers=speakers,
        speaker_names={str(key): _number(value) for key, value in names.items()},
        sounds=sounds,
        noise=_factor(inference.get("noise_scale", 0.667)),
        noise_of_durations=_factor(inference.get("noise_w", 0.8)),
        pace=_factor(inference.get("length_scale", 1.0), least=0.1),
    )


def _cut(value: object) -> str:
    """Return what something is called, in a length that can be shown."""
    words = str(value)
    return words if len(words) <= _SHOWN else f"{words[:_SHOWN]}…"


def _number(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise ValueError(f"{value!r} is no number of a kind that is expected")
    return value


def _factor(value: object, least: float = 0.0) -> float:
    if not isinstance(value, int | float) or not least <= value <= 10:
        raise ValueError(f"{value!r} is no factor")
    return float(value)
