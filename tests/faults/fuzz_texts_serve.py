"""Runs the real `talk serve` without the guard before the library; arguments as of `serve`."""

from __future__ import annotations

import os
import sys

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))

from talkcli.cli import main as run_talk
from talkcli.engine import process
from tests.faults.fuzz_texts import engine_command


def main() -> None:
    """Run `talk serve`."""
    unguarded = engine_command(guarded=False)
    process.engine_command = lambda: unguarded
    sys.argv = ["talk", "serve", *sys.argv[1:]]
    run_talk()


if __name__ == "__main__":
    main()
