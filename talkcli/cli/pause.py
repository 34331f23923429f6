"""`talk pause` as click reads it: its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli.asking import pause
from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.usage import ASKING


@talk_command(
    "pause",
    examples="""
        talk pause; listen_to_the_operator; talk resume
    """,
    exit_codes={
        **ASKING,
        0: "speech is held, and it is silent",
        1: "speech is held, but that it is silent was not known within 2 seconds",
    },
)
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Hold speech where it is, until 'talk resume'. Returns when it is silent; twice is success.

    Nothing is spoken until then, whoever sends it and however urgent it is. Goals can be sent and cancelled.
    """
    return pause(common(context))
