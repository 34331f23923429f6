"""`talk resume`."""

from __future__ import annotations

import click

from talkcli.cli.asking import resume
from talkcli.cli.common import common, common_options


@click.command("resume")
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Go on where 'talk pause' held speech. Twice is success, and so is without a pause.

    \b
      talk resume

    Exit codes: 0 speech goes on; 3 no server.
    """
    return resume(common(context))
