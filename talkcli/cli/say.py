"""`talk say` as click reads it: its options, how they go together, its help.

What it does is in `saying`, `lines`, `rendering`.
"""

from __future__ import annotations

import os
import time
from typing import Any

import click
from click.core import ParameterSource

from talkcli.cli import complete
from talkcli.cli.common import common, common_options, number, seconds, talk_command, timeout_option, word
from talkcli.cli.interrupts import give_up_unread, watched_output
from talkcli.cli.outcome import rest
from talkcli.cli.saying import GOAL_OPTIONS, refuse, say
from talkcli.cli.usage import ASKING, Command, Number, WholeNumber, told
from talkcli.client.dial import Interrupted
from talkcli.errors import EXIT_SIGPIPE
from talkcli.goals.admission import MAX_KEY, PITCHES, RATES, VOLUMES, bad_option
from talkcli.goals.requests import Say

#: Options that mean something to a server alone.
_SERVER_ONLY = ("wait", "feedback", "lines", "preempt", "flush", "priority", "ttl", "key", "throttle", "id", "name")

#: Endings by which a file of another format than WAV would be meant.
_OTHER_FORMATS = (".aac", ".aiff", ".au", ".flac", ".m4a", ".mp3", ".mp4", ".oga", ".ogg", ".opus", ".webm", ".wma")


class _SayCommand(Command):
    """Says how to speak a text that looks like an option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            words = told(error)
            words += (
                f"{'' if words.endswith('?') else '.'} To speak a text that starts with '-', write: talk say -- TEXT"
            )
            raise click.UsageError(words, ctx) from error


@talk_command(
    "say",
    cls=_SayCommand,
    examples="""
        talk say "battery low"
        talk say --wait -- "$text" || echo "nobody heard it"
        talk say -wf "please step back"         each word as it is heard
        talk say --key battery --throttle 60 "battery low"
        fortune | talk say -
        tail -n 0 -F log | talk say --lines --ttl 10
        talk say -o hello.wav "hello"           needs no server
        talk say -o - "hello" | aplay
    """,
    exit_codes={
        **ASKING,
        0: "accepted; with --wait succeeded: all of it was played; throttled, as was asked for",
        4: "aborted: engine or audio failed; 'talk doctor' says more",
        5: "rejected: never queued (bad text, full queue or full server)",
        6: "recalled: taken out of the queue before it was spoken",
        7: "preempted: stopped while it was spoken",
        12: "lost: it was sent, then the server went away; it may still be spoken",
        124: "timed out, and cancelled",
        "128+n": "ended by signal n, and cancelled; 141: whoever read its output went away while it waited",
    },
)
@click.argument("text", nargs=-1, metavar="TEXT...")
@click.option("-w", "--wait", is_flag=True, help="Wait until it has ended; the exit code tells how.")
@timeout_option("With --wait: cancel it after SEC seconds; time in the queue counts; exit code 124.")
@click.option("-f", "--feedback", is_flag=True, help="Show each word as it is heard; implies --wait.")
@click.option(
    "--preempt/--queue",
    default=None,
    help="Stop what is spoken and go first, or wait in the queue. [default: as 'talk serve' was told]",
)
@click.option("--flush", is_flag=True, help="As --preempt, and drop what is in the queue.")
@click.option(
    "--priority",
    type=int,
    metavar="N",
    default=0,
    show_default=True,
    help="Higher goes first; what has a higher one is neither stopped nor dropped.",
)
@click.option(
    "--ttl",
    type=Number(0),
    callback=seconds,
    metavar="SEC",
    help="Drop it if it has not begun within SEC seconds; 0: no limit.",
)
@click.option(
    "--key",
    metavar="KEY",
    callback=word,
    shell_complete=complete.keys,
    help=f"A label of up to {MAX_KEY} characters; replaces what waits under the same one.",
)
@click.option(
    "--throttle",
    type=Number(0),
    callback=seconds,
    metavar="SEC",
    help="Don't say the same again within SEC seconds; what is the same, --key says, or else the text.",
)
@click.option("--id", metavar="ID", callback=word, help="An id of your own: sent twice, it is spoken once.")
@click.option(
    "--as",
    "name",
    metavar="NAME",
    callback=word,
    envvar="TALK_NAME",
    show_envvar=True,
    help="What the sender calls itself.",
)
@click.option("--rate", type=WholeNumber(*RATES), metavar="N", help="Words per minute.  [env var, with -o: TALK_RATE]")
@click.option(
    "--volume",
    type=Number(*VOLUMES),
    callback=number,
    metavar="X",
    help="Loudness.  [env var, with -o: TALK_VOLUME]",
)
@click.option(
    "--voice",
    metavar="VOICE",
    callback=word,
    shell_complete=complete.voices,
    help="Voice by id, name or language: see 'talk voices'.  [env var, with -o: TALK_VOICE]",
)
@click.option("--pitch", type=WholeNumber(*PITCHES), metavar="N", help="Pitch of the voice; 50 is its own.")
@click.option("--lines", is_flag=True, help="Speak each line of standard input, as it comes; no TEXT then.")
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False),
    metavar="FILE.wav",
    help="Write it into a file instead; '-' is standard output. Needs no server.",
)
@common_options
@click.pass_context
def command(context: click.Context, /, text: tuple[str, ...], **given: Any) -> int:
    """Speak TEXT: its words, joined by blanks; or standard input, as one sentence, where TEXT is '-'.

    Prints the goal's id. Without --wait it returns as soon as the goal is accepted. With --wait it owns the goal:
    Ctrl-C, SIGTERM and SIGHUP cancel it, and so does a reader of its output that goes away, as ssh does. With --lines
    its exit code is that of the first line that did not succeed.
    """
    began = time.monotonic()
    given["wait"] = given["wait"] or given["feedback"]
    _check(context, text, given)
    timeout, options = given["timeout"], common(context)
    end = None if timeout is None else began + timeout
    goal_options = {name: given[name] for name in GOAL_OPTIONS}
    fault = bad_option(Say("", **goal_options))
    if fault is not None:
        raise click.UsageError(fault, context)
    if given["output"] is None:
        give_up_unread()
    if given["lines"]:
        from talkcli.cli.lines import say_lines

        return say_lines(options, given["name"], goal_options, given["wait"], given["feedback"], timeout)
    sentence = " ".join(text)
    if text == ("-",):
        from talkcli.cli.stdin import InputTooLong, read_text

        try:
            watched = watched_output() if given["wait"] else {}
            sentence = read_text(end, watched, whole=given["output"] is not None)
        except InputTooLong as error:
            return refuse(f"Talk rejected: {error}", error.code, options, feedback=given["feedback"])
        except Interrupted:  # nothing was sent
            return EXIT_SIGPIPE
    if given["output"] is not None:
        from talkcli.cli.rendering import render_to, settings

        return render_to(given["output"], sentence, settings(context, given), rest(end), options)
    return say(options, sentence, given, end)


def _check(context: click.Context, text: tuple[str, ...], given: dict[str, Any]) -> None:
    """Refuse what contradicts itself, or says nothing."""

    def refuse(words: str) -> None:
        raise click.UsageError(words, context)

    if given["output"] is not None:
        named = [_spelt(context, each, given[each]) for each in _SERVER_ONLY if _typed(context, each)]
        if named:
            refuse(f"--output writes a file, without a server: leave out {', '.join(named)}")
        ending = os.path.splitext(given["output"])[1]
        if ending.lower() in _OTHER_FORMATS:
            refuse(f"--output writes WAV, not {ending}: name it .wav, and convert it with ffmpeg or sox")
    if given["lines"] and text:
        refuse("--lines reads standard input: leave out TEXT")
    if given["lines"] and given["id"] is not None:
        refuse("--lines makes a goal of each line, and --id names one: leave out one of them")
    if not given["lines"] and not text:
        refuse("TEXT is missing: what is to be said, or '-' for standard input")
    if given["flush"] and given["preempt"] is False:
        refuse("--flush goes first, and --queue does not: leave out one of them")
    if given["timeout"] is not None and not given["wait"] and given["output"] is None:
        refuse("--timeout needs --wait: without it, nothing is waited for")


def _typed(context: click.Context, name: str) -> bool:
    return context.get_parameter_source(name) is ParameterSource.COMMANDLINE


def _spelt(context: click.Context, name: str, value: object) -> str:
    """Return an option as it was typed, in its long form."""
    parameter = next(each for each in context.command.params if each.name == name)
    return (parameter.secondary_opts if value is False and parameter.secondary_opts else parameter.opts)[-1]
