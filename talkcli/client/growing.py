"""The client's side of a growing text, without I/O.

`TextSender` decides which request sends the next part of the text. The caller sends one request at a time, and reports
the answer. `stream` is the blocking shell around it.
"""

from __future__ import annotations

from talkcli.frozen import replace
from talkcli.goals.options import MAX_TEXT_CHARS, Append, Say, is_visible


class TextSender:
    """Creates the requests that send a growing text, one at a time."""

    def __init__(self, say: Say) -> None:
        """Start with an empty text.

        `say` has the options of the goal.
        """
        self._say = say
        #: the text that the server doesn't have yet, as far as the client knows
        self._unsent = ""
        #: the number of characters that the server has
        self._length = 0
        #: the goal's id, or None until the server has accepted the goal
        self._goal_id: str | None = None
        #: whether no more text will be added
        self.ended = False
        #: whether the server has the whole text
        self.finished = False
        #: the request that has not been answered, or None
        self._open: Say | Append | None = None

    def write(self, text: str) -> None:
        """Add text at the end."""
        self._unsent = _join_surrogates(self._unsent + text)

    def request_to_send(self) -> Say | Append | None:
        """Return the request to send, or None if there is nothing to send.

        The same request is returned until it is answered. After a broken connection, it can be sent again, because the
        server ignores text that it already has.
        """
        self._open = self._open or self._create_request()
        return self._open

    def accepted(self, goal_id: str) -> Say | Append:
        """Record that the server has accepted the unanswered request. Return that request."""
        request = self._open
        assert request
        self.refused()
        self._goal_id = goal_id
        self._length += len(request.text)
        self.finished = request.end if isinstance(request, Append) else not request.more
        return request

    def refused(self) -> None:
        """Drop the unanswered request and its text. The text is not sent again."""
        if self._open:
            self._unsent, self._open = self._unsent[len(self._open.text) :], None

    def _create_request(self) -> Say | Append | None:
        """Return a new request for the text that can be sent now, if any."""
        text = self._unsent[:MAX_TEXT_CHARS]
        is_last = self.ended and len(text) == len(self._unsent)
        if not is_last and "\ud800" <= text[-1:] <= "\udbff":  # the other half of a surrogate pair follows
            text = text[:-1]
        if self._goal_id is not None:
            has_news = text or (is_last and not self.finished)
            return Append(self._goal_id, text, self._length, is_last) if has_news else None
        if is_last or is_visible(text) or len(text) == MAX_TEXT_CHARS:
            return replace(self._say, text=text, more=not is_last)
        return None


def _join_surrogates(text: str) -> str:
    """Replace surrogate pairs in a text with the characters they represent.

    Programs that decode JSON in pieces may pass the halves of a pair separately. The server joins the halves that come
    in one request, so it would count fewer characters than this client.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
    return text
