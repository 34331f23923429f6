"""The help, errors, library and replies match the files in this folder."""

from __future__ import annotations

from tests.golden import surface


def test_the_public_surface_is_unchanged() -> None:
    """`python -m tests.golden.surface` updates the files."""
    files = {path.stem: path.read_text("utf-8").splitlines() for path in surface.HERE.glob("*.txt")}
    assert {name: text.splitlines() for name, text in surface.surface().items()} == files
