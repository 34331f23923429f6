"""The commands. Each has a row with a summary, its options, and the function that runs it.

This module is imported before anything is sent, so it must import nothing heavy, and it must not run anything. The
options of goals and servers are in `goals.options`. The functions here say which options can't be combined.
"""

from __future__ import annotations

import os

from talkcli.cli.command import FILE_MODE, OUTPUT_FILE, Command, option, spelling
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals.option import FLAG, ID, IDS, INTEGER, MAX_LOG, NUMBER, TEXT, WORD, Option
from talkcli.goals.options import MAX_CHARACTERS, MAX_LEAD_IN, OPTIONS, SETTINGS, SOUND, Cancel

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from collections.abc import Set as AbstractSet
    from typing import Any

#: The largest value of --max-queue, and so of --ahead.
MAX_QUEUED_GOALS = 10_000
#: The systemd units that `talk serve` and `talk bridge` can print.
SERVE_UNITS = ("user", "system", "user-socket", "system-socket")
BRIDGE_UNITS = ("user", "system")
#: The shells that have a completion script.
SHELLS = ("bash", "zsh", "fish")


def _timeout(words: str) -> Option:
    """Return the option --timeout. `words` is its help."""
    return option("-t, --timeout", NUMBER, words, limits=(0, None), above=True, metavar="SEC")


def _print_unit(names: tuple[str, ...]) -> Option:
    words = f"Print a systemd unit with these options, and end. One of {', '.join(names)}; it says where it goes."
    return option("--print-unit", TEXT, words, metavar="UNIT", choices=names)


def _say_options() -> Iterator[Option]:
    """Yield the options of `say` in the order of the help: those of a goal, and those of the command itself."""
    for each in OPTIONS:
        if each.flags:
            yield replace(each, env="", help=f"{each.help}  [env var, with -o: {each.env}]") if each.env else each
        if each.name == "wait":
            yield _timeout("With --wait: cancel it after SEC seconds; time in the queue counts; exit code 124.")
        elif each.name == "id":
            what = "What the sender calls itself."
            yield Option("name", WORD, flags="--as", metavar="NAME", help=what, env="TALK_NAME")
    yield option("--lines", FLAG, "Speak each line of standard input, as it comes; no TEXT then.")
    words = "With --lines: at most N of its goals are pending; other lines wait in the command.  [default: 10]"
    yield option("--ahead", INTEGER, words, limits=(1, MAX_QUEUED_GOALS))
    words = "Write it into a file instead; '-' is standard output. Needs no server."
    yield option("-o, --output", OUTPUT_FILE, words, metavar="FILE.wav")


_SAY_OPTIONS = tuple(_say_options())
#: Options of `say` that also work without a server.
_SERVERLESS_OPTIONS = {"timeout", "output", *(each.name for each in SOUND)}
#: File extensions of other audio formats than WAV.
_OTHER_EXTENSIONS = (".aac", ".aiff", ".au", ".flac", ".m4a", ".mp3", ".mp4", ".oga", ".ogg", ".opus", ".webm", ".wma")


def _say_rule(given: Mapping[str, Any], typed: AbstractSet[str]) -> str | None:
    output, text, waits = given["output"], given["text"], given["wait"] or given["feedback"]
    if output is not None:
        named = [spelling(each, given[each.name]) for each in _SAY_OPTIONS if each.name in typed - _SERVERLESS_OPTIONS]
        if named:
            return f"--output writes a file, without a server: leave out {', '.join(named)}"
        extension = os.path.splitext(output)[1]
        if extension.lower() in _OTHER_EXTENSIONS:
            return f"--output writes WAV, not {extension}: name it .wav, and convert it with ffmpeg or sox"
    if given["lines"] and text:
        return "--lines reads standard input: leave out TEXT"
    if given["lines"] and given["id"] is not None:
        return "--lines makes a goal of each line, and --id names one: leave out one of them"
    if given["ahead"] is not None and not given["lines"]:
        return "--ahead is about the lines of --lines: add that, or leave out --ahead"
    if not given["lines"] and not text:
        return "TEXT is missing: what is to be said, or '-' for standard input"
    if given["flush"] and given["preempt"] is False:
        return "--flush goes first, and --queue does not: leave out one of them"
    if given["timeout"] is not None and not waits and output is None:
        return "--timeout needs --wait: without it, nothing is waited for"
    return None


_SERVE_OPTIONS = (
    *(each.at_start() for each in SETTINGS),
    # At two seconds a sentence, 100 goals are more than three minutes of speech. Going through the longest queue takes
    # about a millisecond.
    option("--max-queue", INTEGER, "Goals that may wait.", default=100, limits=(1, MAX_QUEUED_GOALS)),
    option("--max-text", INTEGER, "Characters of one text.", default=MAX_CHARACTERS, limits=(1, MAX_CHARACTERS)),
    # Each client takes one of the 1,024 file descriptors that a process usually has.
    option("--max-clients", INTEGER, "Clients at once.", default=256, limits=(1, None)),
    option(
        "--player",
        TEXT,
        "What plays the sound. One of pulse (the sound server), aplay, pacat and pw-cat; null (silent, in real time); "
        "file:PATH.wav; or a command that reads 16-bit mono PCM, with {rate} for its rate and {device} for the "
        "--device. [default: the first of the four that works]",
        metavar="PLAYER",
        env="TALK_PLAYER",
        offers="players",
    ),
    option(
        "--device",
        TEXT,
        "Device, by the player's own name for it. For aplay one that 'aplay -L' lists, such as plughw:1,0; for "
        "pulse and pacat one of 'pactl list short sinks'; for pw-cat the name of a node, as in 'pw-cli ls Node'. Name "
        "the --player, too.",
        metavar="NAME",
    ),
    option(
        "--lead-in",
        INTEGER,
        "Milliseconds of silence before a sentence; only where the output was idle: HDMI, USB and Bluetooth "
        "outputs fall asleep, and swallow what comes while they wake.",
        default=0,
        limits=(0, MAX_LEAD_IN),
        metavar="MS",
    ),
    option("--audible", FLAG, "Abort every sentence whose output is muted."),
    option(
        "--voice-memory",
        INTEGER,
        "Megabytes of memory that neural voices may take; past it those not used for longest are dropped.",
        default=300,
        limits=(0, 100_000),
        metavar="MB",
    ),
    option("--driver", TEXT, "A driver of pyttsx3's. [default: the one for this system]", metavar="NAME"),
    option("--socket-mode", FILE_MODE, "Who may connect: the socket's file mode.", default="0600"),
    option("--greeting", TEXT, "A sentence to speak at the start."),
    _print_unit(SERVE_UNITS),
)


def _serve_rule(given: Mapping[str, Any], _: AbstractSet[str]) -> str | None:
    player = given["player"] or ""
    if given["device"] and player.startswith(("null", "file:")):
        return f"--device means nothing to the player {player}"
    if player == "file:":
        return "--player file: names no file: write file:PATH.wav"
    return None


_BRIDGE_OPTIONS = (
    option("--name", WORD, "The robot's name, which no other robot has.", metavar="NAME"),
    option("--group", WORD, "Groups that it is in besides 'all'; several with commas.", metavar="GROUP"),
    option(
        "--allow",
        WORD,
        "Requests that are taken from afar.",
        default="say,cancel,status,wait,log,voices,pause,resume",
        metavar="LIST",
    ),
    option("--no-text", FLAG, "Leave what is said out of status and events."),
    option("--homeassistant", FLAG, "Be a device of Home Assistant's as well."),
    _print_unit(BRIDGE_UNITS),
    option("--print-acl", FLAG, "Print who may do what on the broker; for mosquitto's acl_file."),
)


def _bridge_rule(given: Mapping[str, Any], _: AbstractSet[str]) -> str | None:
    if given["name"] is None and not given["print_acl"]:
        return "--name is missing: what the robot is called on the broker"
    return None


_GOAL_IDS = Option("ids", IDS, metavar=IDS.metavar, offers="goal_ids")

#: The commands in the order of the help. Those that a new user needs first come first.
_ROWS = (
    Command(
        name="serve",
        summary="Run the server, in the foreground.",
        function="serve:serve",
        plain=False,
        uses_server=False,
        options=_SERVE_OPTIONS,
        rule=_serve_rule,
    ),
    Command(
        name="say",
        summary="Speak a sentence.",
        function="say:say",
        fleet_function="several:say",
        options=_SAY_OPTIONS,
        argument=Option("text", TEXT, metavar="TEXT..."),
        unknown_option_hint="To speak a text that starts with '-', write: talk say -- TEXT",
        rule=_say_rule,
    ),
    Command(
        name="wait",
        summary="Wait until goals have ended.",
        function="wait:wait",
        fleet_function="several:wait",
        options=(
            _timeout("Wait no longer than SEC seconds; the goals go on; exit code 124."),
            option("-f, --feedback", FLAG, "Show each word as it is heard."),
        ),
        argument=_GOAL_IDS,
    ),
    Command(
        name="cancel",
        summary="Stop speaking: everything, or what is named.",
        function="ask:cancel",
        fleet_function="several:cancel",
        options=tuple(each for each in Cancel.options if each.flags),
        argument=_GOAL_IDS,
        urgent=True,
    ),
    Command(
        name="status",
        summary="What is being said, what will be, what was.",
        function="ask:status",
        fleet_function="several:status",
        argument=Option("goal_id", ID, metavar="[ID]", offers="known_ids"),
        urgent=True,
    ),
    Command(
        name="watch",
        summary="Follow all goals as they happen.",
        function="ask:watch",
        plain=False,
        options=(option("-f, --words", FLAG, "A line for each word as it is heard, too."),),
    ),
    Command(
        name="log",
        summary="What was said: when, by whom, how it ended.",
        function="ask:log",
        options=(option("-n, --count", INTEGER, "The last N goals that ended.", default=20, limits=(1, MAX_LOG)),),
    ),
    Command(
        name="pause",
        summary="Hold speech where it is.",
        function="ask:pause",
        fleet_function="several:pause",
    ),
    Command(
        name="resume",
        summary="Go on where speech was held.",
        function="ask:resume",
        fleet_function="several:resume",
    ),
    Command(
        name="set",
        summary="Change the running server's settings, or print them.",
        function="ask:change",
        fleet_function="several:change",
        options=tuple(each.to_set() for each in SETTINGS),
    ),
    Command(
        name="voices",
        summary="List the voices.",
        function="ask:voices",
        options=(
            option("--language", TEXT, "Only this language, with its variants: en, pt-BR, german.", metavar="LANGUAGE"),
        ),
    ),
    Command(
        name="doctor",
        summary="Check everything between a sentence and a loudspeaker.",
        function="ask:doctor",
        plain=False,
        connects=False,
        options=(option("--silent", FLAG, "Play half a second of zeros, which is no goal and no sound."),),
    ),
    Command(
        name="bridge",
        summary="Be a robot on an MQTT broker, in the foreground.",
        function="fleet:bridge",
        plain=False,
        uses_server=False,
        options=_BRIDGE_OPTIONS,
        rule=_bridge_rule,
    ),
    Command(
        name="fleet",
        summary="The robots of a fleet: who is there, what each says.",
        function="fleet:fleet",
        fleet_function="fleet:fleet",
        connects=False,
        argument=Option("what", WORD, metavar="WHAT", choices=("status", "watch")),
    ),
    Command(
        name="completion",
        summary="Print the completion script of a shell.",
        function="completion:completion",
        plain=False,
        uses_server=False,
        argument=Option("shell", WORD, metavar="SHELL", choices=SHELLS),
    ),
)
COMMANDS = {each.name: each for each in _ROWS}
