"""What a robot tells everybody, whoever asked it for nothing: how it is, retained, and what happens to its goals.

It watches the robot's server for that, for as long as the bridge runs, and tries again where there is none. Where the
broker can't keep up, events are left out, and texts where it takes no payload as long. The status is told at most once
a second.
"""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.errors import BadRequest, ServerUnavailable, TalkError
from talkcli.fleet import topics
from talkcli.fleet.bridge.local import dial
from talkcli.frozen import replace
from talkcli.goals.goal import Goal
from talkcli.goals.option import MAX_LOG
from talkcli.goals.states import State
from talkcli.protocol.events import PausedChanged, ServerStatus, StateChanged, from_json, unfinished
from talkcli.protocol.lines import decode, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Protocol

    from talkcli.fleet.bridge.askers import Askers
    from talkcli.fleet.bridge.local import Local
    from talkcli.goals.goal import JsonObject

    class Publish(Protocol):
        """Publishes to everybody, if the broker is there."""

        def __call__(self, topic: str, payload: bytes, *, retain: bool = False, expiry: float | None = None) -> None:
            """Publish it; `expiry`: seconds after which nobody needs it any more."""


#: Seconds for which an event is of use.
EVENT_EXPIRY = 60
#: Seconds between two statuses at least; and from what happens to the one that tells of it. A goal that is cancelled
#: is PREEMPTING for some milliseconds: told at once, that it has ended would come a second later.
STATUS_EVERY, STATUS_AFTER = 1.0, 0.1
#: Characters of a text in the status: thousands of goals may wait, whose texts are kept for it.
LONGEST_TEXT = 1_000
#: Seconds without a line after which the server is taken to hang: it says that it is alive every 5.
_SILENCE = 15.0
#: Seconds until a server is looked for again: at most so many, with jitter, and the most that this becomes.
_AGAIN = (0.2, 5.0)
#: The numbers of the requests: first what was said, for a bridge that was started after that, then all that happens.
_LOG, _WATCH = 1, 2


class News:
    """What the server tells who watches it."""

    def __init__(self, askers: Askers, publish: Publish, changed: Callable[[], None], *, with_text: bool) -> None:
        """`changed` is called where a server has come or gone; `with_text`: whether everybody may read what is said."""
        self._askers = askers
        self._publish = publish
        self._changed = changed
        self._with_text = with_text
        self._name = askers.name
        #: the server, as presence tells of it; None where there is none
        self.server: JsonObject | None = None
        #: the connection to it, and when it was last heard, by the loop's clock
        self._local: Local | None = None
        self._heard = 0.0
        #: the goals that have not ended, with their texts, and which of them is spoken
        self._texts: dict[str, str | None] = {}
        self._active: str | None = None
        self._last: Goal | None = None
        self._paused = False
        #: the next status that is told; and by the loop's clock, when the last was
        self._due: asyncio.TimerHandle | None = None
        self._told = 0.0
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        """Watch the server, again and again."""
        least, most = _AGAIN
        self._wait = least
        while True:
            try:
                local = await dial(self._askers.socket, "talk bridge")
                self._local, self._heard = local, self._loop.time()
                try:
                    await self._watch(local)
                finally:
                    self._local = None
                    local.close()
                    self._gone()
            except TalkError as error:
                log.seldom("server", f"no news of the server: {log.shown(str(error))}")
            await asyncio.sleep(random.uniform(0, self._wait))
            self._wait = min(most, self._wait * 2)

    def tell(self) -> None:
        """Tell how the robot is, soon."""
        if self._due is None:
            due = max(self._loop.time() + STATUS_AFTER, self._told + STATUS_EVERY)
            self._due = self._loop.call_at(due, self._tell)

    def beat(self) -> None:
        """See every few seconds whether the server still says something."""
        if self._local and self._loop.time() - self._heard > _SILENCE:
            log.seldom("silence", f"the server at {log.shown(self._local.path)} says nothing: restart it if it hangs")
            self._local.close()

    def close(self) -> None:
        """Tell nothing more."""
        if self._due:
            self._due.cancel()

    async def _watch(self, local: Local) -> None:
        """Hear what the server says until it ends."""
        local.write(encode({"seq": _LOG, "request": "log", "count": MAX_LOG}))
        items: list[JsonObject] = []
        while True:
            lines = await local.read()
            self._heard = self._loop.time()
            if not lines:
                log.line("the server's connection has ended")
                return
            for line in lines:
                try:
                    message = decode(line)
                    if message.get("seq") == _LOG:
                        self._learn(local, message)
                    elif message.get("seq") != _WATCH:
                        self._hear(local, message, line)
                    elif "ok" not in message:
                        items.append(message)
                    elif message["ok"] is not True:
                        raise ServerUnavailable(f"the server at {local.path} can't be watched: {message.get('error')}")
                    else:
                        self._begin(local, ServerStatus.from_reply(message, items))
                        items.clear()
                except (BadRequest, ValueError) as error:
                    log.seldom("line", f"what the server says can't be read: {log.shown(str(error))}")

    def _learn(self, local: Local, message: JsonObject) -> None:
        """Take up a goal that has ended; watch, once that was the last."""
        if "goal" in message:
            self._askers.known(Goal.from_json(message["goal"]), local.boot)
        elif "ok" in message:
            local.write(encode({"seq": _WATCH, "request": "watch"}))

    def _begin(self, local: Local, status: ServerStatus) -> None:
        self._wait = _AGAIN[0]
        for each in unfinished(status):
            self._askers.known(each, local.boot)
        self.server = {"boot": local.boot, "pid": local.pid, "version": status.server.get("version")}
        self._active = status.active.id if status.active else None
        self._texts = {each.id: _beginning(each) for each in unfinished(status)}
        self._last = status.recent[-1] if status.recent else self._last
        self._paused = status.server.get("paused") is True
        self._askers.server_came(list(status.pending), local.boot)
        log.line(f"the server at {log.shown(local.path)} is there (pid {local.pid})")
        self._changed()
        self.tell()

    def _gone(self) -> None:
        self._active = None
        self._texts.clear()
        self._paused = False
        self._askers.server_went()
        if self.server:
            self.server = None
            self._changed()
            self.tell()

    def _hear(self, local: Local, message: JsonObject, line: bytes) -> None:
        event = from_json(message)
        if isinstance(event, StateChanged):
            self._note(event)
            self._askers.watched(event, local.boot)
            if event.goal and (not self._with_text or len(line) >= self._askers.room()):
                line = encode(replace(event, goal=_silenced(event.goal)).to_json()).removesuffix(b"\n")
        elif isinstance(event, PausedChanged):
            self._paused = event.paused
        else:
            return
        topic = topics.robot(self._name, topics.EVENT, str(message["event"]))
        self._publish(topic, line + b"\n", expiry=EVENT_EXPIRY)
        self.tell()

    def _note(self, event: StateChanged) -> None:
        if event.state is State.PENDING:
            self._texts[event.id] = _beginning(event.goal)
        elif event.state is State.ACTIVE:
            self._active = event.id
        elif event.state.terminal:
            self._texts.pop(event.id, None)
            self._active = None if self._active == event.id else self._active
            self._last = event.goal or self._last

    def _tell(self) -> None:
        self._due, self._told = None, self._loop.time()
        status = self._status(with_text=self._with_text)
        if len(status) > self._askers.room():
            status = self._status(with_text=False)
        self._publish(topics.robot(self._name, topics.STATUS), status, retain=True)

    def _status(self, *, with_text: bool) -> bytes:
        active, last = self._active, self._last
        status: JsonObject = {"active": active}
        if with_text:
            status["text"] = self._texts.get(active) if active else None
        status |= {"pending": len(self._texts.keys() - {active}), "paused": self._paused, "last": None}
        if last:
            text = {"text": _beginning(last)} if with_text else {}
            how = {"id": last.id, "state": last.state.name, "reason": last.reason}
            status["last"] = {**how, **text, "at": last.ended_at}
        return encode(status)


def _beginning(goal: Goal | None) -> str | None:
    """Return what of a goal's text everybody is told."""
    return goal.text[:LONGEST_TEXT] if goal and goal.text else None


def _silenced(goal: Goal) -> Goal:
    """Return a goal without what is said: its message may have words of it, too."""
    return replace(goal, text=None, spoken=None, message=None)
