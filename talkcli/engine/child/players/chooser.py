"""Code that chooses a player for each sentence, according to `--player` and `--device`.

Every sentence gets its own player. If a player fails, the playback decides whether to try the next one.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from functools import partial
from importlib import import_module

from talkcli.engine.child.players.base import CannotSpeak
from talkcli.engine.child.players.builtin import WavPlayer, WavStreamPlayer, saved_rate
from talkcli.engine.child.players.program import ProgramPlayer
from talkcli.engine.models import voice_rate
from talkcli.engine.players import FILE_PREFIX, PLAYERS, PlayerMissing, player_commands
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.reasons import Reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from talkcli.engine.child.players.base import Player
    from talkcli.engine.protocol import Configure, Speak
    from talkcli.goals.goal import Output

#: The players that may be chosen automatically and run in this process. They are tried before any program.
_AUTOMATIC_CLASSES = [name for name, each in PLAYERS.items() if each.automatic and each.class_path]

#: A device counts as idle after this many seconds without sound. The next sentence then starts with the lead-in. Sound
#: cards with power saving (snd_hda_intel) sleep after 1 s, and sound servers suspend a device after 5 s. Playing
#: silence doesn't count as sound, because some loudspeakers switch off when they receive only silence.
IDLE_AFTER_S = 1.0

#: How many handover times to remember for each player. Their median predicts the next handover time.
MAX_HANDOVERS = 5

#: Maximum silence to cut from the end of a sentence, in seconds. This is half of the pause after a sentence. The other
#: half is kept, so that the sentences stay separate.
MAX_CUT_S = 0.12

#: A handover that takes more seconds than this isn't counted, because the waiting goal was probably cancelled or
#: paused.
MAX_HANDOVER_S = 0.5


class HandoverTimes:
    """Measures the delays between sentences, and decides how much silence to cut to make up for them.

    A handover is the time between the last sample of one sentence and the first sample of the next. During a handover,
    the player drains and exits, the server gets the result, and the next sentence starts. This would lengthen the pause
    between queued sentences by 25 to 40 ms. If another goal is waiting, the playback therefore cuts as much inaudible
    silence from the end of the sentence as recent handovers took. The last sentence in the queue is played completely.

    Handovers are measured for each player. Those to neural voices are measured separately, because such a voice needs
    about 0.1 s more for its first sound. Nothing is cut before the first measurement. The class is pure: it gets all
    times (monotonic) as arguments.
    """

    def __init__(self) -> None:
        #: whether another goal is waiting, and whether it needs a neural voice
        self.next_waits = self.next_is_neural = False
        self._measured: dict[tuple[str, bool], deque[float]] = {}
        #: the previous sentence's player and the time of its last sample, or None if no other goal was waiting
        self._previous: tuple[str, float] | None = None

    @property
    def goal_was_waiting(self) -> bool:
        """Whether another goal was waiting when the previous sentence ended."""
        return self._previous is not None

    def silence_to_cut(self, player_name: str) -> float:
        """Return how many seconds of silence to cut from the end of a sentence."""
        measured = sorted(self._measured.get((player_name, self.next_is_neural), ()))
        return min(MAX_CUT_S, measured[len(measured) // 2]) if measured else 0.0

    def sentence_ended(self, player_name: str, last_sample_at: float) -> None:
        """If another goal is waiting, record the time of the completed sentence's last sample."""
        self._previous = (player_name, last_sample_at) if self.next_waits else None

    def sentence_started(self, player_name: str, at: float, *, neural: bool = False) -> None:
        """Record the delay since the previous sentence, if the new sentence was already waiting."""
        previous, self._previous = self._previous, None
        if previous is not None and previous[0] == player_name and 0 < at - previous[1] < MAX_HANDOVER_S:
            self._measured.setdefault((player_name, neural), deque(maxlen=MAX_HANDOVERS)).append(at - previous[1])


class PlayerChooser:
    """Decides which players an engine process tries, and in which order.

    Args:
        configure: The settings of the engine process, such as the player and the device.
        inherited: Descriptors that every player program inherits.
    """

    def __init__(self, configure: Configure, inherited: Sequence[int] = ()) -> None:
        self._configure = configure
        self._inherited = inherited
        #: whether playing takes as long as the sound lasts; False only for files
        self.takes_time = configure.output_fd is None and not (configure.player or "").startswith(FILE_PREFIX)
        #: the names of the players that run in this process and are tried first
        self._in_process: Sequence[str] = ()
        if configure.player is configure.device is None:
            self._in_process = _AUTOMATIC_CLASSES
        elif configure.player in PLAYERS and PLAYERS[configure.player].class_path:
            self._in_process = [configure.player]
        self._streaming = False
        self.handovers = HandoverTimes()
        #: the output of the current sentence, or None if it is unknown
        self.output: Output | None = None
        #: the lead-in of the current sentence in milliseconds, or None to use the engine's setting
        self._own_lead_in: int | None = None
        #: whether the current sentence fails if the output is muted
        self._audible = configure.audible
        #: the player that worked last, if it was chosen automatically
        self.last_player = configure.last_player
        #: monotonic time at which the last player became silent, or None if no player has played yet
        self.silent_since: float | None = None

    def candidates(self, rate: int) -> Iterator[Callable[[], Player]]:
        """Yield functions that open the players to try, best first.

        Programs are searched for only after the players in this process have been tried.
        """
        player, device = self._configure.player, self._configure.device
        if not self.takes_time:
            yield partial(self._open_wav_player, rate)
            return
        yield from (partial(_open_in_process, name, rate, device, self._audible) for name in self._in_process)
        if player in self._in_process:
            return
        try:
            found = player_commands(player, device, rate, self.last_player)
        except PlayerMissing as error:
            yield partial(_raise_error, CannotSpeak(Reason.NO_PLAYER, str(error)))
            return
        yield from (partial(ProgramPlayer, command, self._inherited) for command in found)

    def begin_goal(self, command: Speak) -> None:
        """Store the player settings of a new goal, and forget the previous goal's output."""
        self._own_lead_in = command.lead_in
        self._audible = self._configure.audible if command.audible is None else command.audible
        self.output = None
        self.handovers.next_waits, self.handovers.next_is_neural = command.next_waits, command.next_is_neural

    def required_rate(self, voice: str | None) -> int | None:
        """Return the sample rate that a sound must have in a WAV file, or None if any rate can be played.

        All samples in a WAV file have the same rate. A new file gets the rate of this voice.
        """
        if self.takes_time:
            return None
        rate = saved_rate((self._configure.player or "").removeprefix(FILE_PREFIX))
        return rate or voice_rate(voice or "")

    def record_output(self, player: Player) -> None:
        """Record a player's output with its volume and mute state, and the player itself if it works.

        The player is recorded only if it was chosen automatically.

        A sentence that was ever muted counts as muted.
        """
        if player.proven and self._configure.player is None:
            self.last_player = player.name
        output, before = player.output, self.output
        if before is None:
            self.output = output
        elif output is not None:
            self.output = replace(output, muted=output.muted or before.muted)
        elif player.proven and before.player != player.name and not before.muted:
            self.output = None  # the new player doesn't know its output

    def lead_in_seconds(self, at_beginning: bool = True) -> float:
        """Return how many seconds of silence a new player must play first.

        Args:
            at_beginning: Whether the player plays the beginning of the sentence. Otherwise, it continues the sentence
                after a long pause, and a lead-in is needed only if the device is idle.
        """
        idle = self.silent_since is None or time.monotonic() - self.silent_since >= IDLE_AFTER_S
        own = self._own_lead_in
        milliseconds, due = (self._configure.lead_in, idle) if own is None else (own, at_beginning or idle)
        return milliseconds / 1000 if due else 0.0

    def find_first_player(self) -> str | None:
        """Find the player that the next sentence would use. Return the player's name, or None.

        Players that run in this process are opened and closed to test them.
        """
        if self._configure.output_fd is not None:
            return WavStreamPlayer.name
        if self._configure.player is not None:
            return self._configure.player
        for name in self._in_process:
            with contextlib.suppress(CannotSpeak):
                _open_in_process(name, 1).kill()
                return name
        try:
            return player_commands(None, None, 1, self.last_player)[0].name
        except PlayerMissing:
            return None

    def _open_wav_player(self, rate: int) -> Player:
        """Return a player that writes to the configured WAV file or stream."""
        if self._configure.output_fd is None:
            return WavPlayer((self._configure.player or "").removeprefix(FILE_PREFIX), rate)
        first, self._streaming = not self._streaming, True
        return WavStreamPlayer(self._configure.output_fd, rate, first=first)


def _open_in_process(name: str, rate: int, device: str | None = None, fail_if_muted: bool = False) -> Player:
    """Open and return the player with this name, which runs in this process."""
    module, _, member = PLAYERS[name].class_path.partition(":")
    player_class = getattr(import_module(f"talkcli.engine.child.players.{module}"), member)
    player: Player = player_class(rate, device, fail_if_muted)
    return player


def _raise_error(error: CannotSpeak) -> Player:
    """Raise an error instead of opening a player."""
    raise error
