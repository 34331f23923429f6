"""Where the sound goes: opens a player for each sentence, as `--player` and `--device` say.

It remembers which player worked, when the device was last in use, and how long the change from one sentence to the next
took: none is open between two. That the next one is tried where a player fails is the playback's business.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from functools import partial
from importlib import import_module

from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.program import ProgramPlayer
from talkcli.engine.child.players.wav import WavPlayer, WavStreamPlayer
from talkcli.engine.players import FILE_PREFIX, PLAYERS, PlayerMissing, player_commands
from talkcli.frozen import TYPE_CHECKING, replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from talkcli.engine.child.players.base import Player
    from talkcli.engine.protocol import Configure, Say
    from talkcli.goals.goal import Output

#: The players that are tried before the programs if neither a player nor a device is named.
_AUTOMATIC = [name for name, each in PLAYERS.items() if each.automatic and each.opens]

#: Seconds after which a device that was let go of counts as idle, and gets the lead-in again: the power saving of sound
#: cards (snd_hda_intel) begins after 1 s where it is on, sound servers suspend a device after 5 s. Silence counts as
#: idle: loudspeakers that switch themselves off do so by what they hear.
IDLE_AFTER = 1.0

#: Changes by which the next is judged, by their median: one that was late, on a busy machine, changes nothing.
REMEMBERED = 5

#: Seconds that are left out at most: half of a sentence's own pause stays on any machine, as it tells sentences apart.
MOST = 0.12

#: A change that took longer was none: the goal that had waited was recalled, or held, and another came later.
LONGEST = 0.5


class Gap:
    """How long it takes from one sentence to the next, and what is left out for it.

    By the players' names, and by whether the next is a neural voice's, which takes some 0.1 s to its first sound.

    A sentence ends in a pause of its own. Behind that its player drains and ends, the server is told, and the next one
    is started: 25 to 40 ms by which a queue would be slower than it should sound. So where another goal waits, as much
    as the last changes took is left out of the silence at the end, of samples that nobody can hear: the playback does
    so, in `_audible_end`. A sentence that nothing follows is played to its last sample.

    Pure: the time comes in as an argument (monotonic seconds). Nothing is guessed: until two sentences have followed
    each other by the same player, nothing is left out.
    """

    def __init__(self) -> None:
        #: whether another goal waits behind the one in hand, and whether by a neural voice
        self.followed = self.by_neural = False
        self._took: dict[tuple[str, bool], deque[float]] = {}
        #: the player of the sentence before, and when its last sample was to be heard; None if nothing waited behind it
        self._before: tuple[str, float] | None = None

    @property
    def follows(self) -> bool:
        """Whether the sentence that begins comes right behind another."""
        return self._before is not None

    def allowance(self, player: str) -> float:
        """Return the seconds of silence that can be left out at the end of a sentence by this player."""
        took = sorted(self._took.get((player, self.by_neural), ()))
        return min(MOST, took[len(took) // 2]) if took else 0.0

    def ended(self, player: str, over_at: float) -> None:
        """Take note that a sentence was played to its end, and when the last of its samples was to be heard."""
        self._before = (player, over_at) if self.followed else None

    def began(self, player: str, at: float, *, neural: bool = False) -> None:
        """Take note that a sentence begins, and when its player took the first of its samples."""
        before, self._before = self._before, None
        if before is not None and before[0] == player and 0 < at - before[1] < LONGEST:
            self._took.setdefault((player, neural), deque(maxlen=REMEMBERED)).append(at - before[1])


class Players:
    """Where the sound of one engine process goes, as it was told at its start."""

    def __init__(self, configure: Configure, inherited: Sequence[int] = ()) -> None:
        """`inherited`: descriptors that every player program gets."""
        self._configure = configure
        self._inherited = inherited
        #: opens the player that is no program, for samples per second; None where programs play
        self._built_in = self._opens()
        #: whether what plays takes the time of its sound, and a while to begin: all but a file
        self.takes_time = configure.output is None and not (configure.player or "").startswith(FILE_PREFIX)
        #: whether nothing says what is to play
        self._any = configure.player is configure.device is None
        self._streaming = False
        #: what lies between two sentences
        self.gap = Gap()
        #: where the sentence in hand goes, and how loud, as far as that is known
        self.output: Output | None = None
        #: milliseconds of silence that the sentence in hand brings along; None for what it was told at the start
        self._own_lead_in: int | None = None
        #: whether the sentence in hand is to fail where it is muted
        self._audible = configure.audible
        #: the name of the player by which a sentence was played whole, the last time
        self.worked = configure.worked
        #: the name of the player that took the sentence in hand, where none is named
        self.chosen: str | None = None
        self._used_at: float | None = None

    def candidates(self, rate: int) -> Iterator[Callable[[], Player]]:
        """Return what opens the players to try for a sentence, best first; programs are looked for when asked for."""
        if self._built_in is not None:
            yield partial(self._built_in, rate)
            return
        if self._any:
            yield from (partial(_open, name, rate, None, self._audible) for name in _AUTOMATIC)
        try:
            found = player_commands(self._configure.player, self._configure.device, rate, self.worked)
        except PlayerMissing as error:
            yield partial(_fail, CannotSpeak("no_player", str(error)))
            return
        yield from (partial(ProgramPlayer, command, self._inherited) for command in found)

    def begin(self, say: Say) -> None:
        """Take note of a new sentence."""
        self._own_lead_in = say.lead_in
        self._audible = self._configure.audible if say.audible is None else say.audible
        self.output = self.chosen = None
        self.gap.followed, self.gap.by_neural = say.followed, say.by_neural

    def tell(self, player: Player) -> None:
        """Take note of where the sentence in hand goes now; that it was muted before is not forgotten."""
        if player.proven and self._configure.player is None:
            self.chosen = player.name
        output, before = player.output, self.output
        if before is None:
            self.output = output
        elif output is not None:
            self.output = replace(output, muted=output.muted or before.muted)
        elif player.proven and before.player != player.name and not before.muted:
            self.output = None  # nobody can know any more

    def let_go(self, silent_at: float | None = None) -> None:
        """Take note that a device was closed; `silent_at`: since when it had played nothing but silence."""
        self._used_at = time.monotonic() if silent_at is None else silent_at

    def lead_in(self, begins: bool = True) -> float:
        """Return the seconds of silence that a player which is started now begins with.

        `begins`: whether it begins the sentence, for which a lead-in of its own is; where the sentence was held for
        long, it wakes the device again.
        """
        idle = self._used_at is None or time.monotonic() - self._used_at >= IDLE_AFTER
        own = self._own_lead_in
        wanted, due = (self._configure.lead_in, idle) if own is None else (own, begins or idle)
        return wanted / 1000 if due else 0.0

    def first(self) -> str | None:
        """Return the name of what is tried first, for people; None if nothing is found."""
        if self._configure.output is not None:
            return WavStreamPlayer.name
        if self._configure.player is not None:
            return self._configure.player
        for name in _AUTOMATIC if self._any else ():
            with contextlib.suppress(CannotSpeak):
                player = _open(name, 1)
                player.kill()
                return player.name
        try:
            return player_commands(None, None, 1, self.worked)[0].name
        except PlayerMissing:
            return None

    def _opens(self) -> Callable[[int], Player] | None:
        player, device, output = self._configure.player or "", self._configure.device, self._configure.output
        if output is not None:
            return partial(self._stream, output)
        if player.startswith(FILE_PREFIX):
            return partial(WavPlayer, player.removeprefix(FILE_PREFIX))
        if player in PLAYERS and PLAYERS[player].opens:
            return lambda rate: _open(player, rate, device, self._audible)
        return None

    def _stream(self, output: int, rate: int) -> WavStreamPlayer:
        first, self._streaming = not self._streaming, True
        return WavStreamPlayer(output, rate, first=first)


def _open(name: str, rate: int, device: str | None = None, audible: bool = False) -> Player:
    """Open the player of a row in PLAYERS that is not a program."""
    module, _, member = PLAYERS[name].opens.partition(":")
    opens = getattr(import_module(f"talkcli.engine.child.players.{module}"), member)
    player: Player = opens(rate, device, audible)
    return player


def _fail(error: CannotSpeak) -> Player:
    raise error
