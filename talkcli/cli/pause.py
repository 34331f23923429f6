"""`talk pause`."""

from __future__ import annotations

import click

from talkcli.cli.asking import pause
from talkcli.cli.common import common, common_options


@click.command("pause")
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Hold speech where it is, until 'talk resume'. Returns when it is silent; twice is success.

    Nothing is spoken until then, whoever sends it and however urgent it is. Goals can be sent and cancelled.

    \b
      talk pause; listen_to_the_operator; talk resume

    Exit codes: 0 speech is held; 3 no server.
    """
    return pause(common(context))
