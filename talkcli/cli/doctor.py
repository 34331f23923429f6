"""`talk doctor`: shows each finding as it is made, and what they mean together. It looks at nothing itself."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, screen, show_found
from talkcli.doctor.examine import Examination
from talkcli.doctor.report import heard, lines, verdict
from talkcli.goals.states import EXIT_CODES, State

if TYPE_CHECKING:
    from talkcli.cli.show import Common

#: What nobody would hear ends as a goal that nobody hears.
_NOT_HEARD = EXIT_CODES[State.ABORTED]


def doctor(options: Common, silent: bool) -> int:
    """Show each finding and, at last, the one thing to do next; return the exit code."""
    found = []
    with Interrupts() as interrupts:
        for finding in Examination(options.socket, silent=silent, interrupt=interrupts.watched).findings():
            found.append(finding)
            show_found(options, [finding.to_json()], partial(lines, finding, screen()))
            if interrupts.number is not None:
                break
    if interrupts.number is not None:
        return interrupts.exit_code
    if not options.json and not options.quiet:
        note(verdict(found, screen()))
    return 0 if heard(found) else _NOT_HEARD
