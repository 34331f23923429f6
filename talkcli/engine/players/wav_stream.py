"""A WAV file that is written as the sound is made: into a pipe, a device, or a file that the shell has opened.

Nobody can go back in it, so its header says of its lengths that they are unknown. Whoever reads it decides how long it
takes. The descriptor is shared with other programs, so whether it blocks is not ours to change: it is given what fits.
"""

from __future__ import annotations

import os
import select

from talkcli.engine.players.base import AudioFailed
from talkcli.engine.players.wav import endless_header

TYPE_CHECKING = False
if TYPE_CHECKING:
    from talkcli.engine.players.base import Interest


class WavStreamPlayer:
    """The stream, for one of the sentences that follow each other in it."""

    real_time = False
    proven = True
    name = "the output"

    def __init__(self, output: int, rate: int, *, first: bool) -> None:
        """`output`: an open descriptor; `first`: whether this sentence begins the stream."""
        self._output = output
        self._header = endless_header(rate) if first else b""
        self._poll = select.poll()
        self._poll.register(output, select.POLLOUT)
        self._taken = 0
        self._closed = False

    def offer(self, data: memoryview) -> int:
        """Write the samples if there is room: a pipe that poll calls writable takes a header and a piece at least."""
        if not self._poll.poll(0):
            return 0
        try:
            written = os.write(self._output, self._header + data if self._header else data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise AudioFailed("audio_lost", f"{self.name}: {error.strerror}") from error
        header = min(written, len(self._header))
        self._header = self._header[header:]
        self._taken += written - header
        return written - header

    def consumed(self) -> int:
        """Return what was written."""
        return self._taken

    def close(self) -> None:
        """Take note that the sentence is complete; the next may follow."""
        self._closed = True

    def ended(self) -> bool:
        """Return True once it is closed."""
        return self._closed

    def interests(self) -> list[Interest]:
        """Return the output, for when it takes more or its reader is gone."""
        return [(self._output, select.POLLOUT)]

    def wake_at(self) -> float | None:
        """Return None: poll will tell."""
        return None

    def kill(self) -> None:
        """Write no more."""
        self._closed = True

    def gone(self) -> bool:
        """Return True once it is closed: what was written waits nowhere in here."""
        return self._closed
