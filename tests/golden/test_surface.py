"""Help, errors, the library and the replies of a server are those of the files here."""

from __future__ import annotations

from tests.golden import surface


def test_the_public_surface_is_unchanged() -> None:
    """To update the files: `python -m tests.golden.surface`."""
    files = {path.stem: path.read_text("utf-8").splitlines() for path in surface.HERE.glob("*.txt")}
    assert {name: text.splitlines() for name, text in surface.surface().items()} == files
