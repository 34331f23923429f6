"""The completion scripts of bash, zsh and fish, as they are made from the commands.

`python -m talkcli.completion DIRECTORY` writes them. Those in `completions/` are checked in, and compared by a test.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from talkcli.cli.commands import talk
from talkcli.cli.shells import Bash, Fish, Zsh

if TYPE_CHECKING:
    from click.shell_completion import ShellComplete

#: Under the names by which each shell finds them in its own directory.
FILES: dict[str, type[ShellComplete]] = {"talk.bash": Bash, "_talk": Zsh, "talk.fish": Fish}


def scripts() -> dict[str, str]:
    """Return the name and the text of each script."""
    return {name: kind(talk, {}, "talk", "_TALK_COMPLETE").source() for name, kind in FILES.items()}


def main(directory: str) -> None:
    """Write the scripts into a directory."""
    for name, text in scripts().items():
        with open(os.path.join(directory, name), "w", encoding="utf-8") as file:
            file.write(text)


if __name__ == "__main__":
    main(sys.argv[1])
