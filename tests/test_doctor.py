"""`talk doctor` beside a running server: what it says of it, and of a sentence that waits its turn as any other."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import time
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING

import pytest

from talkcli import Client
from talkcli.client import connect
from talkcli.client.connection import SocketConnection
from talkcli.doctor import machine, sentence, server
from talkcli.goals.states import State
from tests.faults.broken import write
from tests.support.compare import assert_silent, extent
from tests.support.processes import run_talk
from tests.support.real_voice import REAL_PACKAGE
from tests.support.surroundings import clean_environment, needs
from tests.test_doctor_alone import within

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.processes import Finished, Talk
    from tests.support.sink import Sink

#: What is looked at besides where there is a neural voice, as there is in CI.
NEURAL = ["neural", "voice files"] if find_spec(REAL_PACKAGE) else []
#: The checks, in the order of a sentence's way.
CHECKS = [
    "python", "pyttsx3", "libespeak-ng", "voices", *NEURAL, "session", "player", "device", "cards", "group",
    "sound server", "loudness", "socket", "server", "settings", "recent goals", "sentence",
]  # fmt: skip
#: Seconds in which it ends, whatever it finds.
LIMIT = 60.0
#: The sentence is over sooner.
FAST = ("--rate", "450")


def doctor(talk: Talk, *options: str) -> tuple[Finished, dict[str, dict[str, str]]]:
    """Run it, and return how it ended and its findings by their checks."""
    done = talk.run("--json", "doctor", *options, timeout=LIMIT)
    findings = [json.loads(line) for line in done.out.splitlines()]
    for each in findings:
        assert list(each) == ["check", "state", "message", "next"]
        assert each["state"] in {"ok", "warning", "failed"}
        assert (each["next"] is None) == (each["state"] == "ok"), each
    assert len({each["check"] for each in findings}) == len(findings)
    assert done.code == (4 if any(each["state"] == "failed" for each in findings) else 0), done.out
    return done, {each["check"]: each for each in findings}


def examined(
    talk: Talk, directory: Path, monkeypatch: pytest.MonkeyPatch, patience: float
) -> dict[str, dict[str, str]]:
    """Return what it finds of a server that has so many seconds, and that nobody would hear.

    By the command where these are its own; else in this process, with a file for the sentence, which takes no time.
    """
    if patience == connect.ANSWER_LIMIT:
        done, found = doctor(talk, "--silent")
        assert done.code == 4
        return found
    monkeypatch.setattr(server, "SocketConnection", partial(SocketConnection, patience=patience))
    return within({**talk.env, "TALK_PLAYER": f"file:{directory}/said.wav"}, monkeypatch, silent=True)


def logged(talk: Talk) -> list[Message]:
    """Return the goals that have ended, oldest first."""
    return [json.loads(line) for line in talk.run("--json", "log").out.splitlines()]


def test_all_is_well_and_its_sentence_is_heard_as_a_goal_of_its_own(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(*FAST, sink=sink, forked=False)
    done, found = doctor(talk)
    assert done.code == 0, done.out
    assert done.err == ""
    assert list(found) == CHECKS
    assert "eSpeak NG" in found["libespeak-ng"]["message"]
    assert f"{talk.socket} (TALK_SOCKET, process {talk.pid})" in found["socket"]["message"]
    assert "plays to null" in found["sound server"]["message"]
    assert "through the server, pulse" in found["sentence"]["message"]
    (goal,) = logged(talk)
    assert (goal["text"], goal["state"], goal["client"]["name"]) == (sentence.TEXT, "SUCCEEDED", "talk doctor")
    assert extent(talk.recording.samples)


def test_silent_leaves_out_the_sound_and_nothing_else(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(*FAST, sink=sink, forked=False)
    done, found = doctor(talk, "--silent")
    assert done.code == 0, done.out
    assert list(found) == CHECKS
    message = found["sentence"]["message"]
    assert message.startswith("played to its end without sound by an engine of this command's own, pulse, 0.")
    assert_silent(talk.recording)


def test_silent_waits_for_nobody_and_leaves_no_goal(make_talk: MakeTalk, sink: Sink) -> None:
    """As from cron, every five minutes, whatever is being said."""
    talk = make_talk("--rate", "80", sink=sink, forked=False)
    with Client(talk.socket) as client:
        first = client.say("this is a sentence that takes longer than all that is looked at meanwhile " * 3)
        client.say("and one that waits")
        done, found = doctor(talk, "--silent")
        assert done.code == 0, done.out
        assert found["sentence"]["state"] == "ok"
        status = client.status()
        assert (status.active and status.active.id, len(status.pending)) == (first.id, 1)
        assert (logged(talk), status.recent) == ([], ())
        client.cancel()


def test_silent_plays_zeros_by_the_server_s_player_to_its_device_in_its_surroundings(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    script = f"""#!/bin/sh
printf '%s ' "$@" "$PULSE_SERVER" >> {tmp_path}/called
tee -a {tmp_path}/played | aplay -q -t raw -f S16_LE -c 1 -r "$1"
"""
    player = write(tmp_path / "player", script, 0o755)
    talk = make_talk("--player", f"{player} {{rate}} {{device}}", "--device", "robot", sink=sink, forked=False)
    elsewhere = clean_environment(str(tmp_path), {"TALK_SOCKET": talk.socket})
    code, out, _ = run_talk(["doctor", "--silent"], elsewhere, LIMIT)
    assert code == 0, out
    assert (tmp_path / "called").read_text() == f"22050 robot {sink.env['PULSE_SERVER']} "
    played = (tmp_path / "played").read_bytes()
    assert len(played) > 22050 * 2 * 0.3
    assert not any(played)


@pytest.mark.parametrize(("options", "code"), [([], 0), (["--player", "aplay"], 4)])
def test_silent_tries_the_players_that_the_server_would_try(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path, options: list[str], code: int
) -> None:
    """The server names the first one; without --player that fails, and the sentence is heard by the next."""
    write(tmp_path / "aplay", "#!/bin/sh\necho 'aplay: main:831: audio open error: No such card' >&2\nexit 1\n", 0o755)
    talk = make_talk(*options, sink=sink, env={"PATH": f"{tmp_path}:{os.environ['PATH']}"}, forked=False)
    done, found = doctor(talk, "--silent")
    assert done.code == code
    assert ("audio open error" in found["sentence"]["message"]) == bool(code)


def test_the_player_that_the_server_uses_is_tried_and_not_the_first_that_is_there(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    """As after pipewire-pulse has died: pulse and aplay fail, and the server speaks by a program that works."""
    needs("pacat")
    mark = tmp_path / "mark"
    write(tmp_path / "aplay", "#!/bin/sh\necho 'aplay: main:831: audio open error: Host is down' >&2\nexit 1\n", 0o755)
    pacat = f'#!/bin/sh\nPULSE_SERVER={sink.env["PULSE_SERVER"]} exec {shutil.which("pacat")} "$@"\n'
    write(tmp_path / "pacat", pacat, 0o755)
    env = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PULSE_SERVER": f"unix:{tmp_path}/gone"}
    talk = make_talk(*FAST, sink=sink, env=env, forked=False)
    assert talk.run("say", "--wait", "one").code == 0
    assert talk.request("status")["server"]["player"] == "pacat"
    write(tmp_path / "aplay", f"#!/bin/sh\ncase $1 in -L) ;; *) touch {mark}; cat > /dev/null;; esac\n", 0o755)
    for options in ((), ("--silent",)):
        done, found = doctor(talk, *options)
        assert done.code == 0, done.out
        assert found["player"]["message"].startswith("pacat (the server's)")
        assert found["device"]["message"].startswith("pactl list short sinks")
        assert ", pacat, " in found["sentence"]["message"]
    assert not mark.exists()


def test_silent_beside_another_user_s_server_says_as_whom_to_play(
    make_talk: MakeTalk, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("aplay")
    talk = make_talk(watched=False)
    monkeypatch.setattr(machine, "_environment", lambda _: None)  # it is not to be read
    env = {**talk.env, "ALSA_CONFIG_PATH": "/dev/null"}
    found = within(env, monkeypatch, silent=True)
    assert found["sentence"]["next"].endswith(f": sudo -u '#{os.getuid()}' talk doctor --silent")
    monkeypatch.setattr(machine, "owner", lambda _: None)  # nor who it is, as /proc is mounted with hidepid
    found = within(env, monkeypatch, silent=True)
    assert found["sentence"]["state"] == "failed"
    assert "sudo -u" not in found["sentence"]["next"]


def test_silent_adds_nothing_to_a_file(make_talk: MakeTalk, tmp_path: Path) -> None:
    talk = make_talk("--player", f"file:{tmp_path}/said.wav", *FAST, forked=False)
    done, found = doctor(talk, "--silent")
    assert (done.code, found["player"]["state"], found["sentence"]["state"]) == (4, "failed", "ok")
    assert not (tmp_path / "said.wav").exists()


def test_a_device_that_the_server_speaks_with_is_no_fault_and_one_that_another_holds_is(
    make_talk: MakeTalk, sink: Sink, tmp_path: Path
) -> None:
    """A device that takes one player at a time, as a sound card does without a sound server."""
    script = f"""#!/bin/sh
exec 9> {tmp_path}/device
flock -n 9 || {{ echo 'aplay: main:831: audio open error: Device or resource busy' >&2; exit 1; }}
exec aplay -q -t raw -f S16_LE -c 1 -r 22050
"""
    player = write(tmp_path / "player", script, 0o755)
    talk = make_talk("--player", str(player), "--rate", "80", sink=sink, forked=False)
    with Client(talk.socket) as client:
        goal = client.say("this is a sentence that takes longer than all that is looked at meanwhile " * 3)
        talk.watcher.wait_for_word(goal.id)
        done, found = doctor(talk, "--silent")
        assert (done.code, found["sentence"]["state"]) == (0, "ok")
        assert "busy with what the server speaks" in found["sentence"]["message"]
        client.cancel()
    with open(tmp_path / "device", "w", encoding="utf-8") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        done, found = doctor(talk, "--silent")
    assert (done.code, found["sentence"]["state"]) == (4, "failed")
    assert "another program holds the device" in found["sentence"]["next"]


@pytest.mark.parametrize("player", ["false", pytest.param("sleep 100", marks=pytest.mark.slow)])
@pytest.mark.parametrize("options", [(), ("--silent",)])
def test_a_player_of_one_s_own_that_fails_is_what_is_to_be_looked_at(
    make_talk: MakeTalk, player: str, options: tuple[str, ...]
) -> None:
    done, found = doctor(make_talk("--player", player, forked=False), *options)
    assert done.code == 4
    step = f"try the player by hand, with a second of silence: head -c 44100 /dev/zero | {player}"
    assert found["sentence"]["next"] == step


def test_for_people_it_is_a_line_a_finding_and_the_end_is_a_note(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(*FAST, "--volume", "0.1", sink=sink, forked=False)
    done = talk.run("doctor", "--silent", timeout=LIMIT)
    assert done.code == 0
    assert [line[9:23].strip() for line in done.out.splitlines()] == CHECKS
    assert "\x1b" not in done.out
    assert "volume 0.1, voice the driver's own" in done.out
    assert "-> talk set --volume 1" in done.out
    # The server's environment doesn't tell of the runtime directory that its user may have.
    warned = ["session", "settings"] if os.path.isdir(f"/run/user/{os.getuid()}") else ["settings"]
    assert [line.split()[1] for line in done.out.splitlines() if line.startswith("warning")] == warned
    told = f"{len(warned)} warning{'s' * (len(warned) > 1)}"
    assert done.err == f"talk: a sentence is heard, unless the loudspeaker itself is off; {told}\n"
    quiet = talk.run("doctor", "--silent", "-q", timeout=LIMIT)
    assert (quiet.code, quiet.err) == (0, "")


def test_paused_speech_is_named_and_no_goal_is_left_behind(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(sink=sink, forked=False)
    assert talk.run("pause").code == 0
    done, found = doctor(talk)
    assert done.code == 4
    assert (found["server"]["state"], found["server"]["next"]) == ("failed", "talk resume")
    assert "speech is paused" in found["sentence"]["message"]
    assert talk.request("status")["server"]["pending"] == 0
    assert_silent(talk.recording)


@pytest.mark.parametrize("behind", ["sentence never-ends", "sentence length=8"])
def test_a_sentence_that_waits_too_long_is_taken_back(scripted: Talk, behind: str) -> None:
    with Client(scripted.socket) as client:
        first = client.say(behind)
        for number in range(3):
            client.say(f"number {number} never-ends")
        began = time.monotonic()
        played = sentence.by_server(client, sentence.TEXT, 0.3)
        assert time.monotonic() - began < 8
        assert (played.state, played.reason) == (State.RECALLED, "late")
        assert played.words == "it still waited behind 4 goals after 0.3 s, and was taken back"
        assert len(client.status().pending) == 3
        assert first.state in {State.PENDING, State.ACTIVE}
        client.cancel()


def test_a_sentence_that_was_begun_and_is_not_over_in_time_is_cancelled(scripted: Talk) -> None:
    with Client(scripted.socket) as client:
        played = sentence.by_server(client, "sentence never-ends", 0.5)
        assert (played.state, played.reason) == (State.PREEMPTED, "late")
        assert "begun and not over after 0.5 s" in str(played.words)
        assert client.status().active is None


def test_a_sentence_preempts_nothing(make_talk: MakeTalk) -> None:
    talk = make_talk("--preempt", scripted=True)
    with Client(talk.socket) as client:
        first = client.say("sentence length=0.5")
        assert sentence.by_server(client, sentence.TEXT, 10).state is State.SUCCEEDED
        assert first.wait(10).state is State.SUCCEEDED


def test_a_sentence_that_somebody_else_cancels_says_so(scripted: Talk) -> None:
    with Client(scripted.socket) as client:
        client.say("sentence never-ends")
        talk_doctor = scripted.start("doctor", "--json")
        while (status := client.status()).active is None or not status.pending:
            time.sleep(0.01)  # no event tells a client of another's goal but a watch
        client.cancel()
        done = scripted.finish(talk_doctor, LIMIT)
    found = json.loads(done.out.splitlines()[-1])
    assert (done.code, found["state"]) == (4, "failed")
    assert found["message"].startswith("RECALLED, canceled")
    assert "run talk doctor again" in found["next"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_takes_its_goal_along(scripted: Talk, number: signal.Signals) -> None:
    with Client(scripted.socket) as client:
        client.say("sentence never-ends")
        process = scripted.start("doctor")
        while (status := client.status()).active is None or not status.pending:
            time.sleep(0.01)  # as above
        process.send_signal(number)
        done = scripted.finish(process, 10)
        assert done.code == 128 + number
        end = time.monotonic() + 5
        while client.status().pending:
            assert time.monotonic() < end
        client.cancel()


def test_a_player_without_sound_is_not_heard(make_talk: MakeTalk) -> None:
    done, found = doctor(make_talk("--player", "null", *FAST))
    assert done.code == 4
    assert (found["player"]["state"], found["sentence"]["state"]) == ("failed", "ok")
    assert "null (the server's)" in found["player"]["message"]


def test_a_player_that_fails_is_told_in_its_own_words(make_talk: MakeTalk, tmp_path: Path) -> None:
    words = "ALSA lib pcm.c:1: snd_open\naplay: main:831: audio open error: Device or resource busy\n"
    player = write(tmp_path / "player", f"#!/bin/sh\nprintf '{words}' >&2\nexit 1\n", 0o755)
    talk = make_talk("--player", str(player))
    done, found = doctor(talk)
    assert done.code == 4
    assert "aplay: audio open error: Device or resource busy" in found["sentence"]["message"]
    assert found["sentence"]["message"].startswith("ABORTED, audio_device")
    assert "another program holds the device" in found["sentence"]["next"]
    _, found = doctor(talk)
    assert found["recent goals"]["state"] == "warning"
    assert "the last goal ABORTED, " in found["recent goals"]["message"]


def test_a_sink_that_is_suspended_is_named_with_the_command_that_wakes_it(
    make_talk: MakeTalk, private_sink: Callable[[], Sink]
) -> None:
    sink = private_sink()
    talk = make_talk(sink=sink, forked=False)
    sink.suspend()
    done, found = doctor(talk)
    assert done.code == 4
    assert "audio_stalled" in found["sentence"]["message"]
    assert found["sentence"]["next"] == "pactl suspend-sink null 0"
    sink.resume()


def test_a_sink_that_is_muted_is_not_heard_though_all_was_played(make_talk: MakeTalk, sink: Sink) -> None:
    talk = make_talk(*FAST, sink=sink, forked=False)
    sink.pactl("set-sink-mute", "null", "1")
    try:
        done, found = doctor(talk, "--silent")
    finally:
        sink.pactl("set-sink-mute", "null", "0")
    assert (done.code, found["sentence"]["state"]) == (4, "ok")
    assert (found["loudness"]["state"], found["loudness"]["message"]) == ("failed", "the default sink is muted")


@pytest.mark.slow
def test_a_sound_server_that_hangs_is_named_and_it_ends_all_the_same(
    make_talk: MakeTalk, private_sink: Callable[[], Sink]
) -> None:
    sink = private_sink()
    talk = make_talk(sink=sink, forked=False)
    sink.freeze()
    done, found = doctor(talk)
    sink.thaw()
    assert done.code == 4
    assert found["sound server"]["state"] == "warning"
    assert "does not answer from the server" in found["sound server"]["message"]
    assert found["sentence"]["state"] == "failed"
    assert found["sentence"]["next"] == found["sound server"]["next"]


@pytest.mark.usefixtures("nobody_serves")
@pytest.mark.parametrize("limit", [0.5, pytest.param(connect.ANSWER_LIMIT, marks=pytest.mark.slow)])
def test_a_server_that_hangs_is_named(
    make_talk: MakeTalk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: float
) -> None:
    talk = make_talk("--player", "null", watched=False)
    talk.freeze()
    found = examined(talk, tmp_path, monkeypatch, limit)
    talk.thaw()
    assert found["socket"]["state"] == "failed"
    assert found["socket"]["message"].endswith(f"{talk.socket}: a process listens that is stopped")
    assert found["socket"]["next"] == f"let it go on: kill -CONT {talk.pid}"
    assert "server" not in found


@pytest.mark.usefixtures("nobody_serves")
@pytest.mark.parametrize("limit", [0.5, pytest.param(connect.BUSY_LIMIT, marks=pytest.mark.slow)])
def test_a_full_server_is_named(
    make_talk: MakeTalk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: float
) -> None:
    talk = make_talk("--player", "null", "--max-clients", "1", watched=False)
    with talk.connect() as wire:
        assert wire.request("hello")["ok"]
        found = examined(talk, tmp_path, monkeypatch, limit)
    assert "--max-clients" in found["socket"]["next"]


def test_sound_behind_a_forwarded_socket_is_not_looked_for_here(make_talk: MakeTalk, sink: Sink) -> None:
    """As by ssh -L: what answers is the forwarder, and the server's player is elsewhere."""
    needs("socat")
    talk = make_talk(*FAST, sink=sink, forked=False)
    forwarded = f"{talk.socket}.here"
    forwarder = subprocess.Popen(["socat", f"UNIX-LISTEN:{forwarded},fork", f"UNIX-CONNECT:{talk.socket}"])
    try:
        while not os.path.exists(forwarded):
            assert forwarder.poll() is None
            time.sleep(0.01)  # it tells nobody
        done, found = doctor(talk, "--socket", forwarded)
        goals = logged(talk)
        silent, found_silently = doctor(talk, "--socket", forwarded, "--silent")
    finally:
        forwarder.kill()
        forwarder.wait()
    assert done.code == 0, done.out
    assert "on another machine or in a container: run talk doctor there" in found["session"]["message"]
    assert not found.keys() & {"player", "device", "cards", "group", "sound server", "loudness"}
    assert "through the server, pulse" in found["sentence"]["message"]
    assert extent(talk.recording.samples)
    # Its player is out of reach, and no goal is sent: then nothing is proved.
    assert (silent.code, found_silently["sentence"]["state"]) == (4, "failed")
    assert "run talk doctor --silent there" in found_silently["sentence"]["next"]
    assert logged(talk) == goals
