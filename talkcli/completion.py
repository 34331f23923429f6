"""The completion scripts of bash, zsh and fish, as click makes them from the commands.

`python -m talkcli.completion DIRECTORY` writes them. Those in `completions/` are checked in, and compared by a test.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from click.shell_completion import BashComplete, FishComplete, ShellComplete, ZshComplete

if TYPE_CHECKING:
    from click import Command

#: Under the names by which each shell finds them in its own directory.
FILES: dict[str, type[ShellComplete]] = {"talk.bash": BashComplete, "_talk": ZshComplete, "talk.fish": FishComplete}


def scripts() -> dict[str, str]:
    """Return the name and the text of each script."""
    from talkcli.cli import talk

    return {name: _script(kind, talk) for name, kind in FILES.items()}


def _script(kind: type[ShellComplete], talk: Command) -> str:
    made = kind(talk, {}, "talk", "_TALK_COMPLETE")
    # Not `made.source()`, which for bash first runs the bash of the machine that makes the script to learn its version.
    return made.source_template.strip() % made.source_vars() + "\n"


def main(directory: str) -> None:
    """Write the scripts into a directory."""
    for name, text in scripts().items():
        with open(os.path.join(directory, name), "w", encoding="utf-8") as file:
            file.write(text)


if __name__ == "__main__":
    main(sys.argv[1])
