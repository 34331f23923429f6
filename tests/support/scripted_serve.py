"""Run `talk serve` with the scripted engine. The arguments are those of `serve`."""

from __future__ import annotations

import os
import sys

from talkcli.cli import main as run_talk
from talkcli.engine.parent import process

_ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
_CODE = f"import sys; sys.path.insert(0, {_ROOT!r}); from tests.support.scripted_engine import main; main()"


def engine_command() -> list[str]:
    """Return the command of the scripted engine. It doesn't search for installed packages, to start faster."""
    return [sys.executable, "-S", "-c", _CODE]


def replace_engine() -> None:
    """Make this process start the scripted engine."""
    process.engine_command = engine_command


def main() -> None:
    replace_engine()
    sys.argv = ["talk", "serve", *sys.argv[1:]]
    run_talk()


if __name__ == "__main__":
    main()
