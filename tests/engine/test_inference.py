"""Tests for the inference of neural voices. It splits a model into two halves, and runs them piece by piece."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from talkcli.engine.child.synthesizers.inference import CONTEXT_FRAMES, Model, ModelCache, ModelRun
from talkcli.engine.models import VoiceFileError, read_description
from talkcli.install import NEURAL_PACKAGES
from tests.support import tiny_voice
from tests.support.real_voice import link_without_noise, real_voice
from tests.support.surroundings import needs_packages
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from typing import Any

#: Seconds within which a run ends after a request. It took 1 to 5 ms.
ENDED = 0.1
#: The field of a weight whose data is in another file.
OUTSIDE = tiny_voice.field(13, tiny_voice.field(1, "location") + tiny_voice.field(2, "/etc/passwd"))
NUMBERS = [1, 0, *(number for sound in range(14, 32) for number in (sound, 0)), 2]


@pytest.fixture(autouse=True)
def _needs_the_extra() -> None:
    needs_packages(*NEURAL_PACKAGES)


@pytest.fixture(scope="module")
def joe(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """Return the model of a real voice, without noise."""
    folder = tmp_path_factory.mktemp("voices")
    link_without_noise(real_voice(), folder)
    return _load(folder / real_voice().name)


def _load(path: Path, cache: ModelCache | None = None) -> Model:
    return Model(str(path), read_description(str(path)), cache)


def _run_whole(path: Path, speaker: int | None = None) -> Any:
    """Return the samples that the undivided model makes."""
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    feed = {
        "input": np.array([NUMBERS]),
        "input_lengths": np.array([len(NUMBERS)]),
        "scales": np.array([0, 1, 0], np.float32),
    }
    if speaker is not None:
        feed["sid"] = np.array([speaker])
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return session.run(None, feed)[0].reshape(-1)


def _run_in_pieces(model: Model, speaker: int = 0, piece: int = 20) -> Any:
    import numpy as np

    frames = model.encode(NUMBERS, speaker, 1.0, ModelRun())
    assert len(frames.ends) == len(NUMBERS)
    parts = [
        model.decode(frames, begin, min(frames.count, begin + piece), ModelRun())
        for begin in range(0, frames.count, piece)
    ]
    return np.concatenate(parts)


@pytest.mark.parametrize(("hop", "speakers", "speaker"), [(64, 1, 0), (256, 3, 0), (256, 3, 2), (300, 1, 0)])
def test_pieces_have_the_samples_of_the_whole_model(tmp_path: Path, hop: int, speakers: int, speaker: int) -> None:
    content = tiny_voice.model(hop=hop, speakers=speakers)
    path = tiny_voice.put(tmp_path / "v", "a", content, tiny_voice.description(speakers=speakers))
    whole = _run_whole(path, speaker if speakers > 1 else None)
    pieces = _run_in_pieces(_load(path), speaker)
    assert pieces.shape == whole.shape
    assert abs(pieces - whole).max() < 1e-6


def test_pieces_of_a_real_voice_have_the_samples_of_the_whole_model(joe: Model) -> None:
    whole = _run_whole(Path(joe.path))
    pieces = _run_in_pieces(joe)
    assert pieces.shape == whole.shape
    assert abs(whole).max() > 0.1
    assert abs(pieces - whole).max() < 1e-4
    assert CONTEXT_FRAMES >= 10  # enough for this voice; larger decoders need more


def test_a_model_is_loaded_from_its_cached_halves(tmp_path: Path) -> None:
    path = tiny_voice.put(tmp_path / "v", "a")
    first = _run_in_pieces(_load(path, ModelCache(str(tmp_path / "c"))))
    halves = sorted((tmp_path / "c").iterdir())
    assert len(halves) == 2
    modified_at = [path.stat().st_mtime_ns for path in halves]
    assert (_run_in_pieces(_load(path, ModelCache(str(tmp_path / "c")))) == first).all()
    assert sorted((tmp_path / "c").iterdir()) == halves
    assert all(path.stat().st_mtime_ns > before for path, before in zip(halves, modified_at, strict=True))


def test_halves_are_loaded_from_files_instead_of_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime would block all other threads while it copies the bytes, and keep the copy."""
    import onnxruntime

    session, models = onnxruntime.InferenceSession, []

    def record(model: str | bytes, *rest: Any, **more: Any) -> Any:
        models.append(model)
        return session(model, *rest, **more)

    monkeypatch.setattr(onnxruntime, "InferenceSession", record)
    path = tiny_voice.put(tmp_path / "v", "a")
    before = os.listdir("/proc/self/fd")
    _load(path)
    _load(path, ModelCache(str(tmp_path / "c")))
    assert len(models) == 4
    assert all(isinstance(model, str) for model in models)
    assert os.listdir("/proc/self/fd") == before


@pytest.mark.parametrize("cached", [True, False])
def test_a_model_is_loaded_even_if_no_file_can_be_written(tmp_path: Path, cached: bool) -> None:
    path = tiny_voice.put(tmp_path / "v", "a")
    expected = _run_in_pieces(_load(path))
    cache = ModelCache(str(tmp_path / "c"))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        model = _load(path, cache if cached else None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (_run_in_pieces(model) == expected).all()
    assert not [*(tmp_path / "c").iterdir()]


@pytest.mark.parametrize("damage", [b"", b"\0" * 100, None])
def test_damaged_cached_halves_are_made_again(tmp_path: Path, damage: bytes | None) -> None:
    path = tiny_voice.put(tmp_path / "v", "a")
    first = _run_in_pieces(_load(path, ModelCache(str(tmp_path / "c"))))
    encoder = next((tmp_path / "c").glob("*.encoder.onnx"))
    whole = encoder.read_bytes()
    encoder.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    assert (_run_in_pieces(_load(path, ModelCache(str(tmp_path / "c")))) == first).all()
    assert encoder.read_bytes() == whole


@pytest.mark.parametrize(
    ("content", "description", "reason"),
    [
        (b"", {}, "is not an ONNX model"),
        (tiny_voice.model()[:-200], {}, "is truncated"),
        (tiny_voice.model(nodes=tiny_voice.node("Evil", ["input"], "x", domain="evil")), {}, "custom operators"),
        (tiny_voice.model(weights=tiny_voice.weight("w", [1], 1, more=OUTSIDE)), {}, "its weights in another file"),
        (tiny_voice.model(amplitude=float("nan")), {}, "invalid samples"),
        (tiny_voice.model(sound_frames=1e4), {}, "more than 200 frames for 5 phonemes"),
        (tiny_voice.model(sound_frames=1e12), {}, "there is not enough memory; end another program"),
        (tiny_voice.model(hop=5000), {}, "not a Piper model .it makes [0-9]+ samples for"),
        (tiny_voice.model(sounds=5), {}, "do not belong together"),
        (tiny_voice.model(speakers=3), {}, "do not belong together .only one of them has several speakers"),
        (tiny_voice.model(), {"speakers": 3}, "do not belong together .only one of them has several speakers"),
        (tiny_voice.model(nodes=tiny_voice.node("NoSuchThing", ["pre"], "x")), {}, "could not be loaded"),
        (tiny_voice.model(weights=tiny_voice.field(12, b"\x0a\x01x")), {}, "could not be loaded|cannot be run"),
    ],
)
def test_the_error_for_a_bad_model_gives_the_reason_and_advice(
    tmp_path: Path, content: bytes, description: dict[str, Any], reason: str
) -> None:
    path = tiny_voice.put(tmp_path / "v", "a", content, tiny_voice.description(**description))
    with pytest.raises(VoiceFileError, match=reason) as caught:
        _load(path)
    assert str(path) in str(caught.value)
    assert "download" in str(caught.value) or "end another program" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_larger_than_any_model_is_not_read(tmp_path: Path) -> None:
    path = tiny_voice.put(tmp_path / "v", "a")
    os.truncate(path, 1 << 40)  # a sparse file, which needs no space on the disk
    with pytest.raises(VoiceFileError, match="larger than any Piper model; download the voice again"):
        _load(path)


#: A program that encodes very many phonemes with 20 MB of memory left, and then a few without a limit.
_WITH_LITTLE_MEMORY = """
import resource, sys
from talkcli.engine.child.synthesizers.inference import Model, ModelRun
from talkcli.engine.models import VoiceFileError, read_description
sys.argv[1:] = {arguments!r}
model = Model(sys.argv[1], read_description(sys.argv[1]))
before = resource.getrlimit(resource.RLIMIT_AS)
with open("/proc/self/statm") as file:
    used = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 20_000_000, before[1]))
try:
    model.encode([1, 0, *[14, 0] * 500, 2], 0, 1.0, ModelRun())
except VoiceFileError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_AS, before)
print(len(model.encode([1, 0, 14, 0, 2], 0, 1.0, ModelRun()).ends))
"""


def test_a_model_can_be_used_again_after_it_ran_out_of_memory() -> None:
    path = str(real_voice())
    code = _WITH_LITTLE_MEMORY.format(arguments=[path])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    message = f"{path} cannot be used: there is not enough memory; end another program"
    assert done.stdout.splitlines() == [message, "5"]


@limits()
def test_ending_a_run_raises_an_error_at_once(joe: Model) -> None:
    run = ModelRun()
    ended: list[tuple[float, BaseException]] = []

    def encode() -> None:
        try:
            joe.encode([*NUMBERS[:2], *NUMBERS[2:-1] * 40, NUMBERS[-1]], 0, 1.0, run)  # takes two seconds
        except VoiceFileError as error:
            ended.append((time.monotonic(), error))

    thread = threading.Thread(target=encode)
    thread.start()
    assert thread.ident is not None
    clock = time.pthread_getcpuclockid(thread.ident)
    while time.clock_gettime(clock) < 0.1:  # until the computation is running
        thread.join(0.005)
        assert thread.is_alive()
    requested_at = time.monotonic()
    run.end()
    thread.join()
    assert ended, "the run was completed"
    assert_within(ended[0][0] - requested_at, ENDED, "the end of a run")
