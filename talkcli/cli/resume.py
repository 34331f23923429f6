"""`talk resume` as click reads it: its help. What it does is in `asking`."""

from __future__ import annotations

import click

from talkcli.cli.asking import resume
from talkcli.cli.common import common, common_options, talk_command
from talkcli.cli.usage import ASKING


@talk_command(
    "resume",
    examples="""
        talk resume
    """,
    exit_codes={
        **ASKING,
        0: "speech goes on",
    },
)
@common_options
@click.pass_context
def command(context: click.Context) -> int:
    """Go on where 'talk pause' held speech. Twice is success, and so is without a pause."""
    return resume(common(context))
