"""Help, errors, the library and the replies of a server are those of the files here."""

from __future__ import annotations

from tests.golden import surface


def test_surface_is_unchanged() -> None:
    """To update the files: `python -m tests.golden.surface`."""
    files = {each.stem: each.read_text("utf-8").splitlines() for each in surface.HERE.glob("*.txt")}
    assert {name: text.splitlines() for name, text in surface.surface().items()} == files
