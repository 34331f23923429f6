"""What there may be at a place where a client reaches nobody: as clients and the doctor call it. Pure."""

from __future__ import annotations

ABSENT = "not there"
FILE = "a file, and no socket"
DIRECTORY = "a directory, and no socket"
STALE = "nobody answers: left over from a server that ended"
FORBIDDEN = "no permission"
