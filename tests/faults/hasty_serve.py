"""Run `talk serve` with the scripted engine, and check the socket file every 0.05 s."""

from __future__ import annotations

import os
import sys

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))

from talkcli.server import run
from tests.support import scripted_serve

if __name__ == "__main__":
    run.SOCKET_CHECK_S = 0.05
    scripted_serve.main()
