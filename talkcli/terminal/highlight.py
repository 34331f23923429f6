"""How a sentence looks, in so many columns of a terminal, while one of its words is being heard.

Pure: it knows neither the terminal nor its colours, only how wide a character is.
"""

from __future__ import annotations

from bisect import bisect_right

from talkcli.frozen import frozen
from talkcli.terminal.text import printable, width

#: Stands for what is left out at either end.
MORE = "…"


@frozen
class View:
    """A part of a sentence, fit to be shown: what was heard, the word being heard, what is still to come."""

    heard: str
    word: str
    ahead: str


class Sentence:
    """A text, measured once; `view` then cuts what fits out of it."""

    def __init__(self, text: str) -> None:
        self._shown = [printable(each) for each in text]
        #: the column at which each character begins, and at last the one at which the text ends
        self._columns = [0]
        for each in self._shown:
            self._columns.append(self._columns[-1] + width(each))

    @property
    def whole(self) -> str:
        """The whole text, fit to be shown."""
        return "".join(self._shown)

    def split(self, heard: int) -> tuple[str, str]:
        """Return the text up to a character that was heard, and the rest, both fit to be shown."""
        return self._part(0, heard), self._part(heard, len(self._shown))

    def view(self, start: int, end: int, columns: int) -> View:
        """Return what fits into `columns` of the text, around the word from character `start` up to `end`.

        The word keeps to the first third, so that what comes next can be read before it is heard.
        """
        last = len(self._shown)
        start = min(max(start, 0), last)
        end = min(max(end, start), last)
        total = self._columns[last]
        if total <= columns:
            return View(self._part(0, start), self._part(start, end), self._part(end, last))
        if columns < 3:  # no room for a … at both ends and something between
            return View("", "", "")
        wanted = min(self._columns[start] - columns // 3, total - columns)
        # One column at each end that is cut is the …'s own.
        first = 0 if wanted <= 0 else self._from(wanted + 1)
        first = min(first, start)
        room = columns - (first > 0)
        stop = self._upto(self._columns[first] + room)
        if stop < last:
            stop = self._upto(self._columns[first] + room - 1)
        before = MORE if first > 0 else ""
        after = MORE if stop < last else ""
        return View(
            before + self._part(first, min(start, stop)),
            self._part(min(start, stop), min(end, stop)),
            self._part(min(end, stop), stop) + after,
        )

    def _part(self, start: int, end: int) -> str:
        return "".join(self._shown[start:end])

    def _from(self, column: int) -> int:
        """Return the first character that begins at this column or later, and is not drawn over the one before it."""
        place = bisect_right(self._columns, column - 1)
        while place < len(self._shown) and self._columns[place] == self._columns[place + 1]:
            place += 1
        return place

    def _upto(self, column: int) -> int:
        """Return the end of the characters that end at this column or earlier."""
        return bisect_right(self._columns, column) - 1
