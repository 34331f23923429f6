"""How long an engine process may take for what it has to do, whoever watches it: server, `say -o`, `talk doctor`."""

from __future__ import annotations

#: Seconds until a process that was started must be ready: a cold start from an SD card takes two or three.
START_LIMIT = 10.0
#: Seconds without a sign of life from a process that has a goal in hand; it sends one each `protocol.ALIVE_EVERY`.
HANG_AFTER = 3.0
#: Seconds after which a stop that isn't confirmed becomes a kill.
STOP_LIMIT = 0.15
#: Seconds after a kill in which process and player must be gone.
SILENCE_LIMIT = 2.0
#: Seconds after which a pause that isn't confirmed becomes a kill, twice what a client waits for it: a driver that is
#: not ours may finish its word first, or more.
PAUSE_LIMIT = 4.0
