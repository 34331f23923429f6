"""What a user types and reads, what a program imports, and what the wire says is as the files here have it."""

from __future__ import annotations

import pytest

from tests.golden import surface

#: Made once in each process that runs some of these tests.
_now: dict[str, str] = {}
FILES = sorted(each.stem for each in surface.HERE.glob("*.txt"))


def test_each_part_of_the_surface_has_its_file() -> None:
    assert sorted(_surface()) == FILES


@pytest.mark.parametrize("name", FILES)
def test_the_surface_is_as_it_was(name: str) -> None:
    """Where it was meant to change: `python -m tests.golden.surface`, and look at the difference."""
    assert _surface()[name].splitlines() == (surface.HERE / f"{name}.txt").read_text("utf-8").splitlines()


def _surface() -> dict[str, str]:
    if not _now:
        _now.update(surface.surface())
    return _now
