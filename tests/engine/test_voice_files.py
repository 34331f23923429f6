"""Neural voices as files: where they are found, which are trusted, and the halves kept for the next start."""

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

import pytest

from talkcli.engine import models
from talkcli.engine.child.synthesizers import inference
from talkcli.engine.child.synthesizers.inference import ModelCache
from talkcli.engine.models import VoiceFileError, find_models, installed_voices, open_checked, read_description
from talkcli.engine.protocol import Voice
from talkcli.paths import cache_directory, voice_directories
from tests.support import tiny_voice

SYS_PATH = list(sys.path)


def beside(path: Path) -> Path:
    """Return the JSON of a model."""
    return path.parent / f"{path.name}.json"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a home without any voice, and no other place that has one; `v` in it is TALK_VOICES."""
    monkeypatch.setenv("TALK_VOICES", str(tmp_path / "v"))
    for name in ("XDG_DATA_HOME", "XDG_CACHE_HOME", "CACHE_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_DIRS", str(tmp_path / "system"))
    monkeypatch.setattr(sys, "path", [])
    return tmp_path


#: Prints platformdirs' places of data and caches; in a process of its own, as it looks once.
_PLATFORMDIRS = """
import json, platformdirs
dirs = platformdirs.PlatformDirs("talk", appauthor=False, multipath=True)
print(json.dumps([[dirs.user_data_dir, *dirs.site_data_dir.split(":")], dirs.user_cache_dir]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="neural voices are Linux's")
@pytest.mark.parametrize(
    "variables", [{}, {"XDG_DATA_HOME": "/d", "XDG_CACHE_HOME": "/c", "XDG_DATA_DIRS": "/a:/b"}, {"XDG_DATA_HOME": ""}]
)
@pytest.mark.usefixtures("home")
def test_the_directories_are_those_of_platformdirs(monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]) -> None:
    for name in ("XDG_DATA_DIRS", "TALK_VOICES"):
        monkeypatch.delenv(name)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    code = f"import sys; sys.path[:] = {[*SYS_PATH]!r}\n{_PLATFORMDIRS}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    data, cache = json.loads(done.stdout)
    assert voice_directories() == [f"{each}/voices" for each in data]
    assert cache_directory() == cache


def test_a_voice_is_taken_from_the_first_directory_that_has_it(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, package = home / "first", home / "lib" / "any_piper_voice" / "data"
    monkeypatch.setenv("TALK_VOICES", f"{home / 'nowhere'}:{first}")
    monkeypatch.setattr(sys, "path", [str(home / "lib")])
    places = [first, home / ".local/share/talk/voices", home / "system/talk/voices", package]
    for number, place in enumerate(places):
        tiny_voice.put(place, f"v{number}")
        tiny_voice.put(place, "same")
    assert find_models() == {
        **{f"v{number}": f"{place}/v{number}.onnx" for number, place in enumerate(places)},
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
    told = tiny_voice.description(language="l" * 1000, dataset="d" * 1000)
    told["audio"] = {"sample_rate": 8000, "quality": "q" * 1000}
    told["espeak"] = {"voice": "e" * 1000}
    path = tiny_voice.put(home / "v", "a", config=told)
    assert read_description(str(path)).espeak_voice == f"{'e' * 40}…"
    (voice,) = installed_voices()
    assert voice.name == f"{'d' * 40}…, {'q' * 40}…"
    assert (voice.language, voice.quality) == (f"{'l' * 40}…", f"{'q' * 40}…")


@pytest.mark.parametrize("where", ["model", "json", "directory", "above"])
def test_a_file_that_anyone_can_write_is_refused(home: Path, where: str) -> None:
    path = tiny_voice.put(home / "up" / "v", "a")
    wrong = {"model": path, "json": beside(path), "directory": path.parent, "above": path.parent.parent}[where]
    wrong.chmod(0o646 if wrong.is_file() else 0o757)
    with pytest.raises(
        VoiceFileError, match=f"^{wrong} can be changed by other users, .*; fix it with: chmod go-w {wrong}$"
    ):
        open_checked(str(beside(path)), model=str(path))
    wrong.chmod(0o755)
    open_checked(str(beside(path)), model=str(path)).close()


def test_the_error_names_all_unsafe_paths_and_one_command_to_fix_them(home: Path) -> None:
    path = tiny_voice.put(home / "up" / "my voices", "a")
    wrong = [beside(path), path.parent, path]
    for each in wrong:
        each.chmod(0o777)
    with pytest.raises(VoiceFileError) as caught:
        read_description(str(path))
    names, _, command = str(caught.value).partition(" can be changed by other users, which is unsafe; fix it with: ")
    assert names == f"{wrong[0]}, {wrong[1]} and {wrong[2]}"
    subprocess.run(["/bin/sh", "-c", command], check=True)
    assert read_description(str(path)).rate == 22050


#: A group that nobody has, and so a user's own that could be any.
SHARED = 47110815
ME = os.geteuid()


@pytest.mark.parametrize(
    ("user", "group", "others", "safe"),
    [
        (("anna", SHARED), ("anna", []), [], True),
        (("anna", SHARED), ("anna", ["anna"]), [("carl", SHARED + 1)], True),
        (("anna", SHARED), ("anna", ["bert"]), [], False),
        (("anna", SHARED), ("users", []), [], False),
        (("anna", SHARED), ("anna", []), [("bert", SHARED)], False),
        (("anna", SHARED + 1), ("anna", []), [], False),
        (("anna", SHARED), None, [], False),
        (None, ("anna", []), [], False),
    ],
    ids=["own", "its member", "another member", "another name", "another's own", "not its own", "unknown", "nobody's"],
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
    for each in (path, path.parent):
        each.chmod(0o775)
        os.chown(each, -1, SHARED)
    users = [] if user is None else [SimpleNamespace(pw_name=user[0], pw_uid=ME, pw_gid=user[1])]
    users += [SimpleNamespace(pw_name=name, pw_uid=ME + 7, pw_gid=gid) for name, gid in others]
    groups = [] if group is None else [SimpleNamespace(gr_name=group[0], gr_gid=SHARED, gr_mem=group[1])]

    def of(found: list[SimpleNamespace], field: str, number: int) -> SimpleNamespace:
        result = next((each for each in found if getattr(each, field) == number), None)
        if result is None:
            raise KeyError(number)
        return result

    monkeypatch.setattr(pwd, "getpwuid", lambda uid: of(users, "pw_uid", uid))
    monkeypatch.setattr(pwd, "getpwall", lambda: users)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: of(groups, "gr_gid", gid))
    if safe:
        open_checked(str(path)).close()
    else:
        with pytest.raises(VoiceFileError, match=f"{path} and {path.parent} can be changed by other users"):
            open_checked(str(path))


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="access control lists are asked for on Linux alone")
def test_an_access_control_list_is_checked_even_if_the_group_is_private(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_voice.put(home / "v", "a")
    path.chmod(0o664)
    monkeypatch.setattr(models, "_is_private_group", lambda _user, _group: True)
    open_checked(str(path)).close()
    # version 2; the owner, user 4711, the group, the mask, others: read and write but for the last
    entries = [(1, 6, 0xFFFFFFFF), (2, 6, 4711), (4, 6, 0xFFFFFFFF), (16, 6, 0xFFFFFFFF), (32, 4, 0xFFFFFFFF)]
    raw = struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *each) for each in entries)
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


@pytest.mark.parametrize("what", ["file", "directory"])
@pytest.mark.parametrize("where", ["between", "there"])
def test_a_link_in_a_directory_that_anyone_can_write_is_refused(home: Path, what: str, where: str) -> None:
    path = tiny_voice.put(home / "there", "a")
    end = path if what == "file" else path.parent
    for name in ("between", "v"):
        link = home / name / end.name
        link.parent.mkdir()
        link.symlink_to(os.path.relpath(end, link.parent))
        end = link
    way = end if what == "file" else end / path.name
    open_checked(str(way)).close()
    wrong = home / where
    wrong.chmod(0o777)
    with pytest.raises(
        VoiceFileError, match=f"^{wrong} can be changed by other users, .*; fix it with: chmod go-w {wrong}$"
    ):
        open_checked(str(way))


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
    path = tiny_voice.put(home / "there", "a")
    everybodys = home / "tmp"
    everybodys.mkdir()
    everybodys.chmod(0o1777)
    link = everybodys / "v"
    link.symlink_to(path.parent)
    open_checked(str(link / path.name)).close()
    os.chown(link, 4711, -1, follow_symlinks=False)
    with pytest.raises(VoiceFileError, match=rf"^{link} belongs to another user \(#4711\)"):
        open_checked(str(link / path.name))
    os.chown(path, 4711, -1)
    with pytest.raises(VoiceFileError, match=r"belongs to another user \(#4711\)"):
        open_checked(str(path))


@pytest.mark.parametrize(
    ("beside", "why"),
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
def test_an_invalid_json_is_refused_with_a_readable_message(
    home: Path, beside: bytes | dict[str, Any], why: str
) -> None:
    path = tiny_voice.put(home / "v", "a")
    told = path.parent / "a.onnx.json"
    told.write_bytes(beside if isinstance(beside, bytes) else json.dumps(tiny_voice.description(**beside)).encode())
    with pytest.raises(VoiceFileError, match=why) as caught:
        read_description(str(path))
    assert str(told) in str(caught.value)
    assert "download it again" in str(caught.value)
    told.unlink()
    with pytest.raises(VoiceFileError, match=r"a\.onnx\.json does not exist; download it from the source of the model"):
        read_description(str(path))


# -- kept halves


def _key(letter: str) -> str:
    return f"{letter * 64}-1-1.23.4"


KEY = _key("0")


def _kept(directory: Path) -> list[str]:
    return sorted(each.name for each in directory.iterdir())


def _keep(cache: ModelCache, key: str, content: bytes = b"encoder") -> str | None:
    """Keep something, and return the path that it was to be written to."""
    given: list[str | None] = []

    def write(path: str | None) -> None:
        given.append(path)
        if path is not None:
            with open(path, "wb") as file:
                file.write(content)

    cache.store(key, write, [b"deco", b"der"])
    return given[-1]


def test_halves_are_found_by_their_key_only_if_both_exist(home: Path) -> None:
    cache = ModelCache(str(home / "c"))
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)
    _keep(cache, KEY)
    encoder = home / "c" / f"{KEY}.encoder.onnx"
    os.utime(encoder, (1, 1))
    paths = cache.find(KEY)
    assert time.time() - encoder.stat().st_mtime < 60, "it is marked as used"
    assert [Path(each).read_bytes() for each in paths] == [b"encoder", b"decoder"]
    assert stat.S_IMODE((home / "c").stat().st_mode) == 0o700
    assert _kept(home / "c") == [f"{KEY}.decoder.onnx", f"{KEY}.encoder.onnx"]
    encoder.unlink()
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)


def test_only_the_oldest_halves_are_removed_above_the_limit(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "MAX_CACHE_BYTES", 85)
    cache = ModelCache(str(home / "c"))
    others = ["joe.onnx", "notes.new", "x.encoder.onnx", f"{KEY}.txt", "settings"]
    for each in others:
        (home / "c" / each).write_bytes(bytes(200))
        os.utime(home / "c" / each, (1, 1))
    (home / "c" / "folder.new").mkdir()
    os.utime(home / "c" / "folder.new", (1, 1))
    for number, letter in enumerate("abc"):
        _keep(cache, _key(letter), bytes(20))
        for path in (home / "c").glob(f"{letter}*"):
            os.utime(path, (1000 + number, 1000 + number))
    cache.find(_key("a"))  # it is used, and so the newest but for the next
    _keep(cache, _key("d"), bytes(20))
    own = [f"{_key(each)}.{half}coder.onnx" for each in "acd" for half in ("de", "en")]
    assert _kept(home / "c") == sorted([*own, *others, "folder.new"])


@pytest.mark.parametrize(("hours", "left"), [(0.9, 1), (1.1, 0)])
def test_unfinished_halves_are_removed_after_an_hour(home: Path, hours: float, left: int) -> None:
    cache = ModelCache(str(home / "c"))
    folder = home / "c" / f"{_key('b')}x7f3.new"
    folder.mkdir()
    (folder / "half").write_bytes(bytes(20))
    os.utime(folder, (time.time() - hours * 3600,) * 2)
    _keep(cache, KEY)
    assert len([each for each in _kept(home / "c") if each.endswith(".new")]) == left


def test_a_failed_write_or_a_missing_cache_stores_nothing(home: Path) -> None:
    def fails(_: str | None) -> None:
        raise ValueError("broken")

    cache = ModelCache(str(home / "c"))
    with pytest.raises(ValueError, match="broken"):
        cache.store(KEY, fails, [])
    with pytest.raises(FileNotFoundError):
        cache.find(KEY)
    assert not [each for each in _kept(home / "c") if each.endswith(".new")]
    os.rename(home / "c", home / "gone")
    assert _keep(cache, KEY) is None


@pytest.mark.parametrize("mode", [0o755, 0o777])
def test_a_cache_that_others_can_read_or_write_is_refused(home: Path, mode: int) -> None:
    (home / "c").mkdir()
    (home / "c").chmod(mode)
    with pytest.raises(PermissionError, match="other users can access"):
        ModelCache(str(home / "c"))
