"""Tests for the files of neural voices: where they are found, which are trusted, and the cache of model halves."""

from __future__ import annotations

import errno
import grp
import json
import os
import pwd
import stat
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import platformdirs
import pytest

from talkcli.engine import models
from talkcli.engine.child.synthesizers import inference
from talkcli.engine.child.synthesizers.inference import ModelCache
from talkcli.engine.models import VoiceFileError, find_models, installed_voices, open_checked, read_description
from talkcli.engine.protocol import Voice
from talkcli.paths import cache_directory, voice_directories
from tests.support import tiny_voice


def json_path(path: Path) -> Path:
    """Return the path of a model's JSON."""
    return path.parent / f"{path.name}.json"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty home directory, on a system without voices. TALK_VOICES is its subdirectory `v`."""
    monkeypatch.setenv("TALK_VOICES", str(tmp_path / "v"))
    for name in ("XDG_DATA_HOME", "XDG_CACHE_HOME", "CACHE_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_DIRS", str(tmp_path / "system"))
    monkeypatch.setattr(sys, "path", [])
    return tmp_path


@pytest.mark.skipif(sys.platform != "linux", reason="neural voices need Linux")
@pytest.mark.parametrize(
    "variables", [{}, {"XDG_DATA_HOME": "/d", "XDG_CACHE_HOME": "/c", "XDG_DATA_DIRS": "/a:/b"}, {"XDG_DATA_HOME": ""}]
)
@pytest.mark.usefixtures("home")
def test_the_directories_are_those_of_platformdirs(monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]) -> None:
    for name in ("XDG_DATA_DIRS", "TALK_VOICES"):
        monkeypatch.delenv(name)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    dirs = platformdirs.PlatformDirs("talk", appauthor=False, multipath=True)
    data = [dirs.user_data_dir, *dirs.site_data_dir.split(":")]
    assert voice_directories() == [f"{directory}/voices" for directory in data]
    assert cache_directory() == dirs.user_cache_dir


def test_a_voice_is_taken_from_the_first_directory_that_has_it(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, package = home / "first", home / "lib" / "any_piper_voice" / "data"
    monkeypatch.setenv("TALK_VOICES", f"{home / 'nowhere'}:{first}")
    monkeypatch.setattr(sys, "path", [str(home / "lib")])
    directories = [first, home / ".local/share/talk/voices", home / "system/talk/voices", package]
    for number, directory in enumerate(directories):
        tiny_voice.put(directory, f"v{number}")
        tiny_voice.put(directory, "same")
    assert find_models() == {
        **{f"v{number}": f"{directory}/v{number}.onnx" for number, directory in enumerate(directories)},
        "same": f"{first}/same.onnx",
    }


def test_only_models_with_a_valid_name_are_voices(home: Path) -> None:
    for name in (".hidden", "a#b", "good", "a\nb", "\x1b[31mred", "\u202eleft", "ni\udcffce"):
        tiny_voice.put(home / "v", name)
    (home / "v" / ".onnx").touch()
    (home / "v" / "notes.txt").touch()
    assert [*find_models()] == ["good"]


def test_a_voice_is_listed_with_language_quality_and_speakers(home: Path) -> None:
    tiny_voice.put(home / "v", "a", config=tiny_voice.description(speakers=3, language="de_DE"))
    (home / "v" / "b.onnx").touch()
    tiny_voice.put(home / "v", "c")
    assert [*installed_voices()] == [
        Voice("piper/a", "de-de", "tiny, low, 3 speakers", "low", ("p0", "p1", "p2")),
        Voice("piper/b", None, "b"),
        Voice("piper/c", "en-us", "tiny, low", "low"),
    ]


def test_a_speaker_without_a_usable_name_is_listed_by_number(home: Path) -> None:
    names = {"amused": 0, "\x1b[31m": 1, "x" * 65: 2, "": 3, "calm": 5, "beyond": 6}
    tiny_voice.put(home / "v", "a", config=tiny_voice.description(num_speakers=6, speaker_id_map=names))
    (voice,) = installed_voices()
    assert voice.speakers == ("amused", "1", "2", "3", "4", "calm")


def test_very_long_names_in_the_json_are_shortened(home: Path) -> None:
    description = tiny_voice.description(language="l" * 1000, dataset="d" * 1000)
    description["audio"] = {"sample_rate": 8000, "quality": "q" * 1000}
    description["espeak"] = {"voice": "e" * 1000}
    path = tiny_voice.put(home / "v", "a", config=description)
    assert read_description(str(path)).espeak_voice == f"{'e' * 40}…"
    (voice,) = installed_voices()
    assert voice.name == f"{'d' * 40}…, {'q' * 40}…"
    assert (voice.language, voice.quality) == (f"{'l' * 40}…", f"{'q' * 40}…")


@pytest.mark.parametrize("where", ["model", "json", "directory", "above"])
def test_a_file_that_anyone_can_write_is_refused(home: Path, where: str) -> None:
    path = tiny_voice.put(home / "up" / "v", "a")
    wrong = {"model": path, "json": json_path(path), "directory": path.parent, "above": path.parent.parent}[where]
    wrong.chmod(0o646 if wrong.is_file() else 0o757)
    with pytest.raises(
        VoiceFileError, match=f"^{wrong} can be changed by other users, .*; fix it with: chmod go-w {wrong}$"
    ):
        open_checked(str(json_path(path)), model_path=str(path))
    wrong.chmod(0o755)
    open_checked(str(json_path(path)), model_path=str(path)).close()


def test_the_error_names_all_unsafe_paths_and_one_command_to_fix_them(home: Path) -> None:
    path = tiny_voice.put(home / "up" / "my voices", "a")
    wrong = [json_path(path), path.parent, path]
    for unsafe in wrong:
        unsafe.chmod(0o777)
    with pytest.raises(VoiceFileError) as caught:
        read_description(str(path))
    names, _, command = str(caught.value).partition(" can be changed by other users, which is unsafe; fix it with: ")
    assert names == f"{wrong[0]}, {wrong[1]} and {wrong[2]}"
    subprocess.run(["/bin/sh", "-c", command], check=True)
    assert read_description(str(path)).rate == 22050


#: A group that doesn't exist on this machine.
GROUP = 47110815
ME = os.geteuid()


@pytest.mark.parametrize(
    ("user", "group", "others", "safe"),
    [
        (("anna", GROUP), ("anna", []), [], True),
        (("anna", GROUP), ("anna", ["anna"]), [("carl", GROUP + 1)], True),
        (("anna", GROUP), ("anna", ["bert"]), [], False),
        (("anna", GROUP), ("users", []), [], False),
        (("anna", GROUP), ("anna", []), [("bert", GROUP)], False),
        (("anna", GROUP + 1), ("anna", []), [], False),
        (("anna", GROUP), None, [], False),
        (None, ("anna", []), [], False),
    ],
    ids=[
        "private",
        "own member",
        "other member",
        "other name",
        "other's primary",
        "not primary",
        "no group",
        "no user",
    ],
)
@pytest.mark.skipif(ME != 0, reason="only root may give a file to any group")
def test_only_a_group_that_is_private_to_the_user_may_write_a_file(
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    user: tuple[str, int] | None,
    group: tuple[str, list[str]] | None,
    others: list[tuple[str, int]],
    safe: bool,
) -> None:
    path = tiny_voice.put(home / "v", "a")
    for writable in (path, path.parent):
        writable.chmod(0o775)
        os.chown(writable, -1, GROUP)
    users = [] if user is None else [SimpleNamespace(pw_name=user[0], pw_uid=ME, pw_gid=user[1])]
    users += [SimpleNamespace(pw_name=name, pw_uid=ME + 7, pw_gid=gid) for name, gid in others]
    groups = [] if group is None else [SimpleNamespace(gr_name=group[0], gr_gid=GROUP, gr_mem=group[1])]

    monkeypatch.setattr(pwd, "getpwuid", lambda uid: {entry.pw_uid: entry for entry in users}[uid])
    monkeypatch.setattr(pwd, "getpwall", lambda: users)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: {entry.gr_gid: entry for entry in groups}[gid])
    if safe:
        open_checked(str(path)).close()
    else:
        with pytest.raises(VoiceFileError, match=f"{path} and {path.parent} can be changed by other users"):
            open_checked(str(path))


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="access control lists are only checked on Linux")
def test_access_control_lists_are_checked_for_private_groups_too(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tiny_voice.put(home / "v", "a")
    path.chmod(0o664)
    monkeypatch.setattr(models, "_is_private_group", lambda _user, _group: True)
    open_checked(str(path)).close()
    # version 2; the owner, user 4711, the group and the mask may read and write, and others may read
    entries = [(1, 6, 0xFFFFFFFF), (2, 6, 4711), (4, 6, 0xFFFFFFFF), (16, 6, 0xFFFFFFFF), (32, 4, 0xFFFFFFFF)]
    raw = struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *entry) for entry in entries)
    try:
        os.setxattr(path, "system.posix_acl_access", raw)
    except OSError as error:
        if error.errno != errno.ENOTSUP:
            raise
        pytest.skip("this file system has no access control lists")
    with pytest.raises(VoiceFileError, match=f"{path} can be changed by other users"):
        open_checked(str(path))


def test_a_sticky_directory_may_be_above_the_voices_but_not_contain_them(home: Path) -> None:
    path = tiny_voice.put(home / "up" / "v", "a")
    (home / "up").chmod(0o1777)
    open_checked(str(path)).close()
    (home / "up" / "v").chmod(0o1777)
    with pytest.raises(VoiceFileError, match="can be changed by other users"):
        open_checked(str(path))


@pytest.mark.parametrize("kind", ["file", "directory"])
@pytest.mark.parametrize("where", ["between", "target"])
def test_a_link_in_a_directory_that_anyone_can_write_is_refused(home: Path, kind: str, where: str) -> None:
    path = tiny_voice.put(home / "target", "a")
    target = path if kind == "file" else path.parent
    for name in ("between", "v"):
        link = home / name / target.name
        link.parent.mkdir()
        link.symlink_to(os.path.relpath(target, link.parent))
        target = link
    linked_path = target if kind == "file" else target / path.name
    open_checked(str(linked_path)).close()
    wrong = home / where
    wrong.chmod(0o777)
    with pytest.raises(
        VoiceFileError, match=f"^{wrong} can be changed by other users, .*; fix it with: chmod go-w {wrong}$"
    ):
        open_checked(str(linked_path))


def test_a_link_to_itself_and_a_pipe_are_refused_without_waiting(home: Path) -> None:
    path = tiny_voice.put(home / "v", "a")
    path.unlink()
    path.symlink_to(path)
    with pytest.raises(VoiceFileError, match=f"^{path} cannot be read: {os.strerror(errno.ELOOP)}$"):
        open_checked(str(path))
    path.unlink()
    os.mkfifo(path, 0o600)
    with pytest.raises(VoiceFileError, match="is not a regular file"):
        open_checked(str(path))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file away")
def test_another_users_file_or_link_is_refused(home: Path) -> None:
    path = tiny_voice.put(home / "target", "a")
    (home / "tmp").mkdir()
    (home / "tmp").chmod(0o1777)
    link = home / "tmp" / "v"
    link.symlink_to(path.parent)
    open_checked(str(link / path.name)).close()
    os.chown(link, 4711, -1, follow_symlinks=False)
    with pytest.raises(VoiceFileError, match=rf"^{link} belongs to another user \(#4711\)"):
        open_checked(str(link / path.name))
    os.chown(path, 4711, -1)
    with pytest.raises(VoiceFileError, match=r"belongs to another user \(#4711\)"):
        open_checked(str(path))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "Expecting value"),
        (b"[" * 100_000, "does not describe a Piper voice"),
        (b"[]", "does not describe a Piper voice"),
        (b"{}", "'phoneme_id_map' is missing"),
        (b" " * (1 << 20) + b"{}", "the file is too long"),
        ({"phoneme_id_map": {"_": [0], "^": [1], "$": [2], "a": [3] * 5}}, "more than 4 ids for a phoneme"),
        ({"phoneme_type": "text"}, "its phoneme_type must be 'espeak', got 'text'"),
        ({"phoneme_id_map": {"a": [1]}}, "phoneme_id_map has no _"),
        ({"phoneme_id_map": {"_": [0], "^": [-1], "$": [2]}}, "-1 is not a valid integer"),
        ({"audio": {"sample_rate": 0}}, "unsupported sample rate: 0"),
        ({"audio": {"sample_rate": "22050"}}, "is not a valid integer"),
        ({"num_speakers": 1 << 20}, "too many speakers: 1048576"),
        ({"inference": {"noise_scale": float("nan")}}, "nan is not a valid factor"),
        ({"inference": {"length_scale": 1e9}}, "is not a valid factor"),
    ],
)
def test_an_invalid_json_is_refused_with_a_reason(home: Path, content: bytes | dict[str, Any], reason: str) -> None:
    path = tiny_voice.put(home / "v", "a")
    if isinstance(content, dict):
        content = json.dumps(tiny_voice.description(**content)).encode()
    json_path(path).write_bytes(content)
    with pytest.raises(VoiceFileError, match=reason) as caught:
        read_description(str(path))
    assert str(json_path(path)) in str(caught.value)
    assert "download it again" in str(caught.value)
    json_path(path).unlink()
    with pytest.raises(VoiceFileError, match=r"a\.onnx\.json does not exist; download it from the source of the model"):
        read_description(str(path))


# -- the cache of model halves


def _key(letter: str) -> str:
    return f"{letter * 64}-1-1.23.4"


KEY = _key("0")


def _files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def _store(cache: ModelCache, key: str, content: bytes = b"encoder") -> str | None:
    """Store two halves, and return the path to which the encoder was written, or None if there was no path."""
    paths: list[str | None] = []

    def write(path: str | None) -> None:
        paths.append(path)
        if path is not None:
            with open(path, "wb") as file:
                file.write(content)

    cache.store(key, write, [b"deco", b"der"])
    return paths[-1]


def test_halves_are_found_by_their_key_only_if_both_exist(home: Path) -> None:
    cache = ModelCache(str(home / "c"))
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)
    _store(cache, KEY)
    encoder = home / "c" / f"{KEY}.encoder.onnx"
    os.utime(encoder, (1, 1))
    paths = cache.find(KEY)
    assert time.time() - encoder.stat().st_mtime < 60, "the time of use was not updated"
    assert [Path(path).read_bytes() for path in paths] == [b"encoder", b"decoder"]
    assert stat.S_IMODE((home / "c").stat().st_mode) == 0o700
    assert _files(home / "c") == [f"{KEY}.decoder.onnx", f"{KEY}.encoder.onnx"]
    encoder.unlink()
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)


def test_only_the_oldest_halves_are_removed_above_the_limit(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "MAX_CACHE_BYTES", 85)
    cache = ModelCache(str(home / "c"))
    others = ["joe.onnx", "notes.new", "x.encoder.onnx", f"{KEY}.txt", "settings"]
    for name in others:
        (home / "c" / name).write_bytes(bytes(200))
        os.utime(home / "c" / name, (1, 1))
    (home / "c" / "folder.new").mkdir()
    os.utime(home / "c" / "folder.new", (1, 1))
    for number, letter in enumerate("abc"):
        _store(cache, _key(letter), bytes(20))
        for path in (home / "c").glob(f"{letter}*"):
            os.utime(path, (1000 + number, 1000 + number))
    cache.find(_key("a"))  # because it was used, "b" is now the oldest
    _store(cache, _key("d"), bytes(20))
    halves = [f"{_key(letter)}.{half}coder.onnx" for letter in "acd" for half in ("de", "en")]
    assert _files(home / "c") == sorted([*halves, *others, "folder.new"])


@pytest.mark.parametrize(("hours", "remaining"), [(0.9, 1), (1.1, 0)])
def test_unfinished_halves_are_removed_after_an_hour(home: Path, hours: float, remaining: int) -> None:
    cache = ModelCache(str(home / "c"))
    folder = home / "c" / f"{_key('b')}x7f3.new"
    folder.mkdir()
    (folder / "half").write_bytes(bytes(20))
    os.utime(folder, (time.time() - hours * 3600,) * 2)
    _store(cache, KEY)
    assert sum(name.endswith(".new") for name in _files(home / "c")) == remaining


def test_a_failed_write_or_a_missing_cache_stores_nothing(home: Path) -> None:
    def fail(_: str | None) -> None:
        raise ValueError("broken")

    cache = ModelCache(str(home / "c"))
    with pytest.raises(ValueError, match="broken"):
        cache.store(KEY, fail, [])
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)
    assert not [name for name in _files(home / "c") if name.endswith(".new")]
    os.rename(home / "c", home / "gone")
    assert _store(cache, KEY) is None


@pytest.mark.parametrize("mode", [0o755, 0o777])
def test_a_cache_that_others_can_read_or_write_is_refused(home: Path, mode: int) -> None:
    (home / "c").mkdir()
    (home / "c").chmod(mode)
    with pytest.raises(PermissionError, match="other users can access"):
        ModelCache(str(home / "c"))
