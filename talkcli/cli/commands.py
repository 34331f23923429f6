"""The table of all commands, with their help texts, options and exit codes.

This module is imported before a request is sent, so it must not have slow imports or side effects. The options of goals
and servers are in `goals.options`. The functions here check combinations of options.
"""

from __future__ import annotations

import os
import time

from talkcli.cli.command import FILE_MODE, OUTPUT_FILE, TIME_LIMIT, Command, long_flag, option
from talkcli.frozen import TYPE_CHECKING, replace
from talkcli.goals import options as goal_options
from talkcli.goals.options import (
    FLAG,
    ID,
    IDS,
    INTEGER,
    MAX_LOG_GOALS,
    MAX_TEXT_CHARS,
    NO_TEXT_HISTORY,
    PATH,
    TEXT,
    TEXT_HISTORY,
    WORD,
    Option,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any

#: The maximum for --max-queue and for --ahead.
MAX_QUEUED_GOALS = 10_000


def _timeout_option(help_text: str) -> Option:
    """Return a --timeout option with this help text."""
    return option("-t, --timeout", TIME_LIMIT, help_text, limits=(0, None), excludes_minimum=True)


def _print_unit_option(*names: str) -> Option:
    """Return a --print-unit option with a choice of systemd units."""
    words = f"Print a systemd unit with the given options, and exit. UNIT is one of {', '.join(names)}."
    return option("--print-unit", TEXT, words, metavar="UNIT", choices=names)


def _say_options() -> Iterator[Option]:
    """Yield the options of `say` in the order in which help lists them."""
    for each in goal_options.OPTIONS:
        if each.flags:
            yield replace(each, env="", help=f"{each.help}  [env var with -o: {each.env}]") if each.env else each
        if each.name == "wait":
            yield _timeout_option(
                "With --wait, cancel the sentence after TIME, such as 20s. This includes the time in the queue."
            )
        elif each.name == "id":
            what = "Set the sender's name, which is shown in the log."
            yield Option("name", WORD, special_flags="--as", metavar="NAME", help=what, env="TALK_NAME")
    yield option("--lines", FLAG, "Speak each line of standard input as it arrives.")
    words = "With --lines, keep at most N lines in the server's queue.  [default: 10]"
    yield option("--ahead", INTEGER, words, limits=(1, MAX_QUEUED_GOALS))
    yield option("--stream", FLAG, "Speak standard input as one text, while it arrives.")
    words = "Write the speech to a WAV file. '-' means standard output. No server is needed."
    yield option("-o, --output", OUTPUT_FILE, words, metavar="FILE.wav")
    words = "With --output, say words as FILE defines. For other sentences, use 'talk serve --pronounce FILE'."
    yield option("--pronounce", PATH, words, metavar="FILE", completion="files")


_SAY_OPTIONS = tuple(_say_options())
#: Options of `say` that can be combined with --output.
_SERVERLESS_OPTIONS = {"timeout", "output", "pronounce", "format", "dry_run"}
_SERVERLESS_OPTIONS |= {each.name for each in goal_options.SOUND_OPTIONS}
#: File extensions of audio formats other than WAV.
_OTHER_EXTENSIONS = (".aac", ".aiff", ".au", ".flac", ".m4a", ".mp3", ".mp4", ".oga", ".ogg", ".opus", ".webm", ".wma")


def _say_fault(values: Mapping[str, Any], typed: frozenset[str]) -> str | None:
    """Return an error message if the options of `say` are invalid or can't be combined."""
    output = values["output"]
    if output is not None:
        bad = [long_flag(each, values[each.name]) for each in _SAY_OPTIONS if each.name in typed - _SERVERLESS_OPTIONS]
        if bad:
            return f"--output writes a file without a server; leave out {', '.join(bad)}"
        extension = os.path.splitext(output)[1]
        if extension.lower() in _OTHER_EXTENSIONS:
            return "--output can only write WAV files; name the file .wav, and convert it with ffmpeg or sox"
        return _input_fault(values, typed)
    if values["pronounce"] is not None:
        return "--pronounce only works with --output; for other sentences, use: talk serve --pronounce FILE"
    if values["dry_run"] and (values["lines"] or values["stream"]):
        return "--dry-run prints a single text; leave out --lines and --stream"
    return _input_fault(values, typed) or _goal_fault(values)


def _goal_fault(values: Mapping[str, Any]) -> str | None:
    """Return an error message if options that `say` and `play` share can't be combined."""
    if values["flush"] and values["preempt"] is False:
        return "--flush and --queue can't be combined; leave out one of them"
    if values["timeout"] is not None and not (values["wait"] or values.get("feedback")):
        return "--timeout only works with --wait; add --wait, or leave out --timeout"
    return None


def _input_fault(values: Mapping[str, Any], typed: frozenset[str]) -> str | None:
    """Return an error message if TEXT is missing or conflicts with options for standard input."""
    text = values["text"]
    if values["stream"] and (values["lines"] or text not in {(), ("-",)}):
        return "--stream speaks standard input as one text; leave out TEXT and --lines"
    if "stall" in typed and not values["stream"]:
        return "--stall only works with --stream; add --stream, or leave out --stall"
    if values["lines"] and text:
        return "--lines reads standard input; leave out TEXT"
    if values["lines"] and values["id"] is not None:
        return "--lines speaks many lines, but --id can only name one goal; leave out one of them"
    if values["ahead"] is not None and not values["lines"]:
        return "--ahead only works with --lines; add --lines, or leave out --ahead"
    if not (values["lines"] or values["stream"] or text):
        return "TEXT is missing; type the sentence, or '-' to read standard input"
    return None


def _play_options() -> Iterator[Option]:
    """Yield the options of `play`: the options of `say` that make sense for a sound."""
    for each in _SAY_OPTIONS:
        if each.name not in goal_options.SPEECH_OPTIONS | _TEXT_OPTIONS:
            words = each.help.partition("  [env var with")[0].replace("it was spoken", "it was played")
            yield replace(each, help=words.replace("the sentence", "the sound").replace("his sentence", "his sound"))
    yield option("--list", FLAG, "Print the names of all sounds.")


#: Options of `say` for texts and words, in addition to `SPEECH_OPTIONS`.
_TEXT_OPTIONS = {"feedback", "format", "lines", "ahead", "stream", "output", "pronounce"}
_PLAY_OPTIONS = tuple(_play_options())


def _play_fault(values: Mapping[str, Any], typed: frozenset[str]) -> str | None:
    """Return an error message if the options of `play` can't be combined."""
    if values["list"]:
        return "--list takes no NAME and no other options" if values["sound"] or typed - {"list"} else None
    if not values["sound"]:
        return "NAME is missing; to list the sounds, type: talk play --list"
    return _goal_fault(values)


_PRONOUNCE_HELP = "Say words as FILE defines. Its lines look like: GmbH = gay em bay ha. A changed file is read again."
_SERVE_OPTIONS = (
    *(each.for_serve() for each in goal_options.SETTINGS),
    # At two seconds per sentence, 100 goals are more than three minutes of speech. Searching a queue of the maximum
    # length takes about a millisecond.
    option("--max-queue", INTEGER, "Let at most N goals wait in the queue.", default=100, limits=(1, MAX_QUEUED_GOALS)),
    option(
        "--max-text",
        INTEGER,
        "Accept texts of at most N characters.",
        default=MAX_TEXT_CHARS,
        limits=(1, MAX_TEXT_CHARS),
    ),
    # Each client uses a file descriptor, and a process can usually open 1,024 of them.
    option("--max-clients", INTEGER, "Accept at most N clients at the same time.", default=256, limits=(1, None)),
    option(
        "--player",
        TEXT,
        "Choose the player. It is pulse (the sound server), aplay, pacat, pw-cat, null (no sound, but usual timing), "
        "file:PATH.wav, or a command that reads 16-bit mono PCM. In a command, {rate} and {device} are replaced by "
        "their values. [default: the first of pulse, aplay, pacat and pw-cat that works]",
        metavar="PLAYER",
        env="TALK_PLAYER",
        completion="players",
    ),
    option(
        "--device",
        TEXT,
        "Play to this device. Device names depend on the player, so also set --player. To list the names, use "
        "'aplay -L' for aplay, 'pactl list short sinks' for pulse and pacat, or 'pw-cli ls Node' for pw-cat.",
        metavar="NAME",
    ),
    option(
        "--lead-in",
        goal_options.MILLISECONDS,
        "Play silence for TIME, such as 0.3s, if the output was idle. "
        "HDMI, USB and Bluetooth outputs then don't swallow the first word.",
        default=0,
        limits=(0, goal_options.MAX_LEAD_IN_MS),
        unit=" milliseconds",
    ),
    option("--audible", FLAG, "Abort sentences if the output is muted."),
    option(
        "--voice-memory",
        INTEGER,
        "Let neural voices use about MB megabytes of memory. Above this limit, the least recently used voice is "
        "unloaded.",
        default=300,
        limits=(0, 100_000),
        metavar="MB",
    ),
    option("--sounds", PATH, "Let 'talk play NAME' play DIR/NAME.wav.", metavar="DIR", completion="files"),
    option("--driver", TEXT, "Use this pyttsx3 driver. [default: the driver for this system]", metavar="NAME"),
    option(
        "--history",
        PATH,
        "Store all ended goals on disk for 90 days, for 'talk log'. With no-text, the texts are left out. The history "
        "is in the state directory, or in FILE, whose path contains '/'.",
        metavar="[no-text|FILE]",
        bare_value=TEXT_HISTORY,
    ),
    option("--pronounce", PATH, _PRONOUNCE_HELP, metavar="FILE", completion="files"),
    option("--socket-mode", FILE_MODE, "Set the socket's file mode, which decides who may connect.", default="0600"),
    option("--greeting", TEXT, "Speak this sentence when the server starts."),
    _print_unit_option("user", "system", "user-socket", "system-socket"),
)


def _serve_fault(values: Mapping[str, Any], _: frozenset[str]) -> str | None:
    """Return an error message if --player, --device or --history has an unsuitable value."""
    player = values["player"] or ""
    if values["device"] and player.startswith(("null", "file:")):
        return f"the player {player} has no devices; leave out --device"
    history = values["history"]
    if history and "/" not in history and history not in {TEXT_HISTORY, NO_TEXT_HISTORY}:
        return f"--history takes no-text or a path with a '/', such as ./history.db (got '{history}')"
    if player == "file:":
        return "--player file: needs a path, as in file:PATH.wav"
    return None


def _pause_fault(given: Mapping[str, Any], _: frozenset[str]) -> str | None:
    """Return an error message if `pause` has a COMMAND without --while, or --while without a COMMAND."""
    if given["while_connected"] != bool(given["command"]):
        return "--while and COMMAND belong together, as in: talk pause --while -- ./listen.py"
    return None


def _bridge_fault(values: Mapping[str, Any], _: frozenset[str]) -> str | None:
    """Return an error message if `bridge` lacks --name, or has several options that print something."""
    printed = [f"--{each.replace('_', '-')}" for each in ("print_unit", "print_acl", "print_addon_acl") if values[each]]
    if len(printed) > 1:
        return f"{' and '.join(printed)} can't be combined; use only one of them"
    if values["name"] is None and not (values["print_acl"] or values["print_addon_acl"]):
        return "--name is missing; choose the robot's name on the broker, as in: talk bridge --name anna"
    return None


def _log_fault(values: Mapping[str, Any], _: frozenset[str]) -> str | None:
    """Return an error message if the times in --since and --until exclude all goals."""
    since, until = values["since"] or 0.0, values["until"]
    if since > time.time():
        return "--since is in the future; for a time on the day before, write: --since 'yesterday 14:00'"
    return "--since must be before --until" if until is not None and since >= until else None


_GOAL_IDS = Option("ids", IDS, metavar=IDS.metavar, completion="goal_ids")
_LONG = option("-l, --long", FLAG, "Show full ids, and each sender's command and process id.")

#: All commands, in the order in which help lists them. The most important ones for new users come first.
_ROWS = (
    Command(
        name="serve",
        summary="Run the server in the foreground.",
        description="""
        Run the server in the foreground, until SIGTERM or Ctrl-C.

        The server queues sentences and speaks one at a time. It logs to standard error. With --print-unit, the
        command prints a systemd unit instead.
        """,
        function="services:serve",
        uses_server=False,
        examples="""
        talk serve --rate 150
        talk serve --player null       no sound, same timing: for simulation and CI
        talk serve --print-unit user   a systemd service, with instructions
        """,
        options=_SERVE_OPTIONS,
        rule=_serve_fault,
    ),
    Command(
        name="say",
        summary="Speak a sentence.",
        description="""
        Speak TEXT. If TEXT is '-', speak standard input as one sentence.

        The command prints the goal's id, and returns as soon as the server has accepted the goal. With --wait, the
        command returns when the goal has ended. Before that, the command cancels the goal on Ctrl-C, SIGTERM or
        SIGHUP, or if its output is closed, for example when ssh disconnects.

        With --lines, the exit code is the result of the first line that failed, and --ttl counts from the moment when
        a line is read.

        With --stream, speaking begins before the text has ended, for example while a language model writes it. If the
        goal ends early, the command stops reading.
        """,
        function="say:say",
        fleet_function="several:say",
        examples="""
        talk say "battery low"
        talk say --wait -- "$text" || echo "nobody heard it"
        talk say -wf "please step back"         show each word as it is heard
        talk say --key battery --throttle 1m "battery low"
        fortune | talk say -
        tail -n 0 -F log | talk say --lines --ttl 10s
        llm | talk say --stream --wait
        talk say -o hello.wav "hello"           needs no server
        talk say -o - "hello" | aplay
        talk say --dry-run "hello"              prints the text as it would be said
        """,
        exit_codes={
            0: "accepted, or skipped by --throttle; with --wait: played to the end",
            3: "no server; nothing was spoken, so you can try again",
            4: "aborted: the engine or the sound failed, or the text is incomplete or can't be spoken",
            5: "rejected: never queued (bad text, full queue, too many clients)",
            6: "recalled: removed from the queue before it was spoken",
            7: "preempted: stopped while it was being spoken",
            12: "lost: the connection was lost after the goal was sent, so it may still be spoken",
            124: "timed out; the goal was cancelled",
            "128+n": "ended by signal n (141: the output was closed); with --wait, the goal was cancelled",
        },
        options=_SAY_OPTIONS,
        argument=Option("text", TEXT, metavar="TEXT..."),
        unknown_option_hint="To speak a text that starts with '-', type: talk say -- TEXT",
        rule=_say_fault,
    ),
    Command(
        name="play",
        summary="Play a sound.",
        description="""
        Play the sound NAME: chirp, warning, error, or a WAV file in the directory 'talk serve --sounds DIR'.

        A sound is a goal like a sentence. It waits in the queue or interrupts, and can be cancelled and paused.
        """,
        function="say:play",
        fleet_function="several:play",
        examples="""
        talk play chirp
        talk play --wait --preempt warning
        talk play --list
        """,
        options=_PLAY_OPTIONS,
        argument=Option("sound", WORD, metavar="NAME", completion="sounds"),
        unknown_option_hint="A sound has no voice, rate, pitch or words, but it can have a --volume",
        rule=_play_fault,
    ),
    Command(
        name="wait",
        summary="Wait until goals have ended.",
        description="""
        Wait until the goals with these ids have ended, no matter who sent them. Without an ID, wait for the current
        goal and all waiting goals. The command never cancels a goal.
        """,
        function="wait:wait",
        fleet_function="several:wait",
        examples="""
        id=$(talk say "moving back"); move_back; talk wait "$id"
        talk wait --timeout 20s 12 13
        """,
        exit_codes={
            0: "all goals succeeded; without an ID: all goals have ended",
            "4-7": "result of the first goal that failed: 4 aborted, 5 rejected, 6 recalled, 7 preempted",
            8: "unknown goal",
            12: "lost: the connection to the server was lost",
            124: "timed out; the goals continue",
            "128+n": "ended by signal n; the goals continue",
        },
        options=(
            _timeout_option("Wait for at most TIME, such as 20s."),
            option("-f, --feedback", FLAG, "Show each word as it is heard."),
        ),
        argument=_GOAL_IDS,
    ),
    Command(
        name="cancel",
        summary="Stop speaking, or cancel some goals.",
        description="""
        Stop speaking and empty the queue. With IDs or options, cancel only the goals that they select.

        The command returns when the robot is silent, and prints the ids of the cancelled goals. If an ID is unknown,
        the command still cancels the other goals, and the exit code is 8.
        """,
        fleet_function="several:cancel",
        examples="""
        talk cancel                 everything, now
        talk cancel --current       this sentence; the next one follows
        talk cancel --key battery   all goals that were sent with --key battery
        talk cancel 12 13           two goals by their ids
        """,
        options=tuple(each for each in goal_options.Cancel.options if each.flags),
        argument=_GOAL_IDS,
        urgent=True,
    ),
    Command(
        name="status",
        summary="Show the current sentence, the queue and the last results.",
        description="""
        Show the server, the current sentence, the queue and the last results. With ID, show all details of one goal.
        """,
        fleet_function="several:status",
        examples="""
        talk status
        talk status 12
        talk --json status | jq .active.text
        """,
        options=(_LONG,),
        argument=Option("goal_id", ID, metavar="[ID]", completion="known_ids"),
        urgent=True,
    ),
    Command(
        name="watch",
        summary="Follow all goals live.",
        description="""
        Show all goals live: the text, the sender, and how and why each goal ends. Press Ctrl-C to stop.

        The output begins with the current sentence and the queue. In a pipe, each event is one line. On a terminal,
        states that last only a moment are left out.

        With --json, each event and each word is an object. The first object is {"event": "snapshot", ...}.
        """,
        examples="""
        talk watch
        ssh robot talk watch
        talk --json watch | jq -r 'select(.event == "word").word'
        """,
        options=(option("-f, --words", FLAG, "Also show each word as it is heard."), _LONG),
    ),
    Command(
        name="log",
        summary="Show what was said, by whom, and how it ended.",
        function="log:log",
        description="""
        Show the goals that have ended, with the newest at the end. A sender is shown by its name (in quotes), or
        otherwise by the program that called talk.

        With 'talk serve --history', goals from before the server's start are included. By default, 20 goals are shown,
        or 2,200 with a filter. TIME is 14:00, yesterday, '2026-11-24 14:00', or 2h (ago).
        """,
        examples="""
        talk log --since yesterday --until today --as patrol
        talk --json log --state aborted | jq -r .message
        """,
        options=(
            option("-n, --count", INTEGER, "Show the last N goals.", limits=(1, MAX_LOG_GOALS)),
            _LONG,
            *(each for each in goal_options.Log.options if each.flags),
        ),
        rule=_log_fault,
    ),
    Command(
        name="pause",
        summary="Pause speech.",
        description="""
        Pause speech until 'talk resume'. The current sentence stops where it is, and no other sentence is spoken, not
        even an urgent one. Goals can still be sent and cancelled.

        The command returns when the robot is silent. If silence is not confirmed within 2 seconds, the exit code is 1.

        With --while, the command runs COMMAND when the robot is silent, and returns its exit code (126 or 127 if it
        can't be run). The pause ends with COMMAND, or after 10 minutes or the TIME of --for. Speech continues when all
        pauses have ended. 'talk resume' ends them all.
        """,
        fleet_function="several:pause",
        examples="""
        talk pause; listen_to_the_operator; talk resume
        talk pause --for 20s
        talk pause --while -- ./listen.py --language de
        """,
        options=goal_options.Pause.options,
        argument=Option("command", TEXT, metavar="[COMMAND]..."),
        unknown_option_hint="Put '--' before COMMAND: talk pause --while -- COMMAND",
        rule=_pause_fault,
    ),
    Command(
        name="resume",
        summary="Continue paused speech.",
        description="Continue speech where 'talk pause' stopped it. If speech is not paused, nothing happens.",
        fleet_function="several:resume",
        examples="talk resume",
    ),
    Command(
        name="set",
        summary="Change or print the settings of the running server.",
        description="""
        Change settings of the running server, or print the settings if no option is given. A setting applies from the
        next goal on, except to goals that were sent with a value of their own. Restarting the server resets all
        settings.
        """,
        function="ask:change",
        fleet_function="several:change",
        examples="""
        talk set --rate 150 --volume 0.5
        talk set --voice en-us --no-preempt
        """,
        options=tuple(each.for_set() for each in goal_options.SETTINGS),
    ),
    Command(
        name="voices",
        summary="List the voices.",
        description="""
        List the id, language and name of each voice. The option --voice accepts an id, a name, a locale such as de_DE,
        or a language such as de or german.

        A variant such as f3 can be added to any of these: en-us+f3. Neural voices are listed last and have no variants.
        Any unambiguous part of a neural voice's id selects the voice: joe for piper/en_US-joe-medium. NAME#3 selects a
        speaker by number or name. If the server uses a neural voice, the language of this voice also selects it.
        """,
        examples="""
        talk voices --language en
        talk serve --voice en-us
        talk say --voice en-us+f3 "a variant"
        """,
        options=(
            option(
                "--language", TEXT, "List only the voices of this language, such as de or german.", metavar="LANGUAGE"
            ),
        ),
    ),
    Command(
        name="doctor",
        summary="Check everything that is needed to hear a sentence.",
        description="""
        Check everything that is needed to hear a sentence, and say what to do next.

        Each check prints one line: ok, warning or failed. The last check sends a sentence to the server, and waits at
        most 20 seconds for it. If no server is running, the command starts an engine with TALK_PLAYER and TALK_VOICE.

        With --silent, the command starts its own engine, which plays silence through the server's player. No
        goal is delayed, and nothing is logged.

        With --robot, the command checks the connection to a robot in a fleet: broker, certificate, login, permissions,
        and the robot's answer.
        """,
        connects=False,
        examples="""
        talk doctor
        talk doctor --silent                    check everything at night
        ssh robot talk doctor                   ssh returns the exit code
        talk doctor --robot anna                check the connection to anna
        talk --json doctor | jq 'select(.state != "ok")'
        """,
        exit_codes={
            0: "a sentence would be heard; with --robot: the robot answers",
            4: "a sentence would not be heard; with --robot: the robot does not answer",
            "128+n": "ended by signal n",
        },
        options=(option("--silent", FLAG, "Play half a second of silence instead of a sentence."),),
    ),
    Command(
        name="bridge",
        summary="Connect this robot to an MQTT broker, in the foreground.",
        description="""
        Connect this robot to an MQTT broker, in the foreground, until SIGTERM or Ctrl-C.

        Anybody who may write to the robot's topics can then make the robot speak. The bridge logs to standard error.

        TALK_BROKER is the address of the broker: mqtts://HOST, or mqtt://HOST without TLS. Set the
        user and password with TALK_MQTT_USER and TALK_MQTT_PASSWORD_FILE, and the paths of certificate files with
        TALK_MQTT_CA, TALK_MQTT_CERT and TALK_MQTT_KEY.
        """,
        function="services:bridge",
        uses_server=False,
        examples="""
        TALK_BROKER=mqtts://broker talk bridge --name anna
        talk bridge --name anna --group warehouse,night --allow say,cancel
        talk bridge --name anna --print-unit system   a systemd service
        talk bridge --print-acl                       rules for the broker
        """,
        options=(
            option("--name", WORD, "Set the robot's name, which no other robot may use.", metavar="NAME"),
            option("--group", WORD, "Add the robot to these groups, separated by commas.", metavar="GROUP"),
            option(
                "--allow",
                WORD,
                "Accept only these requests from the broker.",
                default="say,cancel,status,wait,log,voices,pause,resume",
                metavar="LIST",
            ),
            option("--no-text", FLAG, "Publish the status and events without the texts of goals."),
            option("--homeassistant", FLAG, "Show the robot as a device in Home Assistant."),
            _print_unit_option("user", "system"),
            option("--print-acl", FLAG, "Print access rules for mosquitto's acl_file, and exit."),
            option("--print-addon-acl", FLAG, "Print rules for Home Assistant's Mosquitto add-on, and exit."),
        ),
        rule=_bridge_fault,
    ),
    Command(
        name="fleet",
        summary="Show which robots are online, and what they say.",
        description="""
        Show which robots of a fleet are online, and what they say. TALK_BROKER is the address of the broker.

        'status' prints a table with each robot's current sentence, the number of waiting goals, and the last result
        with its time. 'watch' shows the goals of all robots live.

        --robot selects robots by a name, a pattern such as 'wh-*', or a group such as @warehouse.
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
        options=(replace(_LONG, help="Show full ids. With 'status', also show versions and start times."),),
        argument=Option("action", WORD, metavar="WHAT", choices=("status", "watch")),
    ),
    Command(
        name="completion",
        summary="Print the completion script for a shell.",
        description="""
        Print the completion script for bash, zsh or fish, to be loaded by the shell's startup file.

        Tab then completes commands, options and their values. While a server runs, Tab also completes goal ids, keys
        and voices.
        """,
        function="completion:completion",
        uses_server=False,
        examples="""
        eval "$(talk completion bash)"   the last line of ~/.bashrc
        eval "$(talk completion zsh)"    the last line of ~/.zshrc
        talk completion fish | source    the last line of ~/.config/fish/config.fish
        """,
        argument=Option("shell", WORD, metavar="SHELL", choices=("bash", "zsh", "fish")),
    ),
)
COMMANDS = {each.name: each for each in _ROWS}
