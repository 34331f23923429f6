"""`talk completion`: prints the script by which a shell completes `talk`. The files in completions/ are the same."""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.cli.show import show

if TYPE_CHECKING:
    from talkcli.cli.show import Common


def completion(_: Common, shell: str) -> None:
    """Print the script of a shell."""
    from talkcli.cli.click_app import talk
    from talkcli.cli.shells import SHELLS

    show(SHELLS[shell](talk, {}, "talk", "_TALK_COMPLETE").source().rstrip("\n"))
