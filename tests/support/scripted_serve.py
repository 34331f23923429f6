"""Run `talk serve` with the scripted engine, with the arguments of `serve`."""

from __future__ import annotations

import os
import sys

from talkcli.cli import main as run_talk
from talkcli.engine.parent import process

_ENGINE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "scripted_engine.py")


def replace_engine() -> None:
    """Have this process start the scripted engine."""
    process.engine_command = lambda: [sys.executable, _ENGINE]


def main() -> None:
    replace_engine()
    sys.argv = ["talk", "serve", *sys.argv[1:]]
    run_talk()


if __name__ == "__main__":
    main()
