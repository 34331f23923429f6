"""`talk doctor`."""

from __future__ import annotations

import click

from talkcli.cli.common import common, common_options
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, screen, show, show_json
from talkcli.dial import Interrupted

#: What nobody would hear: design's code of a goal that is ABORTED.
_NOT_HEARD = 4


@click.command("doctor")
@click.option("--silent", is_flag=True, help="Play the test sentence without sound; all else is checked as ever.")
@common_options
@click.pass_context
def command(context: click.Context, silent: bool) -> int:
    """Check everything between a sentence and a loudspeaker, in order, and say the one thing to do next.

    Each check is a line: done, warning or failed. At last a sentence is played: by the server, where it waits its turn
    (20 seconds at most), or without a server by an engine of this command's own, with TALK_PLAYER and TALK_VOICE.

    \b
      talk doctor
      talk doctor --silent                    at night: all of it, without a sound
      ssh robot talk doctor                   the exit code comes back
      talk --json doctor | jq 'select(.state != "done")'

    Exit codes: 0 a sentence would be heard; 4 it would not, as without a server; 2 usage.
    """
    from talkcli.doctor.examine import Examination
    from talkcli.doctor.findings import heard
    from talkcli.doctor.report import lines, verdict

    options = common(context)
    found = []
    with Interrupts() as interrupts:
        try:
            for finding in Examination(options.socket, silent=silent, interrupt=interrupts.descriptor).findings():
                found.append(finding)
                if options.json:
                    show_json(finding.to_json())
                else:
                    for line in lines(finding, screen()):
                        show(line)
                if interrupts.number is not None:
                    return interrupts.exit_code
        except Interrupted:
            return interrupts.exit_code
    if not options.json and not options.quiet:
        note(verdict(found, screen()))
    return 0 if heard(found) else _NOT_HEARD
