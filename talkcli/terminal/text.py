"""Functions that escape, measure, cut, pad and colour text for a terminal.

Text from other programs must be passed to `printable` first, so that it can't move the cursor, fake a line or change
the reading direction. The caller says how wide the terminal is and whether it has colours.
"""

from __future__ import annotations

import re
import unicodedata
from bisect import bisect_right
from itertools import accumulate

from talkcli.frozen import TYPE_CHECKING, frozen
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

#: The space between two columns of a table.
COLUMN_GAP = "  "
#: The maximum width of a name on a narrow terminal.
_MIN_NAME_COLUMNS = 18
#: The maximum width of an id on a narrow terminal. An id of 64 characters would leave no room for the text.
_MIN_ID_COLUMNS = 12
#: The minimum width to assume for a terminal, because shorter lines would be useless.
MIN_COLUMNS = 40
#: The usual width of the text column if lines can have any length. Longer texts shift the columns after them.
TEXT_COLUMNS = 40
#: The minimum width of a text if whole ids and process ids are shown.
_MIN_TEXT_COLUMNS = 16
#: Marks the place where text was cut off.
ELLIPSIS = "…"

#: Unicode width classes of characters that are two columns wide. They include most emoji.
_WIDE_CLASSES = frozenset({"W", "F"})
#: Unicode categories of marks that are drawn over the preceding character.
_COMBINING_CATEGORIES = frozenset({"Mn", "Me"})
#: The Unicode character that turns the preceding one into an emoji, which is two columns wide.
_EMOJI_SELECTOR = "\ufe0f"
#: The first and last of the Unicode letters that make up flag emoji. Each letter is two columns wide on a terminal.
_FLAG_LETTERS = ("\U0001f1e6", "\U0001f1ff")

#: Unicode categories of characters that are escaped: controls, format characters (such as bidi marks and zero-width
#: characters), line and paragraph separators, surrogates, private-use and unassigned characters.
_HIDDEN_CATEGORIES = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"})

#: Matches a terminal code that starts or ends a colour.
_COLOUR_CODE = re.compile("\x1b\\[[0-9;]*m")
#: The terminal colour code for each goal state.
_STATE_COLOURS = {
    State.PENDING: "36",
    State.ACTIVE: "1;32",
    State.SUCCEEDED: "32",
    **dict.fromkeys((State.PREEMPTING, State.PREEMPTED, State.RECALLED), "33"),
    **dict.fromkeys((State.ABORTED, State.REJECTED, State.LOST), "31"),
}


@frozen
class Screen:
    """The width and colours of the output, and the level of detail to show."""

    #: the number of columns, or None if the output isn't a terminal and lines can have any length
    width: int | None = None
    colour: bool = False
    #: whether to show whole ids, and the commands and process ids of senders
    long: bool = False
    #: the server's boot id. Goals with this prefix are shown by their numbers.
    boot: str = ""

    def columns_left(self, taken: int) -> int | None:
        """Return how many columns remain after `taken` columns.

        Return None if the length of lines is unlimited.
        """
        return None if self.width is None else max(self.width, MIN_COLUMNS) - taken

    def fit_name(self, name: str, min_columns: int = _MIN_NAME_COLUMNS, width_divisor: int = 4) -> str:
        """Escape a name, and cut it to a fraction of the terminal's width.

        Args:
            name: the name or the id.
            min_columns: its maximum width on a narrow terminal.
            width_divisor: the divisor for its maximum width on a wide terminal. For example, 4 allows a quarter of the
                line.
        """
        columns = self.columns_left(0)
        return cut(printable(name), None if columns is None else max(min_columns, columns // width_divisor))

    def goal_id(self, goal_id: str) -> str:
        """Return a goal's id for display, such as `12` for a goal of the running server."""
        if self.long:
            return printable(goal_id)
        number = goal_id.removeprefix(f"{self.boot}-")
        return self.fit_name(number if number.isdecimal() else goal_id, _MIN_ID_COLUMNS, 8)

    def coloured(self, text: str, state: State | None) -> str:
        """Return text in the colour of a goal state, or in bold if the state is None.

        Without colours, return it unchanged.
        """
        code = _STATE_COLOURS.get(state) if state is not None else "1"
        return f"\x1b[{code}m{text}\x1b[0m" if self.colour and code else text


def printable(text: str, limit: int | None = None) -> str:
    """Cut text to `limit` characters, and escape invisible characters."""
    kept = text[:limit]
    if not (kept.isascii() and kept.isprintable() and "\\" not in kept):
        kept = "".join(map(_escape, kept))
    return kept if limit is None or len(text) <= limit else f"{kept}{ELLIPSIS}"


def printable_json(line: str) -> str:
    """Escape all invisible characters in a line of JSON without changing its meaning."""
    import json

    # Invisible characters can only occur inside JSON strings.
    return "".join(json.dumps(each)[1:-1] if _is_hidden(each) else each for each in line)


def width(text: str) -> int:
    """Return the width of text in columns, ignoring colour codes.

    If a character's width is ambiguous, the larger width is assumed. A line that is too short looks odd, but a line
    that is too long wraps.
    """
    text = _COLOUR_CODE.sub("", text)
    return len(text) if text.isascii() else sum(map(_character_width, text))


def cut(text: str, columns: int | None) -> str:
    """Cut text to a number of columns, and mark the cut with an ellipsis.

    The text must not contain colour codes.
    """
    if columns is None or width(text) <= columns:
        return text
    kept = sum(end < columns for end in accumulate(map(_character_width, text)))
    return f"{text[:kept]}{ELLIPSIS}" if columns > 0 else ""


def cut_quoted(text: str, columns: int | None) -> str:
    """Cut text to a number of columns, but keep its closing quote."""
    if columns is None or not (len(text) > 1 and text[0] == text[-1] == '"'):
        return cut(text, columns)
    return f'"{cut(text[1:-1], columns - 2)}"'


def pad(text: str, columns: int) -> str:
    """Pad text with spaces to a number of columns."""
    return text + " " * (columns - width(text))


def longest_fitting(forms: Sequence[str], columns: int | None) -> str:
    """Return the longest text that fits. If none fits, cut the shortest one.

    `forms` must be sorted from the longest text to the shortest.
    """
    return next((each for each in forms if columns is None or width(each) <= columns), cut(forms[-1], columns))


def room_beside(text: str, columns: int, screen: Screen) -> int:
    """Return how many of the columns the details beside a text may take.

    The details leave at least half of the line to the text, or 16 columns if whole ids are shown.
    """
    return columns - len(COLUMN_GAP) - min(width(text), _MIN_TEXT_COLUMNS if screen.long else columns // 2)


def fit_row(head: str, text: str, details: Sequence[str], text_width: int, screen: Screen) -> str:
    """Format a table row with a head, a text and the longest details that fit.

    Args:
        head: the columns before the text.
        text: the text.
        details: possible texts for the column after it, longest first.
        text_width: the usual width of the text column. A longer text moves the details to the right.
        screen: the properties of the output.
    """
    columns = screen.columns_left(width(head))
    shown = details[0]
    if columns is not None:
        shown = longest_fitting(details, room_beside(text, columns, screen))
        columns -= len(COLUMN_GAP) + width(shown) if shown else 0
        text, text_width = cut_quoted(text, columns), min(text_width, columns)
    return (head + pad(text, text_width) + COLUMN_GAP + shown).rstrip()


def wrap(pieces: Sequence[str], head: str, screen: Screen) -> list[str]:
    """Join a head and pieces of text, and wrap them into lines that fit the screen.

    `head` starts the first line. The other lines are indented by its width. Lines are only broken between pieces.
    """
    columns = screen.columns_left(width(head))
    lines = [pieces[0]]
    for piece in pieces[1:]:
        if columns is not None and width(lines[-1]) + 1 + width(piece) > columns:
            lines.append(piece)
        else:
            lines[-1] += f" {piece}"
    return [f"{' ' * width(head) if number else head}{each}" for number, each in enumerate(lines)]


class MeasuredText:
    """Text with precomputed character widths."""

    def __init__(self, text: str) -> None:
        self._shown: list[str] = []
        #: the column at which each character starts, followed by the column at which the text ends
        self._columns = [0]
        self.extend(text)

    def __len__(self) -> int:
        return len(self._shown)

    def extend(self, text: str) -> None:
        """Add text at the end."""
        added = [printable(each) for each in text]
        self._shown += added
        self._columns += accumulate(map(width, added), initial=self._columns.pop())

    def split(self, heard: int) -> tuple[str, str]:
        """Split the escaped text after the first `heard` characters."""
        return self._slice(0, heard), self._slice(heard, len(self._shown))

    def view(self, start: int, end: int, columns: int) -> tuple[str, str, str]:
        """Return the text before a word, the word, and the text after it, cut to fit into `columns`.

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
        if excess > 0 and columns < 3:  # too narrow for two ellipses and a character between them
            return "", "", ""
        first = self._first_shown(min(self._columns[start] - columns // 3, excess), start)
        # At each end that is cut off, reserve one column for an ellipsis.
        room = columns - (first > 0)
        stop = self._count_fitting(self._columns[first] + room)
        if stop < last:
            stop = self._count_fitting(self._columns[first] + room - 1)
        before = ELLIPSIS if first > 0 else ""
        after = ELLIPSIS if stop < last else ""
        start, end = min(start, stop), min(end, stop)
        return before + self._slice(first, start), self._slice(start, end), self._slice(end, stop) + after

    def _slice(self, start: int, end: int) -> str:
        """Return the characters from `start` to `end`, with invisible ones escaped."""
        return "".join(self._shown[start:end])

    def _first_shown(self, column: int, max_index: int) -> int:
        """Return the index of the first character right of `column`. Return `max_index` if that is smaller."""
        if column <= 0:
            return 0
        # The ellipsis takes one more column. The first visible character must not be a combining mark.
        places = range(bisect_right(self._columns, column), max_index)
        return next((place for place in places if self._columns[place] < self._columns[place + 1]), max_index)

    def _count_fitting(self, columns: int) -> int:
        """Return how many characters at the start of the text fit into `columns`."""
        return bisect_right(self._columns, columns) - 1


def _is_hidden(character: str) -> bool:
    """Return whether a character is invisible or can change how a line is shown."""
    return unicodedata.category(character) in _HIDDEN_CATEGORIES


def _escape(character: str) -> str:
    """Return a character, or its escape sequence if it is invisible or a backslash."""
    return character.encode("unicode_escape").decode() if character == "\\" or _is_hidden(character) else character


def _character_width(character: str) -> int:
    """Return how many columns of a terminal a character takes: 0, 1 or 2."""
    if unicodedata.category(character) in _COMBINING_CATEGORIES:
        return int(character == _EMOJI_SELECTOR)
    is_flag = _FLAG_LETTERS[0] <= character <= _FLAG_LETTERS[1]
    return 2 if is_flag or unicodedata.east_asian_width(character) in _WIDE_CLASSES else 1
