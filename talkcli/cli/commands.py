"""The table of all commands, with their help texts, options and exit codes.

This module is imported before a request is sent, so it must not have slow imports or side effects. The options of goals
and servers are in `goals.options`. The functions here check combinations of options.
"""

from __future__ import annotations

import os

from talkcli.cli.command import FILE_MODE, OUTPUT_FILE, Command, option, spelling
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals import options as goal_options
from talkcli.goals.options import FLAG, ID, IDS, INTEGER, MAX_LOG_GOALS, MAX_TEXT_CHARS, NUMBER, TEXT, WORD, Option

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: The maximum for --max-queue and for --ahead.
MAX_QUEUED_GOALS = 10_000


def _timeout_option(words: str) -> Option:
    """Return a --timeout option with this help text."""
    return option("-t, --timeout", NUMBER, words, limits=(0, None), excludes_minimum=True, metavar="SEC")


def _print_unit_option(*names: str) -> Option:
    words = f"Print a systemd unit with these options, and end. One of {', '.join(names)}; it says where it goes."
    return option("--print-unit", TEXT, words, metavar="UNIT", choices=names)


def _say_options() -> Iterator[Option]:
    """Yield the options of `say` in the order in which help lists them."""
    for each in goal_options.OPTIONS:
        if each.flags:
            yield replace(each, env="", help=f"{each.help}  [env var, with -o: {each.env}]") if each.env else each
        if each.name == "wait":
            yield _timeout_option("With --wait: cancel it after SEC seconds; time in the queue counts; exit code 124.")
        elif each.name == "id":
            what = "What the sender calls itself."
            yield Option("name", WORD, special_flags="--as", metavar="NAME", help=what, env="TALK_NAME")
    yield option("--lines", FLAG, "Speak each line of standard input, as it comes; no TEXT then.")
    words = "With --lines: at most N of its goals are pending; other lines wait in the command.  [default: 10]"
    yield option("--ahead", INTEGER, words, limits=(1, MAX_QUEUED_GOALS))
    words = "Write it into a file instead; '-' is standard output. Needs no server."
    yield option("-o, --output", OUTPUT_FILE, words, metavar="FILE.wav")


_SAY_OPTIONS = tuple(_say_options())
#: Options of `say` that can be combined with --output.
_SERVERLESS_OPTIONS = {"timeout", "output", *(each.name for each in goal_options.SOUND_OPTIONS)}
#: File extensions of audio formats other than WAV.
_OTHER_EXTENSIONS = (".aac", ".aiff", ".au", ".flac", ".m4a", ".mp3", ".mp4", ".oga", ".ogg", ".opus", ".webm", ".wma")


def _say_rule(given: Mapping[str, Any], typed: frozenset[str]) -> str | None:
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
    *(each.for_serve() for each in goal_options.SETTINGS),
    # At two seconds per sentence, 100 goals are more than three minutes of speech. Searching a queue of the maximum
    # length takes about a millisecond.
    option("--max-queue", INTEGER, "Goals that may wait.", default=100, limits=(1, MAX_QUEUED_GOALS)),
    option("--max-text", INTEGER, "Characters of one text.", default=MAX_TEXT_CHARS, limits=(1, MAX_TEXT_CHARS)),
    # Each client uses a file descriptor, and a process can usually open 1,024 of them.
    option("--max-clients", INTEGER, "Clients at once.", default=256, limits=(1, None)),
    option(
        "--player",
        TEXT,
        "What plays the sound. One of pulse (the sound server), aplay, pacat and pw-cat; null (silent, in real time); "
        "file:PATH.wav; or a command that reads 16-bit mono PCM, with {rate} for its rate and {device} for the "
        "--device. [default: the first of the four that works]",
        metavar="PLAYER",
        env="TALK_PLAYER",
        completion="players",
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
        limits=(0, goal_options.MAX_LEAD_IN_MS),
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
    _print_unit_option("user", "system", "user-socket", "system-socket"),
)


def _serve_rule(given: Mapping[str, Any], _: frozenset[str]) -> str | None:
    player = given["player"] or ""
    if given["device"] and player.startswith(("null", "file:")):
        return f"--device means nothing to the player {player}"
    if player == "file:":
        return "--player file: names no file: write file:PATH.wav"
    return None


def _bridge_rule(given: Mapping[str, Any], _: frozenset[str]) -> str | None:
    if given["name"] is None and not given["print_acl"]:
        return "--name is missing: what the robot is called on the broker"
    return None


_GOAL_IDS = Option("ids", IDS, metavar=IDS.metavar, completion="goal_ids")

#: All commands, in the order in which help lists them. The most important ones for new users come first.
_ROWS = (
    Command(
        name="serve",
        summary="Run the server, in the foreground.",
        description="""
        Run the server, in the foreground, until SIGTERM or Ctrl-C.

        It queues sentences and speaks one at a time; its log is on standard error. For systemd it prints its own
        units.
        """,
        function="services:serve",
        uses_server=False,
        examples="""
        talk serve --rate 150
        talk serve --player null       no sound, same timing: for simulation and CI
        talk serve --print-unit user   a service for systemd, with how to install it
        """,
        exit_codes={
            0: "ended by SIGTERM or SIGINT; by a second one 128+n",
            2: "usage: an option or a voice that there isn't",
            11: "this socket is served already, or its directory is not safe",
        },
        options=_SERVE_OPTIONS,
        rule=_serve_rule,
    ),
    Command(
        name="say",
        summary="Speak a sentence.",
        description="""
        Speak TEXT: its words, joined by blanks; or standard input, as one sentence, where TEXT is '-'.

        Prints the goal's id. Without --wait it returns as soon as the goal is accepted. With --wait it owns the
        goal: Ctrl-C, SIGTERM and SIGHUP cancel it, and so does a reader of its output that goes away, as ssh does.
        With --lines its exit code is that of the first line that did not succeed. With --ttl a line's time counts
        from when it was read.
        """,
        function="say:say",
        fleet_function="several:say",
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
            0: "accepted; with --wait succeeded: all of it was played; throttled, as was asked for",
            4: "aborted: engine or audio failed; 'talk doctor' says more",
            5: "rejected: never queued (bad text, full queue or full server)",
            6: "recalled: taken out of the queue before it was spoken; with --lines: not sent within its --ttl",
            7: "preempted: stopped while it was spoken",
            12: "lost: it was sent, then the server went away; it may still be spoken",
            124: "timed out, and cancelled",
            "128+n": "ended by signal n, and cancelled; 141: whoever read its output went away while it waited",
        },
        options=_SAY_OPTIONS,
        argument=Option("text", TEXT, metavar="TEXT..."),
        unknown_option_hint="To speak a text that starts with '-', write: talk say -- TEXT",
        rule=_say_rule,
    ),
    Command(
        name="wait",
        summary="Wait until goals have ended.",
        description="""
        Wait until these goals have ended, whoever sent them; without an ID, all that are active or pending now.

        It only watches: Ctrl-C and --timeout cancel nothing. A goal that has ended already is answered at once.
        """,
        function="wait:wait",
        fleet_function="several:wait",
        examples="""
        id=$(talk say "moving back")
        move_back
        talk wait "$id"
        """,
        exit_codes={
            0: "all succeeded; or no ID was given, and all have ended",
            4: "aborted; 4 to 7 are those of the first goal in order that did not succeed",
            5: "rejected; or the server has as many clients as it takes",
            6: "recalled",
            7: "preempted",
            8: "unknown goal",
            12: "lost: the server went away",
            124: "timed out; the goals go on",
            "128+n": "ended by signal n, 141: whoever read its output went away meanwhile; the goals go on",
        },
        options=(
            _timeout_option("Wait no longer than SEC seconds; the goals go on; exit code 124."),
            option("-f, --feedback", FLAG, "Show each word as it is heard."),
        ),
        argument=_GOAL_IDS,
    ),
    Command(
        name="cancel",
        summary="Stop speaking: everything, or what is named.",
        description="""
        Stop speaking: the goals that are named, or everything, from every client. Returns when it is silent.

        Prints the ids of the goals that ended because of it. Nothing to cancel is success. Selectors add up.
        """,
        fleet_function="several:cancel",
        examples="""
        talk cancel                 everything, now
        talk cancel --current       this sentence; the next one follows
        talk cancel --key battery   what was sent with --key battery
        talk cancel 12 13           these goals of this server
        """,
        exit_codes={0: "it is silent, or was already", 8: "an ID is unknown; the others are cancelled all the same"},
        options=tuple(each for each in goal_options.Cancel.options if each.flags),
        argument=_GOAL_IDS,
        urgent=True,
    ),
    Command(
        name="status",
        summary="What is being said, what will be, what was.",
        description="Show what is being said, what will be and what was; with an ID, all that is known of that goal.",
        fleet_function="several:status",
        examples="""
        talk status
        talk status 12                          goal 12 of this server
        talk --json status | jq .active.text
        """,
        exit_codes={0: "the server runs", 8: "unknown goal"},
        argument=Option("goal_id", ID, metavar="[ID]", completion="known_ids"),
        urgent=True,
    ),
    Command(
        name="watch",
        summary="Follow all goals as they happen.",
        description="""
        Show all goals as they happen, from now on: who says what, how it ends and why. Ctrl-C ends it.

        It begins with what is being said and what waits. On a terminal, what is over at once is left out: that a
        goal waits where nothing is before it, that one is being stopped. In a pipe, each event is a line.

        With --json each event is an object a line, words included; the first is {"event": "snapshot", ...}.
        """,
        examples="""
        talk watch
        ssh robot talk watch
        talk --json watch | jq -r 'select(.event == "word").word'
        """,
        exit_codes={
            12: "lost: the server went away",
            "128+n": "ended by signal n: 130 by Ctrl-C, 141 where its reader is gone",
        },
        options=(option("-f, --words", FLAG, "A line for each word as it is heard, too."),),
    ),
    Command(
        name="log",
        summary="What was said: when, by whom, how it ended.",
        description="""
        Show what was said: when and how each goal ended, its text, who sent it, and why it ended; the newest last.

        Who sent it is the program that called talk, the process id of talk itself, and after "as" what the sender
        calls itself. Rejected goals are listed, too.
        """,
        examples="""
        talk log
        talk log -n 100 | grep patrol
        talk --json log | jq -r 'select(.state == "ABORTED").message'
        """,
        exit_codes={0: "listed"},
        options=(
            option("-n, --count", INTEGER, "The last N goals that ended.", default=20, limits=(1, MAX_LOG_GOALS)),
        ),
    ),
    Command(
        name="pause",
        summary="Hold speech where it is.",
        description="""
        Hold speech where it is, until 'talk resume'. Returns when it is silent; twice is success.

        Nothing is spoken until then, whoever sends it and however urgent it is. Goals can be sent and cancelled.
        """,
        fleet_function="several:pause",
        examples="talk pause; listen_to_the_operator; talk resume",
        exit_codes={
            0: "speech is held, and it is silent",
            1: "speech is held, but that it is silent was not known within 2 seconds",
        },
    ),
    Command(
        name="resume",
        summary="Go on where speech was held.",
        description="Go on where 'talk pause' held speech. Twice is success, and so is without a pause.",
        fleet_function="several:resume",
        examples="talk resume",
        exit_codes={0: "speech goes on"},
    ),
    Command(
        name="set",
        summary="Change the running server's settings, or print them.",
        description="""
        Change settings of the running server; without an option, print them.

        They hold for each goal that doesn't bring its own, from the next one that begins; --preempt and --ttl from
        the next one that is sent. A server that is started anew has those of its command line.
        """,
        function="ask:change",
        fleet_function="several:change",
        examples="""
        talk set
        talk set --rate 150 --volume 0.5
        talk set --voice en-us --no-preempt
        """,
        exit_codes={
            0: "changed, or printed",
            2: "usage: a value out of its range, or an unknown voice; nothing was changed",
        },
        options=tuple(each.for_set() for each in goal_options.SETTINGS),
    ),
    Command(
        name="voices",
        summary="List the voices.",
        description="""
        List the voices of the server's engine: id, language, name. Any of the three can be given as a voice.

        So can a locale, and a language in English: de_DE, german.

        Behind the voices are variants: each goes behind any of them. Neural voices come last, and are given by as much
        of their id as it takes to tell one from the others: "joe" is enough for "piper/en_US-joe-medium". If one has
        several speakers, a number or a name goes behind: "piper/NAME#3". Where the server speaks with a neural voice,
        that one's language means it, too.
        """,
        examples="""
        talk voices --language en
        talk serve --voice en-us
        talk say --voice en-us+f3 "a variant"
        """,
        exit_codes={0: "listed", 1: "no voice speaks that language, or the engine can't list them"},
        options=(
            option("--language", TEXT, "Only this language, with its variants: en, pt-BR, german.", metavar="LANGUAGE"),
        ),
    ),
    Command(
        name="doctor",
        summary="Check everything between a sentence and a loudspeaker.",
        description="""
        Check everything between a sentence and a loudspeaker, in order, and say the one thing to do next.

        Each check is a line: ok, warning or failed. At last a sentence is played: by the server, where it waits
        its turn (20 seconds at most), or without a server by an engine of this command's own, with TALK_PLAYER and
        TALK_VOICE. With --silent it is always that engine, which plays zeros by the server's player: no goal waits,
        and none is in the log.

        With --robot it is the way to a robot of a fleet: broker, certificate, login, rights, the robot's answer.
        """,
        connects=False,
        examples="""
        talk doctor
        talk doctor --silent                    at night: all of it, without a sound
        ssh robot talk doctor                   the exit code comes back
        talk doctor --robot anna                what is between here and anna
        talk --json doctor | jq 'select(.state != "ok")'
        """,
        exit_codes={
            0: "a sentence would be heard; with --robot: the robot answers",
            4: "it would not, as without a server",
            "128+n": "ended by signal n",
        },
        options=(option("--silent", FLAG, "Play half a second of zeros, which is no goal and no sound."),),
    ),
    Command(
        name="bridge",
        summary="Be a robot on an MQTT broker, in the foreground.",
        description="""
        Be the robot of this name on an MQTT broker, in the foreground, until SIGTERM or Ctrl-C.

        Who may write to it there can have it speak, by the server of this machine. Its log is on standard error.

        TALK_BROKER names the broker: mqtts://HOST, or mqtt://HOST without TLS. Beside it are TALK_MQTT_USER and
        TALK_MQTT_PASSWORD_FILE, and for certificates TALK_MQTT_CA, TALK_MQTT_CERT and TALK_MQTT_KEY, all three files.
        """,
        function="services:bridge",
        uses_server=False,
        examples="""
        TALK_BROKER=mqtts://broker talk bridge --name anna
        talk bridge --name anna --group warehouse,night --allow say,cancel
        talk bridge --name anna --print-unit system   a service for systemd
        talk bridge --print-acl                       for the broker
        """,
        exit_codes={
            0: "ended by SIGTERM or SIGINT",
            2: "usage: a setting that is wrong or missing, or paho-mqtt is",
            11: "another bridge of this name is there already",
        },
        options=(
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
            _print_unit_option("user", "system"),
            option("--print-acl", FLAG, "Print who may do what on the broker; for mosquitto's acl_file."),
        ),
        rule=_bridge_rule,
    ),
    Command(
        name="fleet",
        summary="The robots of a fleet: who is there, what each says.",
        description="""
        Show the robots of a fleet, by its broker (TALK_BROKER): who is there, and what each says.

        'status' is a table: whether a robot is there, its server's version, what it speaks, how many goals wait, how
        the last one ended and how long ago, and since when it is there. 'watch' goes on with what happens.

        --robot picks some of them: a name, a glob such as 'wh-*', or a group as @warehouse.
        """,
        function="fleet:fleet",
        fleet_function="fleet:fleet",
        connects=False,
        examples="""
        talk fleet status
        talk fleet status --robot @warehouse
        talk --json fleet status | jq -r 'select(.presence.online | not).robot'
        talk fleet watch
        """,
        exit_codes={
            0: "shown",
            2: "usage: a setting that is wrong or missing, or paho-mqtt is",
            3: "no broker, or it knows no robot, or none of those that are meant",
            9: "the broker does not speak MQTT 5",
            10: "the broker doesn't let this user in, or ask; or it is not to be trusted",
            12: "lost: 'watch' has found no broker for 30 seconds",
            "128+n": "ended by signal n: 130 by Ctrl-C, 141 where its reader is gone",
        },
        argument=Option("what", WORD, metavar="WHAT", choices=("status", "watch")),
    ),
    Command(
        name="completion",
        summary="Print the completion script of a shell.",
        description="""
        Print the completion script of a shell: bash, zsh or fish. Its start file loads it.

        Tab then completes commands, options and their values, and what the running server knows: goals, keys,
        voices.
        """,
        function="completion:completion",
        uses_server=False,
        examples="""
        eval "$(talk completion bash)"   the last line of ~/.bashrc
        eval "$(talk completion zsh)"    the last line of ~/.zshrc
        talk completion fish | source    the last line of ~/.config/fish/config.fish
        """,
        exit_codes={
            0: "printed",
            2: "usage: a shell that there is no script for",
        },
        argument=Option("shell", WORD, metavar="SHELL", choices=("bash", "zsh", "fish")),
    ),
)
COMMANDS = {each.name: each for each in _ROWS}
