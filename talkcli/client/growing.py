"""The client's side of a text that grows, without I/O.

`TextSender` decides which request sends the next part of the text. The caller sends one request at a time, and reports
the answer. `stream` is the blocking shell around it.
"""

from __future__ import annotations

from talkcli.frozen import replace
from talkcli.goals.options import MAX_TEXT_CHARS, Append, Say, is_visible


class TextSender:
    """A growing text, of which the server has a part, and the requests that send the rest."""

    def __init__(self, say: Say) -> None:
        """Start with an empty text. `say` has the options of the goal."""
        self._say = say
        #: the text that the server doesn't have yet, as far as it is known
        self._unsent = ""
        #: the number of characters that the server has
        self._length = 0
        #: the goal's id, or None until the server has accepted the goal
        self._goal_id: str | None = None
        self._ended = False
        #: whether the server knows that the text has ended
        self._end_sent = False
        #: the request that has not been answered, or None
        self._open: Say | Append | None = None

    def write(self, text: str) -> None:
        """Add text at the end."""
        self._unsent = _join_surrogates(self._unsent + text)

    def end(self) -> None:
        """Declare the text complete."""
        self._ended = True

    @property
    def finished(self) -> bool:
        """Whether the server has the whole text."""
        return self._end_sent

    def next_request(self) -> Say | Append | None:
        """Return the next request, or None if there is nothing to send.

        A request is returned until it has been answered. After a broken connection, it can be sent again, because the
        server ignores text that it already has.
        """
        if self._open is None:
            self._open = self._create_request()
        return self._open

    def accepted(self, goal_id: str) -> str:
        """Record that the server has accepted the open request, and return the text that it has added."""
        request = self._open
        assert request
        self._goal_id, self._open = goal_id, None
        self._unsent = self._unsent[len(request.text) :]
        self._length += len(request.text)
        self._end_sent = request.end if isinstance(request, Append) else not request.more
        return request.text

    def refused(self) -> None:
        """Drop the text of the open request, because the server has refused it."""
        self._unsent, self._open = self._unsent[len(self._open.text if self._open else "") :], None

    def _create_request(self) -> Say | Append | None:
        """Return a request for the text that can be sent now, or None."""
        text = self._unsent[:MAX_TEXT_CHARS]
        is_last = self._ended and len(text) == len(self._unsent)
        if not is_last and _is_first_half(text[-1:]):  # the other half follows
            text = text[:-1]
        if self._goal_id is not None:
            has_news = text or (is_last and not self._end_sent)
            return Append(self._goal_id, text, self._length, is_last) if has_news else None
        if is_last or is_visible(text) or len(text) == MAX_TEXT_CHARS:
            return replace(self._say, text=text, more=not is_last)
        return None


def _is_first_half(character: str) -> bool:
    """Return whether a character is the first half of a surrogate pair."""
    return "\ud800" <= character <= "\udbff"


def _join_surrogates(text: str) -> str:
    """Replace surrogate pairs by the characters that they stand for.

    Programs that decode JSON in pieces may pass such halves. The server joins the halves in a request, so that both
    sides would count a different number of characters.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
    return text
