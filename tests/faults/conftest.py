"""A directory for servers that are started with an environment of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.surroundings import short_directory

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def home() -> Iterator[str]:
    """A private directory with a path short enough for sockets."""
    with short_directory() as path:
        yield path
