"""What is spoken: carries out the scheduler's decisions and takes the engine's reports, all in the loop's thread.

What happens is the scheduler's decision, how it is spoken the engine thread's, who hears of it the subscribers'. It
passes between them and never waits for any of them. It has the one timer: for the scheduler's `deadline`, at which it
calls `tick`. It knows no requests but as those who wait, and are to go on.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.engine import protocol
from talkcli.engine.parent.supervisor import EngineDied, EngineMissing, EngineSaid, Report, ThreadDied
from talkcli.engine.voices import is_neural
from talkcli.errors import TalkError, UsageError
from talkcli.frozen import replace
from talkcli.goals.goal import Output
from talkcli.goals.options import INITIAL, for_engine, model_of
from talkcli.goals.reasons import Reason
from talkcli.goals.scheduler import Changed, Effect, Now, Order
from talkcli.goals.states import State
from talkcli.server import log as server_log
from talkcli.server.call import go_on
from talkcli.server.stream import Streams
from talkcli.server.subscribers import News, Subscribers
from talkcli.server.voices import Readiness, Voices

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    from talkcli.engine.parent.supervisor import Supervisor
    from talkcli.goals.goal import By
    from talkcli.goals.record import Record
    from talkcli.goals.scheduler import Scheduler
    from talkcli.server.call import Place

#: Linux's monotonic clock stands still while the machine sleeps, the one since the boot does not. Elsewhere, on macOS,
#: the monotonic one goes on.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
#: Seconds after which a timer looks at this clock again: the event loop's own timers stand still in a suspend, and what
#: was due in it must not wait for as long again.
LOOK_EVERY = 1.0
#: How an engine is that takes goals.
READY = "ready"
#: Reports that are taken before the loop looks at the clients again: to tell fifty watchers of so many words takes it
#: some milliseconds, on a busy machine a hundredth of a second or two.
AT_ONCE = 8


def elapsed() -> float:
    """Return seconds since some moment in the past: no change of the wall clock moves it, and a suspend counts."""
    return time.clock_gettime(_CLOCK)


class Speech:
    """The goals of one server and the engine that speaks them, for as long as it runs."""

    def __init__(self, scheduler: Scheduler, for_player: Sequence[str] = (), voice_memory: int = 0) -> None:
        """`for_player`: the server's options that were given for a player; `voice_memory`: as in `Voices`."""
        self.scheduler = scheduler
        self._for_player = for_player
        #: set before the first client is there
        self.engine: Supervisor
        #: called, in the loop's thread, when `words` may have changed
        self.changed: Callable[[], None] = lambda: None
        #: called when a goal has come to the queue, or left it
        self.queue_changed: Callable[[], None] = lambda: None
        #: called when nothing can be spoken any more, and why
        self.lost: Callable[[TalkError], None] = lambda _: None
        scheduler.engine_lost()  # none is ready yet
        #: set once everything has ended after `shut_down`
        self.finished = asyncio.Event()
        self.ready: protocol.Ready | None = None
        self.voices = Voices(voice_memory)
        #: requests that wait until the voices are known, or it is known that they won't be
        self.for_voices: Place = {}
        #: goals that wait for room in the queue; whoever hears of `queue_changed` lets them go
        self.for_room: Place = {}
        #: how the engine is, in a few words
        self.engine_words = "starting"
        #: set once an engine process is ready, or it is known that none will be; and at the server's end
        self.engine_known = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self.subscribers = Subscribers(self._loop, lambda: (each.connection for each in self.for_room))
        self.streams = Streams(self._loop)
        self.news = News(self.streams)
        self._timer: asyncio.TimerHandle | None = None
        #: requests that wait for a goal to be silent, until its end is told
        self._for_silence: dict[Record, Place] = {}
        #: the goal that was last known to be held and silent
        self.silent: Record | None = None
        self._orders: dict[Order, Callable[[Record], None]] = {
            Order.START: self._start,
            Order.STOP: lambda goal: self.engine.stop(goal.id),
            Order.GIVE_UP: lambda goal: self.engine.give_up(goal.id),
            Order.HOLD: lambda goal: self.engine.pause(goal.id, goal.holds),
            Order.RESUME: lambda goal: self.engine.resume(goal.id),
        }
        #: what the engine thread has said, and is still to be taken
        self._reports: deque[Report] = deque()
        #: whether the loop has been told so: to wake it for each costs as much as to take one
        self._reports_due = False
        self._takes: dict[type[Report], Callable[[Any], None]] = {
            protocol.Ready: self._ready,
            protocol.StartFailed: self._start_failed,
            protocol.VoiceList: self._voices_known,
            protocol.VoiceLoaded: self._loaded,
            protocol.VoiceUnloaded: self._unloaded,
            protocol.VoiceMemory: self._grown,
            protocol.VoiceChosen: self._speaks,
            protocol.Word: self._word,
            protocol.OutputChanged: self._output,
            protocol.Held: self._paused,
            protocol.Ended: self._ended,
            EngineSaid: lambda said: log.write(f"engine: {log.sanitize(said.line)}"),
            EngineDied: self._died,
            EngineMissing: self._missing,
            ThreadDied: self._thread_died,
        }
        #: whether the engine was told that a goal waits behind the one it has in hand, and whether by a neural voice
        self._followed = False, False

    def words(self) -> str:
        """Return what is done and how the engine is, for people; no goal's text: any user may read it."""
        scheduler, ready = self.scheduler, self.ready
        if self.engine_words != READY:
            doing = f"engine: {self.engine_words}"
        elif scheduler.paused:
            doing = "paused"
        else:
            doing = f"speaking {scheduler.active.id}" if scheduler.active else "idle"
        waiting = f", {scheduler.pending_count} waiting" if scheduler.pending_count else ""
        voice = f"; {ready.version or ready.driver}, {server_log.sound_of(ready)}" if ready else ""
        return log.sanitize(doing + waiting + voice)

    # -- what is waited for

    @property
    def awaits_voices(self) -> bool:
        """Whether the voices will be known."""
        return self.voices.listed is None and self.engine_words in {"starting", READY}

    # -- neural voices, which have to be loaded

    def want(self, voice: str | None, *, anew: bool = False) -> None:
        """Have goals wait for a voice, if it is a neural one that is not loaded; `apply` has it loaded if any does.

        `anew`: whatever was wrong with it before. Without an engine nothing is loaded: the next one's `Ready` asks.
        """
        model = model_of(voice)
        if not is_neural(model) or self.engine_words != READY:
            return
        if anew:
            self.voices.forgive(model)
        if self.voices.want(model, elapsed()) is Readiness.WAITING:
            self.scheduler.loading.wait_for(model)

    def _load_next(self) -> None:
        """Have the engine load what is needed next, if anything is, and there is room for it.

        Not its first beside a goal that is heard: that takes the libraries, too, and they stop all of the process for a
        tenth of a second in their start.
        """
        if not self.voices.lacking or self.engine_words != READY:
            return
        if self.scheduler.active and not self.voices.warm:
            return
        found = self.voices.next(self._needed(), model_of(self.scheduler.settings.voice))
        if found is None:
            return
        voice, drop = found
        if self.voices.neural[voice].state is Readiness.LOADING:
            self.scheduler.loading.begin(voice, elapsed())
        for each in drop:
            log.write(f"voice {log.sanitize(each)} dropped, to make room for {log.sanitize(voice)}")
            if each in self.voices.neural:
                self.scheduler.loading.wait_for(each)
        self.engine.load(voice, drop)

    def _needed(self) -> list[str]:
        """Return what has to be loaded for the goals, in their order.

        Not for one that is heard: its voice is there until it has spoken.
        """
        goals = (self._asked(each) for each in self.scheduler.unfinished() if each.voice is None)
        return list(filter(is_neural, dict.fromkeys(map(model_of, goals))))

    def _loaded(self, loaded: protocol.VoiceLoaded) -> None:
        server_log.loaded(loaded)
        self.voices.warm = self.voices.warm or loaded.seconds > 0
        self.voices.loaded(loaded.voice, loaded.error, elapsed())
        self.scheduler.loading.end(loaded.voice)
        self._drop_excess()
        self.apply(self.scheduler.tick(self._now()))

    def _grown(self, grown: protocol.VoiceMemory) -> None:
        self.voices.grown(grown.voice, grown.memory)
        self._drop_excess()
        self._load_next()

    def _drop_excess(self) -> None:
        """Have the engine drop voices, if they take more memory than they may; warn if one takes too much alone."""
        active, needed = self.scheduler.active, self._needed()
        speaking = model_of(active.voice) if active and active.voice else ""
        if is_neural(speaking) and not self.voices.is_loaded(speaking):
            return  # it was dropped, and keeps its memory until it has spoken: then the engine measures again
        for each in self.voices.excess(next(iter(needed), speaking), needed):
            log.write(f"voice {log.sanitize(each)} dropped: the voices take more than --voice-memory allows")
            if each in self.voices.neural:
                self.scheduler.loading.wait_for(each)
            self.engine.drop(each)
        words = self.voices.too_large()
        if words:
            log.write(log.sanitize(words))

    def _unloaded(self, unloaded: protocol.VoiceUnloaded) -> None:
        self.voices.unloaded(unloaded.voice, self._needed())
        if unloaded.voice in self.voices.neural:
            self.scheduler.loading.wait_for(unloaded.voice)
        self._load_next()

    def _speaks(self, speaks: protocol.VoiceChosen) -> None:
        active = self.scheduler.active
        if active is not None and active.id == speaks.id:
            self.scheduler.spoken_by(speaks.id, speaks.voice)
            if speaks.fallback_reason:
                log.write(log.sanitize(f"{speaks.id} is spoken by {speaks.voice}: {speaks.fallback_reason}"))
            self._load_next()  # its own may be dropped now

    def for_silence(self, record: Record) -> Place:
        """Return where to wait until the active goal is silent, goes on after a pause, or its end has been told."""
        return self._for_silence.setdefault(record, {})

    # -- pauses

    def pause(self, by: By) -> None:
        """Hold what is being spoken, and start nothing."""
        self.now()
        newly, effects, active = not self.scheduler.paused, self.scheduler.pause(), self.scheduler.active
        if newly:
            self._tell_paused(active if active and active.paused else None, by)
        self.apply(effects)

    def resume(self, by: By) -> Record | None:
        """Go on with what is held, or start what waits; return what was held, or is spoken anyway."""
        now = self.now()
        newly, active = self.scheduler.paused, self.scheduler.active
        if active and active.state is not State.ACTIVE:
            active = None  # it is being stopped
        self.silent = None
        effects = self.scheduler.resume(now)
        if newly:
            self._tell_paused(active, by)
        self.apply(effects)
        if active:
            go_on(self.for_silence(active))  # they will not see it silent any more
        return active

    def _tell_paused(self, held: Record | None, by: By) -> None:
        """Publish and log that speech is paused, or not any more."""
        paused, held_id = self.scheduler.paused, held.id if held else None
        self.news.tell([partial(self.subscribers.paused, held_id, paused=paused, by=by, at=time.time())])
        assert by.client
        log.write(f"{'paused' if paused else 'resumed'} by {server_log.who(by.client)}")

    # -- the scheduler's effects

    def now(self) -> Now:
        """Return the time, after whatever was due by then is done."""
        now = self._now()
        deadline = self.scheduler.deadline()
        if deadline is not None and deadline <= now.monotonic:
            self.apply(self.scheduler.tick(now))
        return now

    @staticmethod
    def _now() -> Now:
        return Now(elapsed(), time.time())

    def apply(self, effects: list[Effect]) -> None:
        """Carry out what the scheduler decided, in its order, but what is for the engine before what clients are told.

        So it works, or stops, while they are. What it says to that is taken in another turn of the loop: they hear of
        everything in the scheduler's order.
        """
        told, moved, at = [], False, time.time()
        for effect in effects:
            if isinstance(effect, Changed):
                told.append(partial(self._tell_changed, effect.record, effect.state, at))
                moved = moved or effect.state is not State.REJECTED
                continue
            try:
                self._orders[effect.order](effect.record)
            except Exception as error:  # noqa: BLE001 - the effects after it must not be lost: the engine would wait
                log.write_bug(effect.order.value, error)
        if moved:
            self.queue_changed()
        self.news.tell(told)
        self._tell_followed()
        self._load_next()  # a goal that has ended may have made room
        self._set_timer()
        self.changed()
        self.look_finished()

    def _tell_changed(self, record: Record, state: State, at: float) -> None:
        self.subscribers.changed(record, state, at)
        if state.terminal:
            server_log.ended(record, elapsed() - record.began)
            go_on(self._for_silence.pop(record, {}))
            self.look_finished()

    def _start(self, record: Record) -> None:
        self._followed = followed, by_neural = self._following()
        chosen = for_engine(record.say, self.scheduler.settings)
        if not is_neural(chosen["voice"] or ""):
            chosen["voice_only"] = False
        elif chosen["voice_only"]:
            if why := self.voices.failure(model_of(chosen["voice"])):
                self.report(protocol.Ended(record.id, protocol.OUTCOME_FAILED, Reason.VOICE_FAILED, why))
                return
            chosen["pitch"] = INITIAL.pitch  # another is for voices that have one
        self.engine.say(
            protocol.Speak(record.id, record.text or "", next_waits=followed, next_is_neural=by_neural, **chosen)
        )

    def _tell_followed(self) -> None:
        """Have the engine know that a goal waits behind the one it speaks: it makes good what the change will take."""
        active, following = self.scheduler.active, self._following()
        if active and following != self._followed:
            self._followed = following
            self.engine.announce_next(active.id, *following)

    def _following(self) -> tuple[bool, bool]:
        """Return whether a goal waits, and whether it asks for a neural voice."""
        following = next(self.scheduler.pending(), None)
        return following is not None, following is not None and is_neural(self._asked(following))

    def _asked(self, record: Record) -> str:
        """Return the voice that a goal asks for: its own, or the server's; "" for the engine's."""
        return record.say.voice or self.scheduler.settings.voice or ""

    def _set_timer(self) -> None:
        if self._timer:
            self._timer.cancel()
        deadline = self.scheduler.deadline()
        self._timer = None
        if deadline is not None:
            self._timer = self._loop.call_later(min(deadline - elapsed(), LOOK_EVERY), self._tick)

    def _tick(self) -> None:
        self.apply(self.scheduler.tick(self._now()))

    # -- the engine's reports

    def report(self, report: Report) -> None:
        """Take what the engine thread says, in its order, and a few at a time; called in any thread.

        A sentence of many words must not keep clients waiting who ask for something meanwhile: words that come faster
        than they can be told wait, and the clients have their turn in between.
        """
        self._reports.append(report)
        if not self._reports_due:
            self._reports_due = True
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left who would want to know
                self._loop.call_soon_threadsafe(self._take_reports)

    def _take_reports(self) -> None:
        # Before it looks: what is added after the last look finds it so, and tells the loop again.
        self._reports_due = False
        for _ in range(AT_ONCE):
            if not self._reports:
                return
            report = self._reports.popleft()
            try:
                if take := self._takes.get(type(report)):  # what else the process says is for its thread alone
                    take(report)
            except Exception as error:  # noqa: BLE001 - what comes after it must not be lost
                log.write_bug("a report of the engine", error)
        self._reports_due = True
        self._loop.call_soon(self._take_reports)

    def _voices_known(self, voices: protocol.VoiceList) -> None:
        self.voices.listed = voices.voices
        go_on(self.for_voices)

    def _died(self, died: EngineDied) -> None:
        self.scheduler.engine_lost()
        given_up = self.voices.engine_lost(elapsed())
        if given_up:
            log.write(log.sanitize(f"voice {given_up} is left alone: {self.voices.failure(given_up)}"))
        self._set_timer()
        self._engine_fails(died.message)

    def _missing(self, missing: EngineMissing) -> None:
        self.apply(self.scheduler.engine_missing(missing.message, self.now()))

    def _ready(self, ready: protocol.Ready) -> None:
        if self.ready is None and ready.voice is not None:
            self.scheduler.settings = replace(self.scheduler.settings, voice=ready.voice)
        if self.ready is None or self.ready != replace(ready, player=self.ready.player):
            server_log.ready(ready, self._for_player)
        self.ready, self.engine_words, self.voices.driver = ready, READY, ready.driver
        self.engine_known.set()
        now = self.now()
        for voice in (*self._needed(), self.scheduler.settings.voice):
            self.want(voice)
        self.apply(self.scheduler.engine_ready(now))

    def _start_failed(self, failed: protocol.StartFailed) -> None:
        if failed.usage_error and self.ready is None:
            self.lost(UsageError(failed.message))
            return
        self._engine_fails(failed.message)
        if failed.permanent:
            self.engine_known.set()
            # None will come: goals need not wait to be told.
            self.apply(self.scheduler.engine_ready(self.now()))

    def _engine_fails(self, words: str) -> None:
        if words != self.engine_words:
            log.write(log.sanitize(words))
        self.engine_words = words
        go_on(self.for_voices)
        self.changed()

    def _thread_died(self, died: ThreadDied) -> None:
        """End: there is nothing left that could speak, and a supervisor will start another server."""
        self._engine_fails(died.message)
        self.lost(TalkError(died.message))
        if self.scheduler.active:
            self.apply(
                self.scheduler.failed(self.scheduler.active.id, Reason.ENGINE_FAILED, died.message, None, self._now())
            )

    def _ended(self, ended: protocol.Ended) -> None:
        now = self.now()
        active = self.scheduler.active
        if active is None or active.id != ended.id:
            return  # it was given up before the engine came to its end, perhaps just now
        if self.ready and ended.player:  # status shows what plays, not what was tried first
            self.ready = replace(self.ready, player=ended.player)
        if ended.outcome == protocol.OUTCOME_COMPLETED:
            effects = self.scheduler.completed(ended.id, ended.duration, now, ended.gaps, ended.gap_seconds)
        elif ended.outcome == protocol.OUTCOME_STOPPED and active.stop_since is not None:
            effects = self.scheduler.stopped(ended.id, now)
        else:
            reason, words = ended.reason or Reason.ENGINE_FAILED, ended.message or "the engine stopped by itself"
            effects = self.scheduler.failed(ended.id, reason, words, ended.duration, now)
        self.apply(effects)

    def _word(self, word: protocol.Word) -> None:
        active = self.scheduler.active
        if active is None or active.id != word.id:
            return
        record = self.scheduler.heard(word.id, word.end)
        text = (record.text or "")[word.start : word.end]
        self.news.tell([partial(self.subscribers.heard, word, text, time.time())])

    def _output(self, told: protocol.OutputChanged) -> None:
        active = self.scheduler.active
        if active is not None and active.id == told.id:
            self.scheduler.goes_to(told.id, Output.from_json(told.output))

    def _paused(self, paused: protocol.Held) -> None:
        active = self.scheduler.active
        if active is not None and active.id == paused.id and active.paused and active.holds == paused.number:
            self.silent = active
            go_on(self.for_silence(active))

    # -- the end

    def shut_down(self) -> None:
        """End every goal, and take no other."""
        self.engine_known.set()
        self.apply(self.scheduler.shutdown(self._now()))

    def look_finished(self) -> None:
        """Set `finished`, where everything has ended and that is told."""
        if self.scheduler.closing and self.scheduler.active is None and self.news.told:
            self.finished.set()
