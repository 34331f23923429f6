"""`talk doctor`: shows each finding as it is made, and what they mean together. It looks at nothing itself."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING

from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, screen, show_found
from talkcli.doctor.report import heard, lines, verdict
from talkcli.goals.states import EXIT_CODES, State
from talkcli.paths import named_robot

if TYPE_CHECKING:
    from collections.abc import Mapping

    from talkcli.cli.show import Common
    from talkcli.doctor import broker, examine

#: What nobody would hear ends as a goal that nobody hears.
_NOT_HEARD = EXIT_CODES[State.ABORTED]


def doctor(options: Common, silent: bool) -> int:
    """Show each finding and, at last, the one thing to do next; return the exit code."""
    found = []
    with Interrupts() as interrupts:
        examination = _examination(options, interrupts.watched, silent=silent)
        for finding in examination.findings():
            found.append(finding)
            show_found(options, [finding.to_json()], partial(lines, finding, screen()))
            if interrupts.number is not None:
                break
    if interrupts.number is not None:
        return interrupts.exit_code
    if not options.json and not options.quiet:
        note(verdict(found, screen(), examination.question))
    return 0 if heard(found, examination.question) else _NOT_HEARD


def _examination(
    options: Common, interrupt: Mapping[int, int], *, silent: bool
) -> examine.Examination | broker.Examination:
    """Return what looks: at this machine, or at the broker where a robot of a fleet is named."""
    robot = named_robot(options.robot, options.socket)
    if robot is None:
        from talkcli.doctor.examine import Examination

        return Examination(options.socket, silent=silent, interrupt=interrupt)
    from talkcli.fleet.broker import need_client

    need_client()
    from talkcli.doctor import broker

    return broker.Examination(robot, os.environ, insecure=options.insecure, interrupt=interrupt)
