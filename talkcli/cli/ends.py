"""How a command ends: whatever it raises becomes words on standard error and an exit code."""

from __future__ import annotations

import os
import sys

from talkcli import __version__
from talkcli.cli.show import (
    give_up_output,
    has_failed,
    never_readable,
    no_room,
    note,
    output_failed,
    reader_is_gone,
    show_error,
)
from talkcli.errors import EXIT_ERROR, EXIT_SIGINT, EXIT_SIGPIPE, TalkError
from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.cli.show import Common


class OutputClosed(Exception):
    """Standard output is closed. Under its own name, because click ends the process with 1 for a broken pipe."""


def ended(command: Callable[[], object], options: Common) -> int:
    """Run a command, and return its exit code: what it returns, if that is a number, else 0; or that of its error."""
    try:
        code = command()
        if sys.stdout:
            sys.stdout.flush()
    except TalkError as error:
        show_error(error, json=options.json)
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_SIGINT
    except MemoryError:
        note(_without_memory())
        return EXIT_ERROR
    except Exception as error:
        if isinstance(error, OutputClosed) or reader_is_gone(error) or never_readable(error):
            give_up_output()
            return EXIT_SIGPIPE
        if no_room(error):
            output_failed(error)
            return EXIT_ERROR
        if os.environ.get("TALK_DEBUG"):
            raise
        note(f"a bug in talk {__version__}: {type(error).__name__}: {error} (TALK_DEBUG=1 shows where)")
        return EXIT_ERROR
    return (code if isinstance(code, int) else 0) or (EXIT_ERROR if has_failed() else 0)


def _without_memory() -> str:
    from talkcli import resources

    return f"there is not enough memory for talk: {resources.limits()}"
