"""Run `talk serve`, with its arguments, but without the guard for libespeak-ng."""

from __future__ import annotations

import os
import sys

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))

from talkcli.cli import main
from talkcli.engine.parent import process
from tests.tools.fuzz_texts import engine_command

if __name__ == "__main__":
    unguarded = engine_command(guarded=False)
    process.engine_command = lambda: unguarded
    sys.argv = ["talk", "serve", *sys.argv[1:]]
    main()
