"""Functions to find, check and describe neural voices.

A voice consists of NAME.onnx and NAME.onnx.json, either in one of `paths.voice_directories` or in an installed package
`*_piper_voice`. Users give the name of the file and never a path, so a client can't make the server read any other
file. Nothing is cached, so the next call finds a newly installed voice. This module doesn't run models.
"""

from __future__ import annotations

import errno
import glob
import json
import os
import stat
import sys

from talkcli import install
from talkcli.engine.players import DEFAULT_RATE_HZ, RATES_HZ
from talkcli.engine.protocol import Voice
from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.options import NEURAL_PREFIX, SPEAKER_MARK, without_speaker
from talkcli.paths import voice_directories

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: Environment variables for the packages of neural voices, which replace any values that the user has set.
PACKAGE_VARIABLES = {
    # Since version 1.30, onnxruntime writes a device id into ~/.cache/Microsoft when it is imported, and contacts a
    # server some seconds later. A robot must never do this.
    "ORT_DISABLE_TELEMETRY": "1",
    # Importing numpy would start threads, which takes longer than the import itself. Voices don't need these threads.
    "OPENBLAS_NUM_THREADS": "1",
}

_MODEL_SUFFIX, JSON_SUFFIX = ".onnx", ".json"
#: The suffix of Python packages that contain voices, and where to look for models in such a package.
_PACKAGE_SUFFIX, _PACKAGE_DIRS = "_piper_voice", ("", "data")
#: The maximum size of a voice's JSON file. With a thousand speakers, it has about 30,000 bytes.
_MAX_JSON_BYTES = 1 << 20
#: The maximum number of speakers in a model. Piper's largest model has 904.
_MAX_SPEAKERS = 4096
#: The maximum lengths of a text shown to users, and of the name of a speaker.
_MAX_SHOWN_CHARS, _MAX_SPEAKER_CHARS = 40, 64
#: The maximum number of ids per phoneme. Piper's voices use one. A model needs memory in proportion to the square of
#: the number of ids in a sentence.
_MAX_IDS_PER_PHONEME = 4
#: The keys of `phoneme_id_map` for the padding between phonemes, and for the beginning and end of a sentence.
PAD_SYMBOL, BEGIN_SYMBOL, END_SYMBOL = "_", "^", "$"


class VoiceFileError(Exception):
    """Raised if a neural voice can't be used."""


@frozen
class VoiceDescription:
    """The description of a neural voice from its JSON file."""

    rate: int  # samples per second
    #: the libespeak-ng voice that turns text into phonemes for this voice
    espeak_voice: str
    #: the language code stated by the voice's author, such as "en-us". `espeak_voice` may use another code for the same
    #: language, such as "cmn" instead of "zh-cn".
    language: str
    name: str  # the name shown to users, such as "joe, medium" or "thorsten, medium, 8 speakers"
    quality: str | None  # for example "medium"
    speakers: int
    speaker_names: Mapping[str, int]
    phoneme_ids: Mapping[str, tuple[int, ...]]  # the model's ids for each IPA character
    noise: float  # how much the sound varies randomly; at 0, a text always sounds the same
    duration_noise: float  # how much the durations vary randomly
    duration_scale: float  # all durations are multiplied by this factor


def missing_package() -> str | None:
    """Return an error message if a package for neural voices is missing."""
    from importlib.util import find_spec

    missing = next((each for each in install.NEURAL_PACKAGES if find_spec(each) is None), None)
    how = "install it with: " * install.IS_64_BIT
    return None if missing is None else f"{missing} is missing; {how}{install.neural_command()}"


def find_models(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the paths of all installed models, by name.

    If several directories contain a model with the same name, the first directory wins. Models are ignored if their
    names contain "#" or control characters, or begin with a dot.

    Args:
        environment: The environment variables that name the directories. By default, use those of this process.
    """
    result: dict[str, str] = {}
    for directory in _model_directories(environment):
        for path in _list_entries(directory, _MODEL_SUFFIX):
            name = os.path.basename(path).removesuffix(_MODEL_SUFFIX)
            if SPEAKER_MARK not in name and name.isprintable():
                result.setdefault(name, path)
    return result


def installed_voices() -> tuple[Voice, ...]:
    """Return all installed neural voices, with details if their descriptions can be read."""
    return tuple(_describe_voice(name, path) for name, path in find_models().items())


def undescribed_voices(environment: Mapping[str, str] | None = None) -> tuple[Voice, ...]:
    """Return all installed neural voices without reading their descriptions."""
    return tuple(Voice(NEURAL_PREFIX + name, None, name) for name in find_models(environment))


def read_description(path: str) -> VoiceDescription:
    """Read the description of a voice from the JSON file beside its model.

    Raises:
        VoiceFileError: The file is missing, unsafe or invalid.
    """
    json_path = path + JSON_SUFFIX
    advice = "download it from the source of the model"
    try:
        with open_checked(json_path, advice, model_path=path) as file:
            raw = file.read(_MAX_JSON_BYTES + 1)
        if len(raw) > _MAX_JSON_BYTES:
            raise ValueError("the file is too long")
        return _parse_description(json.loads(raw))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise VoiceFileError(f"{json_path} does not describe a Piper voice ({why[:200]}); download it again") from error


def voice_rate(voice: str) -> int:
    """Return the sample rate of a neural voice. For an unreadable or other voice, return espeak's rate."""
    try:
        return read_description(find_models()[without_speaker(voice).removeprefix(NEURAL_PREFIX)]).rate
    except (KeyError, VoiceFileError):
        return DEFAULT_RATE_HZ


def open_checked(path: str, advice_if_missing: str = "restore it", model_path: str = "") -> Any:
    """Open a voice's file. Raise VoiceFileError if another user could change it or its model.

    Args:
        path: The path of the file.
        advice_if_missing: What the error message tells the user to do if the file is missing.
        model_path: The path of the model that the file belongs to. If the model exists, it is checked too, so that one
            error message covers both.

    Raises:
        VoiceFileError: A file is missing, unreadable or unsafe.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # Opening a pipe would wait for a writer.
            raise VoiceFileError(f"{path} is not a regular file; replace it with the voice's file")
        _require_safe_paths(path, *filter(os.path.exists, [model_path]))
        return open(path, "rb")
    except FileNotFoundError as error:
        raise VoiceFileError(f"{path} does not exist; {advice_if_missing}") from error
    except OSError as error:
        raise VoiceFileError(f"{path} cannot be read: {error.strerror}") from error


def _require_safe_paths(*paths: str) -> None:
    """Raise VoiceFileError if another user could replace these files.

    In a sticky directory such as /tmp, only the owner of an entry can replace it. Everyone may write to such a
    directory, but it must not directly contain a voice file or a link to one.

    Raises:
        VoiceFileError: Another user could replace a file.
    """
    may_be_sticky: dict[str, bool] = {}
    for path in paths:
        for each, leads_on in reversed([*_walk_path(path)]):
            may_be_sticky[each] = may_be_sticky.get(each, True) and leads_on
    wrong = []
    for each, sticky_is_safe in may_be_sticky.items():
        status = os.stat(each)
        _require_safe_owner(each, status)
        if _others_can_write(each, status) and not (sticky_is_safe and status.st_mode & stat.S_ISVTX):
            wrong.append(each)
    if wrong:
        raise _writable_error(*wrong)


def _walk_path(path: str) -> Iterator[tuple[str, bool]]:
    """Follow the links in a path. Yield each directory, and then the file itself.

    Each path comes with a flag, which is True if another directory follows.

    Raises:
        VoiceFileError: A link belongs to another user.
    """
    at = os.sep
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
        status = os.lstat(each)
        if not stat.S_ISLNK(status.st_mode):
            at = each
            continue
        _require_safe_owner(each, status)
        target = os.readlink(each)
        at = os.sep if os.path.isabs(target) else at
        parts += target.split(os.sep)[::-1]
    yield at, False


def _others_can_write(path: str, status: os.stat_result) -> bool:
    """Return whether users other than root and this user can write to a file."""
    if status.st_mode & stat.S_IWOTH:
        return True
    if not status.st_mode & stat.S_IWGRP:
        return False
    return _has_acl(path) or not any(_is_private_group(each, status.st_gid) for each in {0, os.geteuid()})


def _require_safe_owner(path: str, status: os.stat_result) -> None:
    """Raise VoiceFileError unless a file belongs to root or this user."""
    if status.st_uid not in {0, os.geteuid()}:
        words = f"{path} belongs to another user (#{status.st_uid}), who could change the voice"
        raise VoiceFileError(f"{words}; move the file to a directory of your own")


def _has_acl(path: str) -> bool:
    """Return whether a file may have an access control list."""
    try:
        return hasattr(os, "listxattr") and "system.posix_acl_access" in os.listxattr(path)
    except OSError as error:
        return error.errno != errno.ENOTSUP


def _is_private_group(user: int, group: int) -> bool:
    """Return whether this user is the only member of a group."""
    import grp
    import pwd

    try:
        entry, members = pwd.getpwuid(user), grp.getgrgid(group)
    except KeyError:
        return False
    if entry.pw_gid != group or members.gr_name != entry.pw_name or {*members.gr_mem} - {entry.pw_name}:
        return False
    return all(each.pw_uid == user for each in pwd.getpwall() if each.pw_gid == group)


def _writable_error(*paths: str) -> VoiceFileError:
    """Return the error for files that other users can write to.

    It includes a command that fixes all of them.
    """
    import shlex  # this import is rarely needed

    names = f"{', '.join(paths[:-1])} and {paths[-1]}" if len(paths) > 1 else paths[0]
    needs_root = os.geteuid() != 0 and any(os.stat(each).st_uid == 0 for each in paths)
    command = f"{'sudo ' if needs_root else ''}chmod go-w {shlex.join(paths)}"
    return VoiceFileError(f"{names} can be changed by other users, which is unsafe; fix it with: {command}")


def _model_directories(environment: Mapping[str, str] | None) -> Iterator[str]:
    """Yield the directories to search for models."""
    yield from voice_directories(environment)
    for directory in filter(None, sys.path):
        for package in _list_entries(os.path.abspath(directory), _PACKAGE_SUFFIX):
            yield from (os.path.join(package, each).rstrip("/") for each in _PACKAGE_DIRS)


def _list_entries(directory: str, suffix: str) -> list[str]:
    """Return the sorted paths of a directory's visible entries with this suffix.

    If the directory can't be read, return an empty list.
    """
    return sorted(glob.glob(os.path.join(glob.escape(directory), f"*{suffix}")))


def _describe_voice(name: str, path: str) -> Voice:
    """Return the voice of a model, with details if its description can be read."""
    try:
        found = read_description(path)
    except VoiceFileError:
        return Voice(NEURAL_PREFIX + name, None, name)
    names = {number: str(number) for number in range(found.speakers if found.speakers > 1 else 0)}
    for each, number in found.speaker_names.items():
        if number in names and each.isprintable() and 0 < len(each) <= _MAX_SPEAKER_CHARS:
            names[number] = each
    return Voice(NEURAL_PREFIX + name, found.language, found.name, found.quality, tuple(names.values()) or None)


def _parse_description(content: Any) -> VoiceDescription:
    """Create a description from the parsed content of a voice's JSON file.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: The content is invalid.
    """
    if content.get("phoneme_type", "espeak") != "espeak":
        raise ValueError(f"its phoneme_type must be 'espeak', got {content['phoneme_type']!r}")
    phoneme_ids = {str(key): tuple(map(_checked_integer, value)) for key, value in content["phoneme_id_map"].items()}
    if max(map(len, phoneme_ids.values()), default=0) > _MAX_IDS_PER_PHONEME:
        raise ValueError(f"phoneme_id_map has more than {_MAX_IDS_PER_PHONEME} ids for a phoneme")
    for each in (PAD_SYMBOL, BEGIN_SYMBOL, END_SYMBOL):
        if not phoneme_ids.get(each):
            raise ValueError(f"phoneme_id_map has no {each}")
    rate = _checked_integer(content["audio"]["sample_rate"])
    if rate not in RATES_HZ:
        raise ValueError(f"unsupported sample rate: {rate}")
    inference = content.get("inference", {})
    names = content.get("speaker_id_map") or {}
    quality = _shorten(content["audio"].get("quality") or "")
    speakers = _checked_integer(content.get("num_speakers", 1))
    if speakers > _MAX_SPEAKERS:
        raise ValueError(f"too many speakers: {speakers}")
    parts = [_shorten(content.get("dataset") or ""), quality, f"{speakers} speakers" if speakers > 1 else ""]
    code = content.get("language", {}).get("code") or content["espeak"]["voice"]
    return VoiceDescription(
        rate=rate,
        espeak_voice=_shorten(content["espeak"]["voice"]),
        language=_shorten(code).replace("_", "-").lower(),
        name=", ".join(filter(None, parts)) or "Piper",
        quality=quality or None,
        speakers=speakers,
        speaker_names={str(key): _checked_integer(value) for key, value in names.items()},
        phoneme_ids=phoneme_ids,
        noise=_checked_factor(inference.get("noise_scale", 0.667)),
        duration_noise=_checked_factor(inference.get("noise_w", 0.8)),
        duration_scale=_checked_factor(inference.get("length_scale", 1.0), least=0.1),
    )


def _shorten(value: object) -> str:
    """Convert a value to text, and shorten it if it is too long."""
    words = str(value)
    return words if len(words) <= _MAX_SHOWN_CHARS else f"{words[:_MAX_SHOWN_CHARS]}…"


def _checked_integer(value: object) -> int:
    """Return the value if it is an integer from 0 to 2,147,483,647. Otherwise raise ValueError."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise ValueError(f"{value!r} is not a valid integer")
    return value


def _checked_factor(value: object, least: float = 0.0) -> float:
    """Return the value if it is a number from `least` to 10. Otherwise raise ValueError."""
    if not isinstance(value, int | float) or not least <= value <= 10:
        raise ValueError(f"{value!r} is not a valid factor")
    return float(value)
