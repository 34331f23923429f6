"""`talk doctor`: shows each finding as it is made, and what they mean together. It looks at nothing itself."""

from __future__ import annotations

import click

from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.interrupts import Interrupts
from talkcli.cli.show import note, screen, show, show_json
from talkcli.client.dial import Interrupted
from talkcli.goals.states import EXIT_CODES, State

#: What nobody would hear ends as a goal that nobody hears.
_NOT_HEARD = EXIT_CODES[State.ABORTED]


@talk_command(
    "doctor",
    examples="""
        talk doctor
        talk doctor --silent                    at night: all of it, without a sound
        ssh robot talk doctor                   the exit code comes back
        talk --json doctor | jq 'select(.state != "done")'
    """,
    exit_codes={
        0: "a sentence would be heard",
        1: "anything not named here; a bug says so",
        2: "usage",
        4: "it would not, as without a server",
        "128+n": "ended by signal n",
    },
)
@click.option("--silent", is_flag=True, help="Play half a second of zeros, which is no goal and no sound.")
@common_options
@click.pass_context
def command(context: click.Context, silent: bool) -> int:
    """Check everything between a sentence and a loudspeaker, in order, and say the one thing to do next.

    Each check is a line: done, warning or failed. At last a sentence is played: by the server, where it waits its turn
    (20 seconds at most), or without a server by an engine of this command's own, with TALK_PLAYER and TALK_VOICE. With
    --silent it is always that engine, which plays zeros by the server's player: no goal waits, and none is in the log.
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
