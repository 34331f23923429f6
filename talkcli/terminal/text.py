"""Text on a terminal: made fit to be shown, measured in columns, cut, padded, coloured, shared out; a word of it lit.

Text from others goes through `printable` first: it moves no cursor then, forges no line, turns no direction of reading.
Pure: the terminal's width and whether it takes colour come from the caller.
"""

from __future__ import annotations

import re
import unicodedata
from itertools import accumulate

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Between two columns.
GAP = "  "
#: An id of a client's own may have 64 characters; a column for all of them would leave nothing for the text.
LONGEST_ID = 20
#: A terminal that says it is narrower is not believed: a line of less would show nothing.
NARROWEST = 40
#: Stands for what is left out.
MORE = "…"

#: East Asian wide and full-width characters, most emoji among them, take two columns.
_WIDE = frozenset({"W", "F"})
#: Marks that are drawn over the character before them.
_OVER = frozenset({"Mn", "Me"})
#: Asks for the character before it to be drawn as an emoji, which is two columns wide.
_AS_EMOJI = "\ufe0f"
#: Letters for flags: a terminal draws a pair of them, or each alone, in two columns.
_FLAG_LETTERS = ("\U0001f1e6", "\U0001f1ff")

#: Controls, format characters (bidi marks and overrides, zero-width), line and paragraph separators, halves of pairs,
#: and what is not assigned.
_ESCAPED = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"})

_COLOURING = re.compile("\x1b\\[[0-9;]*m")
_COLOURS = {
    State.PENDING: "36",
    State.ACTIVE: "1;32",
    State.PREEMPTING: "33",
    State.PREEMPTED: "33",
    State.RECALLED: "33",
    State.SUCCEEDED: "32",
    State.ABORTED: "31",
    State.REJECTED: "31",
    State.LOST: "31",
}


@frozen
class Screen:
    """Where lines will be shown."""

    #: columns; None where it is no terminal, and nothing has to fit
    width: int | None = None
    colour: bool = False

    def room(self, taken: int) -> int | None:
        """Return the columns that are left beside those taken; None for any number."""
        return None if self.width is None else max(self.width, NARROWEST) - taken

    def painted(self, text: str, state: State | None) -> str:
        """Return the text in the colour of a state."""
        code = _COLOURS.get(state) if state is not None else "1"
        return f"\x1b[{code}m{text}\x1b[0m" if self.colour and code else text


def printable(text: str, limit: int | None = None) -> str:
    """Return the text with everything that isn't plainly visible escaped, cut after `limit` characters with an …."""
    kept = text[:limit]
    if not (kept.isascii() and kept.isprintable() and "\\" not in kept):
        kept = "".join(map(_shown, kept))
    return kept if limit is None or len(text) <= limit else f"{kept}…"


def printable_json(line: str) -> str:
    """Return a line of JSON, which stays the same JSON, with everything that isn't plainly visible escaped."""
    import json

    # None of these characters stands outside of a string.
    return "".join(json.dumps(each)[1:-1] if _is_hidden(each) else each for each in line)


def width(text: str) -> int:
    """Return how many columns the text takes; colours take none.

    Where that is in doubt it is the larger: a line that is too short looks odd, one that is too long breaks.
    """
    text = _COLOURING.sub("", text)
    return len(text) if text.isascii() else sum(map(_columns, text))


def cut(text: str, columns: int | None) -> str:
    """Return the text, ended with an … where it is wider than so many columns; it must not be coloured."""
    if columns is None or width(text) <= columns:
        return text
    kept = sum(end < columns for end in accumulate(map(_columns, text)))
    return f"{text[:kept]}{MORE}" if columns > 0 else ""


def shortened(text: str, columns: int | None) -> str:
    """Return the text, cut to so many columns; one in quotes keeps the closing one."""
    if columns is None or not (len(text) > 1 and text[0] == text[-1] == '"'):
        return cut(text, columns)
    return f'"{cut(text[1:-1], columns - 2)}"'


def id_room(screen: Screen) -> int | None:
    """Return how many columns an id may take: on a terminal, a quarter of the line."""
    room = screen.room(0)
    return None if room is None else max(LONGEST_ID, room // 4)


def pad(text: str, columns: int) -> str:
    """Return the text with blanks after it, so that it takes at least so many columns."""
    return text + " " * (columns - width(text))


def longest_that_fits(forms: Sequence[str], columns: int | None) -> str:
    """Return the first of the forms, longest first, that fits; the last one cut if none does."""
    return next((each for each in forms if columns is None or width(each) <= columns), cut(forms[-1], columns))


def share(wanted: Sequence[int], weights: Sequence[int], room: int) -> list[int]:
    """Return how many columns each gets: what it wants, or its share by weight of what the others leave."""
    given = [0] * len(wanted)
    left, weight_left = room, sum(weights)
    for each in sorted(range(len(wanted)), key=lambda each: wanted[each] / weights[each]):
        given[each] = max(0, min(wanted[each], left * weights[each] // weight_left))
        left -= given[each]
        weight_left -= weights[each]
    return given


def fitted(texts: Sequence[str], *others: Sequence[Sequence[str]], weights: Sequence[int], room: int) -> list[str]:
    """Return a line for each text, in columns that take no more than `room` together.

    `others`: what stands beside the texts, column by column: for each text its forms, the longest first. What they
    leave of their share (by `weights`, the texts' first) is the texts'.
    """
    room -= len(GAP) * len(others)
    longest = [max(map(width, texts)), *(max(width(forms[0]) for forms in column) for column in others)]
    shares = share(longest, weights, room)[1:]
    chosen = [
        [longest_that_fits(forms, columns) for forms in column] for column, columns in zip(others, shares, strict=True)
    ]
    widths = [max(map(width, column)) for column in chosen]
    left = min(longest[0], room - sum(widths))
    return [
        GAP.join(map(pad, (shortened(text, left), *beside), (left, *widths))).rstrip()
        for text, *beside in zip(texts, *chosen, strict=True)
    ]


def folded(pieces: Sequence[str], first: str, screen: Screen) -> list[str]:
    """Return the pieces, joined by blanks, as lines that begin under the end of `first` and break between two pieces.

    One that is wider than a line is left to the terminal to break.
    """
    room = screen.room(width(first))
    lines = [pieces[0]]
    for piece in pieces[1:]:
        if room is not None and width(lines[-1]) + 1 + width(piece) > room:
            lines.append(piece)
        else:
            lines[-1] += f" {piece}"
    return [f"{' ' * width(first) if number else first}{each}" for number, each in enumerate(lines)]


class Sentence:
    """A text, measured once; `view` then cuts what fits out of it."""

    def __init__(self, text: str) -> None:
        self._shown = [printable(each) for each in text]
        #: the column at which each character begins, and at last the one at which the text ends
        self._columns = [0, *accumulate(map(width, self._shown))]

    @property
    def whole(self) -> str:
        """The whole text, fit to be shown."""
        return "".join(self._shown)

    def split(self, heard: int) -> tuple[str, str]:
        """Return the text up to a character that was heard, and the rest, both fit to be shown."""
        return self._part(0, heard), self._part(heard, len(self._shown))

    def view(self, start: int, end: int, columns: int) -> tuple[str, str, str]:
        """Return what fits into `columns` of the text, around the word from character `start` up to `end`.

        What was heard, the word, and what is still to come. The word keeps to the first third, so that what comes next
        can be read before it is heard.
        """
        last = len(self._shown)
        start = min(max(start, 0), last)
        end = min(max(end, start), last)
        too_much = self._columns[last] - columns
        if too_much > 0 and columns < 3:  # no room for a … at both ends and something between
            return "", "", ""
        first = self._first(min(self._columns[start] - columns // 3, too_much), start)
        # One column at each end that is cut is the …'s own.
        room = columns - (first > 0)
        stop = self._upto(self._columns[first] + room)
        if stop < last:
            stop = self._upto(self._columns[first] + room - 1)
        before = MORE if first > 0 else ""
        after = MORE if stop < last else ""
        start, end = min(start, stop), min(end, stop)
        return before + self._part(first, start), self._part(start, end), self._part(end, stop) + after

    def _part(self, start: int, end: int) -> str:
        return "".join(self._shown[start:end])

    def _first(self, column: int, start: int) -> int:
        """Return the first character to be shown, where so many columns are left out: no later than the word's."""
        if column <= 0:
            return 0
        # One column more, for the …; and no character that is drawn over the one before it.
        begins = (place for place in range(start) if column < self._columns[place] < self._columns[place + 1])
        return next(begins, start)

    def _upto(self, column: int) -> int:
        """Return the end of the characters that end at this column or earlier."""
        return sum(each <= column for each in self._columns) - 1


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in _ESCAPED


def _shown(character: str) -> str:
    return character.encode("unicode_escape").decode() if character == "\\" or _is_hidden(character) else character


def _columns(character: str) -> int:
    if unicodedata.category(character) in _OVER:
        return int(character == _AS_EMOJI)
    wide = unicodedata.east_asian_width(character) in _WIDE or _FLAG_LETTERS[0] <= character <= _FLAG_LETTERS[1]
    return 2 if wide else 1
