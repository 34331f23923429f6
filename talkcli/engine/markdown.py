r"""Code that reduces Markdown to the text that listeners should hear.

The marks become blanks, so the result has the same length as the text, and offsets in it are offsets in the text.

- The text of links, the description of images and inline code are kept. Addresses, footnote marks, HTML tags,
  definitions of references and emoji become blanks. A keycap such as 1️⃣ keeps its digit.
- Code blocks become blanks, because nobody understands code that is read aloud.
- Headings, list items and table rows end with a pause: their newline becomes "。", unless they end with punctuation or
  an empty line follows. A cell of a table ends with "，", and "1." at the beginning of an item becomes "1，". The
  synthesizers pause at these characters even if no blank follows, as in "one\n2. two".
- In an address that stands alone, only "https://" and "www." become blanks.
- Everything else is kept: `2 * 3`, `snake_case`, `#1`, `5 > 3`, a single `*` after a word.
"""

from __future__ import annotations

import re

#: Maximum distance between the beginning and the end of a link, a tag, emphasis or inline code. Until the end arrives,
#: the text can't be spoken. At a greater distance, the mark is treated as ordinary text.
_MAX_SPAN_CHARS = 500
#: Marks that make a pause at the end of a sentence or a cell, even if no blank follows.
_SENTENCE_PAUSE, _CELL_PAUSE = "。", "，"
#: Characters after which no further pause is needed.
_PUNCTUATION = ".,;:!?…。，；：！？"
#: This character and all later ones belong to scripts without blanks between words.
_FIRST_UNSPACED = "\u2e80"

_TAG_NAMES = (
    "a|abbr|audio|b|big|blockquote|br|center|cite|code|dd|del|details|div|dl|dt|em|figcaption|figure|font|footer|h[1-6]"
    "|header|hr|i|iframe|img|input|ins|kbd|label|li|main|mark|nav|ol|p|picture|pre|q|s|samp|section|small|source|span"
    "|strike|strong|style|sub|summary|sup|svg|table|tbody|td|tfoot|th|thead|think|tr|tt|u|ul|var|video"
)
_EMOJI = (
    "\u231a\u231b\u23cf\u23e9-\u23fa\u25b6\u25c0\u25fb-\u25fe\u2600-\u2604\u260e\u2611-\u2623\u2626-\u262f\u2638-\u2642"
    "\u2648-\u2653\u265f-\u2668\u267b-\u267f\u2692-\u26ff\u2702-\u2712\u2714\u2716\u271d-\u274e\u2753-\u2757\u2763"
    "\u2764\u2795-\u2797\u27a1\u27b0\u27bf\u2934\u2935\u2b05-\u2b07\u2b1b\u2b1c\u2b50\u2b55\u3030\u303d\u3297\u3299"
    "\U0001f000-\U0001faff\U000e0020-\U000e007f\ufe0e\ufe0f\u20e3"
)
_TOKEN = re.compile(
    rf"""(?P<newline>\n) | (?P<escape>\\(?:[!-/:-@\[-`{{-~]|\Z)) | (?P<code>`+) | (?P<strong>\*\*+|__+|~~+)
    | (?P<emphasis>[*_]) | (?P<pipe>\|[ \t]*) | (?P<closing>[\]>]|(?<=[ \t])\#+[ \t]*(?=\n|\Z))
    | (?P<address>(?<!\w)(?P<scheme>https?://(?:www\.)?|www\.)[^\s<>|*`"\]]{{0,999}})
    | (?P<autolink><(?:mailto:)?(?=https?://[^\s<>]+>|[\w.+-]+@[\w.-]+>))
    | (?P<blank>(?:[{_EMOJI}]|(?<=[{_EMOJI}])\u200d)+ | \[\^[^\]\s]{{1,50}}\] | <!--.{{0,{_MAX_SPAN_CHARS}}}?-->
      | </?(?:{_TAG_NAMES})(?:\s+[\w:-]+\s*=\s*(?:"[^"]*"|'[^']*'|[^\s"'<>]+)|\s+(?:open|controls))*\s*/?>)
    | (?P<link>(?:(?<![^\s\[])!)?\[)""",
    re.VERBOSE | re.DOTALL | re.IGNORECASE,
)
#: Matches the end of a text if it may become a token when more text arrives.
_PARTIAL_TOKEN = re.compile(
    r"(?:(?<!~)~+|(?<![^\s\[])!|(?<!\w)(?:ht?t?|https?:?/?|w{1,3})|<(?:!(?:-(?:-.*)?)?|(?:https?:|mailto:)[^\s<>]*"
    rf"|[\w.+-]+@?[\w.-]*|/[a-z]*[1-6]?|/?(?:{_TAG_NAMES})[\s/][^<>]*)?)\Z",
    re.DOTALL | re.IGNORECASE,
)
_LINE = re.compile(
    r"[ \t]*(?:>[ \t]?)*[ \t]*(?:(?P<empty>(?=\n|\Z))|(?P<rule>[|:+ \t]*(?:[-=*_][|:+ \t]*){2,}(?=\n|\Z)"
    r"|\[[^\]\n^][^\]\n]*\]:[ \t]*(?:https?:|mailto:|\.{0,2}/|#|<)[^\n]*)|(?P<heading>#{1,6}(?=[ \t\n]|\Z)[ \t]*)"
    r"|(?P<block>(?P<fence>`{3,}(?=[^`\n]*(?:\n|\Z))|~{3,})[^\n]*)|(?P<row>\|[ \t]*)|(?P<item>(?:\[\^[^\]\s]{1,50}\]:"
    r"|(?:[-*+•]|(?P<number>\d{1,3})[.)])(?=[ \t\n]|\Z)(?:[ \t]+\[[ xX]\](?=[ \t\n]))?)[ \t]*)|(?P<paragraph>))"
)
#: Matches an incomplete line if its first marks can't be recognized until more text arrives. No two
#: neighbouring repetitions match the same characters, so the time is proportional to the length of the line.
_PARTIAL_LINE = re.compile(
    r"[ \t>]*(?![ \t>])(?:[-*+•=_#|:`~ \t]{0,500}(?:(?<=[ \t])\[?[ xX]?\]?)?|\d{1,3}(?:[.)](?:[ \t]+\[?[ xX]?\]?)?)?"
    r"|(?:`{3,}|~{3,}(?!~))[^`\n]{0,500}|\[[^\]\n]{0,200}(?:\](?::[^\n]{0,500})?)?)\Z"
)
#: The end of a paragraph. Marks that are still open there are never closed.
_PARAGRAPH_END = re.compile(r"\n[ \t]*(?:\n|[-*+•#][ \t]|\||```|\d{1,3}[.)][ \t])")
_LINK = re.compile(
    r"""!?\[(?P<label>(?:[^\[\]\\]|\\.|\[(?:[^\[\]\\]|\\.)*\])*)(?P<end>\](?:\[[^\[\]\n]*\]|\([ \t\n]{0,9}"""
    r"""(?:<[^<>\n]*>|[^\s()<>]*(?:\([^\s()]*\)[^\s()]*)*)"""
    r"""(?:[ \t\n]{1,9}(?:"[^"]*"|'[^']*'|\([^()]*\)))?[ \t\n]{0,9}\)))""",
    re.DOTALL,
)
_PARTIAL_LINK = re.compile(
    r"""!?\[(?:[^\[\]\\]|\\.?|\[(?:[^\[\]\\]|\\.)*\]?)*(?:\](?:\[[^\[\]\n]*|\([ \t\n]{0,9}(?:<[^<>\n]*>?"""
    r"""|[^\s()<>]*(?:\([^\s()]*\)[^\s()]*)*(?:\([^\s()]*)?)(?:[ \t\n]{1,9}(?:"[^"]*"?|'[^']*'?|\([^()]*\)?)?)?"""
    r"""[ \t\n]{0,9})?)?\Z""",
    re.DOTALL,
)
#: Patterns that match the closing mark of emphasis, by opening mark.
_EMPHASIS = {
    "*": re.compile(r"(?P<end>\*)(?<![\s*\\]\*)(?![*a-zA-Z0-9\u00c0-\u024f])"),
    "_": re.compile(r"(?P<end>_)(?<![\s_\\]_)(?!\w)"),
}


class MarkdownReader:
    """Replaces the marks in a Markdown text with blanks.

    The text may arrive in pieces of any size.

    Joined together, the results are as long as the text so far, except for an end that can't be read yet, such as a
    link without its address. They don't depend on how the text was divided, so a caller may cut them anywhere.
    """

    def __init__(self) -> None:
        self._text = ""
        #: offset up to which the text has been returned, and the offset of an incomplete token at its end
        self._at = self._known = 0
        self._ended = False
        #: name of the group in `_LINE` that matches the current line, or an empty string before the first line
        self._kind = ""
        #: marks that began the current code block, or an empty string
        self._fence = ""
        #: whether the lines are rows of a table even if they don't begin with "|"
        self._in_table = False
        #: whether the current paragraph began as an item of a list
        self._in_list = False
        #: whether "**" or a similar mark is open, which may be closed within a word
        self._is_strong = False
        #: lengths of the closing marks of open spans, by offset
        self._closing: dict[int, int] = {}
        #: the last non-blank character returned from the current paragraph
        self._last = ""

    def read(self, text: str, *, ended: bool = False) -> str:
        """Add text. Return the newly completed text, with blanks in place of marks.

        With `ended`, return the whole rest.
        """
        self._text += text
        self._ended = ended
        partial = _PARTIAL_TOKEN.search(self._text, max(self._at, len(self._text) - _MAX_SPAN_CHARS))
        self._known = partial.start() if partial and not ended else len(self._text)
        found: list[str] = []
        while self._at < len(self._text):
            step = self._read_code_line() if self._fence else self._read_token() if self._kind else self._begin_line("")
            if step is None:
                break
            self._at += len(step)
            found.append(step)
            self._last = step.rstrip()[-1:] or self._last
        return "".join(found)

    def _read_token(self) -> str | None:
        """Return the text before the next token, or the token itself with blanks in place of its marks.

        Return None if more text is needed.
        """
        text, at = self._text, self._at
        token = _TOKEN.search(text, at, self._known)
        start = token.start() if token else self._known
        if start > at:
            return text[at:start]
        if token is None:
            return None
        kind, mark = str(token.lastgroup), token.group()
        if kind == "newline":
            return self._begin_line("\n")
        if at in self._closing:
            return " " * self._closing.pop(at)
        is_complete = kind == "blank" or mark in "]>" or (kind == "escape" and len(mark) == 2)
        if token.end() == self._known and not self._ended and not is_complete:
            return None
        if kind in ("code", "emphasis", "link"):
            return self._read_span(kind, token)
        return self._read_mark(kind, token)

    def _begin_line(self, newline: str) -> str | None:
        """Begin a line. Return the replacement for the newline and the marks that follow it."""
        text, at, before = self._text, self._at + len(newline), self._kind
        if not self._ended and (at == len(text) or _PARTIAL_LINE.match(text, at)):
            return None
        match = _LINE.match(text, at)
        assert match
        kind, number, marks = str(match.lastgroup), match["number"], " " * len(match.group())
        if number and number != "1" and before == "paragraph" and not self._in_list:
            kind, marks = "paragraph", ""  # the number is part of a sentence that began on an earlier line
        elif number:
            place = match.start("number") - at
            marks = marks[:place] + number + _CELL_PAUSE + marks[place + len(number) + 1 :]
        if kind == "rule":
            self._in_table = "|" in match.group()
        elif kind == "paragraph" and self._in_table:
            kind = "row"
        elif kind != "row":
            self._in_table = False
        self._kind, self._fence = kind, match["fence"] or ""
        self._in_list = kind == "item" or (self._in_list and kind == "paragraph" and before != "empty")
        self._is_strong = self._is_strong and kind == "paragraph"
        if kind == "empty":
            self._last = ""
        elif newline and (kind != "paragraph" or before in ("heading", "row")) and self._last not in _PUNCTUATION:
            newline = _SENTENCE_PAUSE
        return newline + marks

    def _read_code_line(self) -> str | None:
        """Return blanks for a line of a code block. End the block after its last line."""
        text, at = self._text, self._at
        end = text.find("\n", at)
        line = text[at : end if end >= 0 else len(text)]
        marks = line.strip(" \t>")
        if text[at - 1] == "\n" and not marks.strip(self._fence[0]):
            if end < 0 and not self._ended:
                return None  # only more text can show whether the code block ends
            if len(marks) >= len(self._fence):
                self._fence = ""
                return " " * len(line)
        return " " * (len(line) + (end >= 0))

    def _read_span(self, kind: str, token: re.Match[str]) -> str | None:
        """Return the replacement for the opening mark of a span. Store the position of its closing mark.

        If the span is code, return the whole span.
        """
        text, (start, end), mark = self._text, token.span(), token.group()
        if kind == "emphasis" and (_is_letter(text[start - 1 : start]) or text[end : end + 1] in " \t\n).,;:!?]}"):
            return mark
        paragraph_end = _PARAGRAPH_END.search(text, end, end + _MAX_SPAN_CHARS)
        limit = paragraph_end.start() if paragraph_end else end + _MAX_SPAN_CHARS
        known = self._ended or paragraph_end is not None or limit < len(text)
        if kind == "link":
            match = _LINK.match(text, start, limit)
            known = known or not _PARTIAL_LINK.match(text, start)
        else:
            ticks = rf"(?<!`)(?P<end>`{{{min(len(mark), 99)}}})(?!`)"
            match = (_EMPHASIS.get(mark) or re.compile(ticks)).search(text, end, limit)
        if not known and (match is None or match.end() == len(text)):
            return None
        if match is None:
            return " " * len(mark) if kind == "code" else mark
        if kind == "code":
            return text[end : match.start()].join((" " * len(mark), " " * len(mark)))
        self._closing[match.start("end")] = len(match["end"])
        return " " * len(mark)

    def _read_mark(self, kind: str, token: re.Match[str]) -> str:
        """Return a token that begins neither a line nor a span, with blanks in place of its marks."""
        text, (start, end), mark = self._text, token.span(), token.group()
        before, after = text[start - 1 : start] or "\n", text[end : end + 1] or "\n"
        kept = 0  # number of characters at the end of the token that aren't marks
        if kind == "escape":
            kept = 1
        elif kind == "address":
            kept = len(mark) - len(token["scheme"])
        elif kind == "autolink":
            self._closing[text.index(">", end)] = 1
        elif kind == "closing":
            kept = 0 if mark[0] == "#" and self._kind == "heading" else len(mark)
        elif kind == "pipe" and self._kind != "row":
            kept = len(mark)
        elif kind == "pipe" and after != "\n" and self._last not in _PUNCTUATION:
            return _CELL_PAUSE.ljust(len(mark))
        elif kind == "strong":
            within_word = _is_letter(before) and _is_letter(after)
            if (within_word and (not self._is_strong or mark[0] == "_")) or (before + after).isspace():
                return mark
            self._is_strong = not (_is_letter(before) or after.isspace())
        return mark[len(mark) - kept :].rjust(len(mark))


def _is_letter(character: str) -> bool:
    """Return whether a character is a letter or digit in a script that separates words with blanks."""
    return character.isalnum() and character < _FIRST_UNSPACED


def blank_markdown(text: str) -> str:
    """Replace the marks in a Markdown text with blanks or pauses. The length stays the same."""
    return MarkdownReader().read(text, ended=True)
