"""Text on a terminal: escaping, measuring, cutting, padding and colouring.

Text from other programs must go through `printable` first, so that it can't move the cursor, fake a line or change the
reading direction. Everything here is pure: the caller says how wide the terminal is and whether it has colours.
"""

from __future__ import annotations

import re
import unicodedata
from itertools import accumulate

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

#: The space between two columns of a table.
COLUMN_GAP = "  "
#: The widest column of ids. A client can choose an id of 64 characters, which would leave no room for the text.
MAX_ID_COLUMNS = 20
#: A narrower terminal is treated as this wide, because shorter lines would show nothing useful.
MIN_COLUMNS = 40
#: Stands for text that was left out.
ELLIPSIS = "…"

#: The East Asian width classes of characters that take two columns. They include most emoji.
_WIDE_CLASSES = frozenset({"W", "F"})
#: The categories of marks that are drawn over the character before them.
_COMBINING_CATEGORIES = frozenset({"Mn", "Me"})
#: This character turns the one before it into an emoji, which is two columns wide.
_EMOJI_SELECTOR = "\ufe0f"
#: The first and last of the letters that flags are made of. A terminal draws each of them in two columns.
_FLAG_LETTERS = ("\U0001f1e6", "\U0001f1ff")

#: The categories of characters that are shown escaped: controls, format characters (such as bidi marks and zero-width
#: characters), line and paragraph separators, surrogates, private characters and unassigned ones.
_HIDDEN_CATEGORIES = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"})

#: A terminal code that begins or ends a colour.
_COLOUR_CODE = re.compile("\x1b\\[[0-9;]*m")
#: The parameters of the terminal code for each state's colour.
_STATE_COLOURS = {
    State.PENDING: "36",
    State.ACTIVE: "1;32",
    State.SUCCEEDED: "32",
    **dict.fromkeys((State.PREEMPTING, State.PREEMPTED, State.RECALLED), "33"),
    **dict.fromkeys((State.ABORTED, State.REJECTED, State.LOST), "31"),
}


@frozen
class Screen:
    """The width and the colours of the place where lines are shown."""

    #: columns, or None if it isn't a terminal and lines can have any length
    width: int | None = None
    colour: bool = False

    def columns_left(self, taken: int) -> int | None:
        """Return the number of columns beside those already taken, or None for no limit."""
        return None if self.width is None else max(self.width, MIN_COLUMNS) - taken

    def coloured(self, text: str, state: State | None) -> str:
        """Return the text in the colour of a state, or in bold for None."""
        code = _STATE_COLOURS.get(state) if state is not None else "1"
        return f"\x1b[{code}m{text}\x1b[0m" if self.colour and code else text


def printable(text: str, limit: int | None = None) -> str:
    """Return the text with all invisible characters escaped. After `limit` characters it is cut."""
    kept = text[:limit]
    if not (kept.isascii() and kept.isprintable() and "\\" not in kept):
        kept = "".join(map(_escape, kept))
    return kept if limit is None or len(text) <= limit else f"{kept}{ELLIPSIS}"


def printable_json(line: str) -> str:
    """Return a line of JSON with all invisible characters escaped. It still means the same."""
    import json

    # These characters can only stand inside a JSON string.
    return "".join(json.dumps(each)[1:-1] if _is_hidden(each) else each for each in line)


def width(text: str) -> int:
    """Return how many columns the text takes. Colour codes take none.

    If a character's width is unclear, the larger one counts: a line that is too short looks odd, but a line that is too
    long wraps.
    """
    text = _COLOUR_CODE.sub("", text)
    return len(text) if text.isascii() else sum(map(_character_width, text))


def cut(text: str, columns: int | None) -> str:
    """Return the text, cut to this many columns and ended with an ellipsis. It must not contain colour codes."""
    if columns is None or width(text) <= columns:
        return text
    kept = sum(end < columns for end in accumulate(map(_character_width, text)))
    return f"{text[:kept]}{ELLIPSIS}" if columns > 0 else ""


def shorten(text: str, columns: int | None) -> str:
    """Return the text, cut to this many columns. A quoted text keeps its closing quote."""
    if columns is None or not (len(text) > 1 and text[0] == text[-1] == '"'):
        return cut(text, columns)
    return f'"{cut(text[1:-1], columns - 2)}"'


def max_id_columns(screen: Screen) -> int | None:
    """Return how many columns an id may take: a quarter of the line, or None for no limit."""
    columns = screen.columns_left(0)
    return None if columns is None else max(MAX_ID_COLUMNS, columns // 4)


def pad(text: str, columns: int) -> str:
    """Return the text, padded with spaces to this many columns."""
    return text + " " * (columns - width(text))


def longest_fitting(forms: Sequence[str], columns: int | None) -> str:
    """Return the first of several wordings that fits, or else the last one, cut. The longest comes first."""
    return next((each for each in forms if columns is None or width(each) <= columns), cut(forms[-1], columns))


def share_columns(wanted: Sequence[int], weights: Sequence[int], columns: int) -> list[int]:
    """Divide the columns of a line, and return the width of each part.

    Each part gets the width that it wants, or else its share by weight of the columns that the other parts leave.
    """
    given = [0] * len(wanted)
    left, weight_left = columns, sum(weights)
    for part in sorted(range(len(wanted)), key=lambda part: wanted[part] / weights[part]):
        given[part] = max(0, min(wanted[part], left * weights[part] // weight_left))
        left -= given[part]
        weight_left -= weights[part]
    return given


def fit_columns(
    texts: Sequence[str], *others: Sequence[Sequence[str]], weights: Sequence[int], columns: int
) -> list[str]:
    """Return the rows of a table: each text, with its cells in the other columns beside it.

    Args:
        texts: the first column.
        others: the other columns. Each cell has several wordings, the longest first.
        weights: the share of each column. Space that the other columns don't need goes to the texts.
        columns: the width of the whole line.
    """
    columns -= len(COLUMN_GAP) * len(others)
    longest = [max(map(width, texts)), *(max(width(forms[0]) for forms in column) for column in others)]
    shares = share_columns(longest, weights, columns)[1:]
    chosen = [[longest_fitting(forms, room) for forms in column] for column, room in zip(others, shares, strict=True)]
    widths = [max(map(width, column)) for column in chosen]
    left = min(longest[0], columns - sum(widths))
    return [
        COLUMN_GAP.join(map(pad, (shorten(text, left), *beside), (left, *widths))).rstrip()
        for text, *beside in zip(texts, *chosen, strict=True)
    ]


def wrap(pieces: Sequence[str], first: str, screen: Screen) -> list[str]:
    """Join the pieces with spaces and return them as lines that are broken between two pieces.

    `first` stands in front of the first line, and the other lines are indented by its width. A piece that is wider than
    a line isn't broken.
    """
    columns = screen.columns_left(width(first))
    lines = [pieces[0]]
    for piece in pieces[1:]:
        if columns is not None and width(lines[-1]) + 1 + width(piece) > columns:
            lines.append(piece)
        else:
            lines[-1] += f" {piece}"
    return [f"{' ' * width(first) if number else first}{each}" for number, each in enumerate(lines)]


class MeasuredText:
    """A text whose width is measured once, so that parts of it can be cut out quickly."""

    def __init__(self, text: str) -> None:
        self._shown = [printable(each) for each in text]
        #: the column at which each character begins, followed by the column at which the text ends
        self._columns = [0, *accumulate(map(width, self._shown))]

    @property
    def whole(self) -> str:
        """The whole text, escaped."""
        return "".join(self._shown)

    def split(self, heard: int) -> tuple[str, str]:
        """Return the first `heard` characters and the rest, both escaped."""
        return self._slice(0, heard), self._slice(heard, len(self._shown))

    def view(self, start: int, end: int, columns: int) -> tuple[str, str, str]:
        """Return the part of the text around a word that fits into this many columns.

        Args:
            start: the index of the word's first character.
            end: the index after its last character.
            columns: the width of the view.

        Returns:
            The text before the word, the word, and the text after it. The word stays within the first third, so that
            the next words can be read before they are heard.
        """
        last = len(self._shown)
        start = min(max(start, 0), last)
        end = min(max(end, start), last)
        excess = self._columns[last] - columns
        if excess > 0 and columns < 3:  # no room for an ellipsis at both ends and a character between them
            return "", "", ""
        first = self._first_shown(min(self._columns[start] - columns // 3, excess), start)
        # An ellipsis takes one column at each end that is cut.
        room = columns - (first > 0)
        stop = self._count_fitting(self._columns[first] + room)
        if stop < last:
            stop = self._count_fitting(self._columns[first] + room - 1)
        before = ELLIPSIS if first > 0 else ""
        after = ELLIPSIS if stop < last else ""
        start, end = min(start, stop), min(end, stop)
        return before + self._slice(first, start), self._slice(start, end), self._slice(end, stop) + after

    def _slice(self, start: int, end: int) -> str:
        return "".join(self._shown[start:end])

    def _first_shown(self, column: int, start: int) -> int:
        """Return the index of the first character to show if all columns before `column` are cut; at most `start`."""
        if column <= 0:
            return 0
        # The ellipsis needs one more column. The first character must not be a mark drawn over the one before it.
        begins = (place for place in range(start) if column < self._columns[place] < self._columns[place + 1])
        return next(begins, start)

    def _count_fitting(self, columns: int) -> int:
        """Return how many characters, from the first one on, fit into this many columns."""
        return sum(each <= columns for each in self._columns) - 1


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in _HIDDEN_CATEGORIES


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode() if character == "\\" or _is_hidden(character) else character


def _character_width(character: str) -> int:
    if unicodedata.category(character) in _COMBINING_CATEGORIES:
        return int(character == _EMOJI_SELECTOR)
    is_flag = _FLAG_LETTERS[0] <= character <= _FLAG_LETTERS[1]
    return 2 if is_flag or unicodedata.east_asian_width(character) in _WIDE_CLASSES else 1
