"""The choice of a player for each sentence, as `--player` and `--device` command.

No player stays open between two sentences. If a player fails, the playback decides whether the next one is tried.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from functools import partial
from importlib import import_module

from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.builtin import WavPlayer, WavStreamPlayer
from talkcli.engine.child.players.program import ProgramPlayer
from talkcli.engine.players import FILE_PREFIX, PLAYERS, PlayerMissing, player_commands
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from talkcli.engine.child.players.base import Player
    from talkcli.engine.protocol import Configure, Speak
    from talkcli.goals.goal import Output

#: The automatic players that run in this process instead of a program; they are tried first.
_AUTOMATIC = [name for name, each in PLAYERS.items() if each.automatic and each.opens]

#: Seconds without sound after which a device counts as idle, so the next sentence starts with the lead-in. Sound cards
#: with power saving (snd_hda_intel) sleep after 1 s, and sound servers suspend a device after 5 s. Played silence
#: counts as idle, because loudspeakers switch themselves off by what they hear.
IDLE_AFTER_S = 1.0

#: The number of handovers whose median predicts the next one. The median ignores a late one on a busy machine.
MAX_HANDOVERS = 5

#: The most seconds of silence to cut. Half of the pause after a sentence stays, because it separates sentences.
MAX_CUT_S = 0.12

#: The longest handover. If it takes longer, the waiting goal was canceled or held, and another one came later.
MAX_HANDOVER_S = 0.5


class HandoverTimes:
    """The times that changes from one sentence to the next have taken, and the silence to cut because of them.

    A sentence ends with a pause. After it, the player drains and ends, the server is told, and the next sentence
    starts. This makes a queue 25 to 40 ms slower than it should sound. If another goal waits, the playback therefore
    cuts as much inaudible silence from the end of the sentence as recent handovers took. A sentence that nothing
    follows is played to its last sample.

    Handovers are measured per player and separately for neural voices, which need about 0.1 s more for their first
    sound. Nothing is cut until a handover has been measured. The class is pure: times are monotonic and passed in.
    """

    def __init__(self) -> None:
        #: whether another goal waits behind the current one, and whether that one needs a neural voice
        self.next_waits = self.next_is_neural = False
        self._measured: dict[tuple[str, bool], deque[float]] = {}
        #: the previous sentence's player and the time of its last sample; None if no goal waited behind it
        self._previous: tuple[str, float] | None = None

    @property
    def follows(self) -> bool:
        """Whether the sentence that starts follows another one directly."""
        return self._previous is not None

    def silence_to_cut(self, player: str) -> float:
        """Return the seconds of silence to cut from the end of a sentence of this player."""
        measured = sorted(self._measured.get((player, self.next_is_neural), ()))
        return min(MAX_CUT_S, measured[len(measured) // 2]) if measured else 0.0

    def sentence_ended(self, player: str, last_sample_at: float) -> None:
        """Record the end of a sentence that was played completely."""
        self._previous = (player, last_sample_at) if self.next_waits else None

    def sentence_started(self, player: str, at: float, *, neural: bool = False) -> None:
        """Record the time at which the player of a new sentence took its first sample."""
        previous, self._previous = self._previous, None
        if previous is not None and previous[0] == player and 0 < at - previous[1] < MAX_HANDOVER_S:
            self._measured.setdefault((player, neural), deque(maxlen=MAX_HANDOVERS)).append(at - previous[1])


class PlayerChooser:
    """The players of one engine process, and the output of the current sentence.

    Args:
        configure: The engine's settings: the player, the device and so on.
        inherited: Descriptors that every player program inherits.
    """

    def __init__(self, configure: Configure, inherited: Sequence[int] = ()) -> None:
        self._configure = configure
        self._inherited = inherited
        #: whether playing takes as long as the sound lasts; only files are faster
        self.takes_time = configure.output_fd is None and not (configure.player or "").startswith(FILE_PREFIX)
        #: the names of the players to try that run in this process
        self._in_process: Sequence[str] = ()
        if configure.player is configure.device is None:
            self._in_process = _AUTOMATIC
        elif configure.player in PLAYERS and PLAYERS[configure.player].opens:
            self._in_process = [configure.player]
        self._streaming = False
        self.handovers = HandoverTimes()
        #: the current sentence's output; None if it isn't known
        self.output: Output | None = None
        #: milliseconds of lead-in that the current sentence asks for; None for the engine's setting
        self._own_lead_in: int | None = None
        #: whether the current sentence fails if the output is muted
        self._audible = configure.audible
        #: the name of the player that last played a sentence to its end
        self.last_player = configure.last_player
        #: the name of the player that plays the current sentence, if the choice is automatic
        self.chosen: str | None = None
        self._last_used_at: float | None = None

    def candidates(self, rate: int) -> Iterator[Callable[[], Player]]:
        """Yield functions that open the players to try for a sentence, best first.

        Programs are searched for only when the caller asks for them.
        """
        player, device = self._configure.player, self._configure.device
        if not self.takes_time:
            yield partial(self._open_file, rate)
            return
        yield from (partial(_open, name, rate, device, self._audible) for name in self._in_process)
        if player in self._in_process:
            return
        try:
            found = player_commands(player, device, rate, self.last_player)
        except PlayerMissing as error:
            yield partial(_fail, CannotSpeak(Reason.NO_PLAYER, str(error)))
            return
        yield from (partial(ProgramPlayer, command, self._inherited) for command in found)

    def begin(self, command: Speak) -> None:
        """Prepare for a new sentence."""
        self._own_lead_in = command.lead_in
        self._audible = self._configure.audible if command.audible is None else command.audible
        self.output = self.chosen = None
        self.handovers.next_waits, self.handovers.next_is_neural = command.next_waits, command.next_is_neural

    def update_output(self, player: Player) -> None:
        """Record where the current sentence is played; once it was muted, it counts as muted to its end."""
        if player.proven and self._configure.player is None:
            self.chosen = player.name
        output, before = player.output, self.output
        if before is None:
            self.output = output
        elif output is not None:
            self.output = replace(output, muted=output.muted or before.muted)
        elif player.proven and before.player != player.name and not before.muted:
            self.output = None  # this player can't tell where it plays

    def device_released(self, silent_since: float | None = None) -> None:
        """Record that the device was closed now, or has played only silence since `silent_since`."""
        self._last_used_at = time.monotonic() if silent_since is None else silent_since

    def lead_in_seconds(self, begins: bool = True) -> float:
        """Return the seconds of silence to play first on a player that opens now.

        Args:
            begins: Whether the player starts the sentence. If it continues a sentence after a long pause, the
                sentence's own lead-in only wakes up an idle device.
        """
        idle = self._last_used_at is None or time.monotonic() - self._last_used_at >= IDLE_AFTER_S
        own = self._own_lead_in
        milliseconds, due = (self._configure.lead_in, idle) if own is None else (own, begins or idle)
        return milliseconds / 1000 if due else 0.0

    def first_player(self) -> str | None:
        """Return the name of the player that is tried first, for people; None if there is no player."""
        if self._configure.output_fd is not None:
            return WavStreamPlayer.name
        if self._configure.player is not None:
            return self._configure.player
        for name in self._in_process:
            with contextlib.suppress(CannotSpeak):
                _open(name, 1).kill()
                return name
        try:
            return player_commands(None, None, 1, self.last_player)[0].name
        except PlayerMissing:
            return None

    def _open_file(self, rate: int) -> Player:
        if self._configure.output_fd is None:
            return WavPlayer((self._configure.player or "").removeprefix(FILE_PREFIX), rate)
        first, self._streaming = not self._streaming, True
        return WavStreamPlayer(self._configure.output_fd, rate, first=first)


def _open(name: str, rate: int, device: str | None = None, audible: bool = False) -> Player:
    """Open the player that a row of PLAYERS names by its class."""
    module, _, member = PLAYERS[name].opens.partition(":")
    opens = getattr(import_module(f"talkcli.engine.child.players.{module}"), member)
    player: Player = opens(rate, device, audible)
    return player


def _fail(error: CannotSpeak) -> Player:
    raise error
