"""What could not be measured, and why: it stands in the table in the place of a figure."""

from __future__ import annotations


class FailedError(Exception):
    """A row has no figure: nothing was heard, a program failed, a server did not answer."""
