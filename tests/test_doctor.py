"""The command `talk doctor` with a running server, and without one, when its own engine process plays."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from talkcli import Client
from talkcli.doctor import examine, sentence, sound
from talkcli.doctor.report import next_steps
from talkcli.doctor.voice import SENTENCE_TEXT
from talkcli.goals.states import State
from tests.conformance.bareserve import TALK, environment
from tests.conformance.rawsocket import FakeServer
from tests.faults.broken import python_path, write
from tests.support.compare import assert_silent, extent
from tests.support.processes import Talk, run_talk
from tests.support.real_voice import REAL_PACKAGE
from tests.support.surroundings import clean_environment, needs
from tests.support.timing import assert_within, limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tests.conftest import MakeTalk
    from tests.support.connection import Message
    from tests.support.sink import Sink

#: Checks that run only if a neural voice is installed, as in CI.
NEURAL = ["neural", "voice files"] if find_spec(REAL_PACKAGE) else []
#: All checks in order.
CHECKS = [
    "python", "pyttsx3", "libespeak-ng", "voices", *NEURAL, "session", "player", "device", "cards", "group",
    "sound server", "loudness", "socket", "server", "settings", "recent goals", "sentence",
]  # fmt: skip
#: Limit for one run of the doctor, whatever it finds.
LIMIT_S = 60.0
FAST = ("--rate", "450")
LONG = "this is a sentence that takes longer than all checks of the doctor together " * 3


@pytest.fixture(scope="module")
def server(sink: Sink) -> Iterator[Talk]:
    """A server for all tests that use `robot`. The doctor can read its environment."""
    with contextlib.closing(Talk(FAST, sink=sink, forked=False)) as talk:
        yield talk
        talk.stop()


@pytest.fixture
def robot(server: Talk) -> Iterator[Talk]:
    """The same server. After each test, it is silent and at full volume again."""
    yield server
    server.request("cancel")
    server.request("set", volume=1.0)


def doctor(env: Mapping[str, str], *options: str, code: int = 4) -> dict[str, dict[str, Any]]:
    """Run the doctor, and return its findings by name of the check."""
    ended, out, err = run_talk(["--json", "doctor", *options], env, LIMIT_S)
    assert (ended, err) == (code, ""), out
    findings = [json.loads(line) for line in out.splitlines()]
    for finding in findings:
        assert list(finding) == ["check", "state", "message", "next", "measured"]
        assert finding["state"] in {"ok", "warning", "failed"}
        assert (finding["next"] is None) == (finding["state"] == "ok"), finding
    assert [findings[index]["check"] for index in (0, -1)] == ["python", "sentence"]
    assert len({finding["check"] for finding in findings}) == len(findings)
    assert code == (4 if any(finding["state"] == "failed" for finding in findings) else 0), out
    return {finding["check"]: finding for finding in findings}


@pytest.fixture
def home(home: str) -> str:
    os.mkdir(f"{home}/run", 0o700)
    return home


def file_player(home: str) -> dict[str, str]:
    """Return an environment without a server, in which the sentence is quickly written to a file."""
    return environment(home, TALK_PLAYER=f"file:{home}/said.wav", TALK_SOCKET=f"{home}/s")


def logged(talk: Talk) -> list[Message]:
    """Return the ended goals, oldest first."""
    return [json.loads(line) for line in talk.run("--json", "log").out.splitlines()]


def test_without_faults_the_doctors_sentence_is_heard(robot: Talk, sink: Sink) -> None:
    with sink.record() as recording:
        findings = doctor(robot.env, code=0)
    assert list(findings) == CHECKS
    assert "eSpeak NG" in findings["libespeak-ng"]["message"]
    assert f"{robot.socket} (TALK_SOCKET, process {robot.pid})" in findings["socket"]["message"]
    assert "plays to null" in findings["sound server"]["message"]
    assert "through the server, pulse" in findings["sentence"]["message"]
    goal, stopped = logged(robot)[-2:]
    assert (goal["text"], goal["state"], goal["client"]["name"]) == (SENTENCE_TEXT, "SUCCEEDED", "talk doctor")
    assert (stopped["text"], stopped["state"]) == (sentence.STOP_TEXT, "PREEMPTED")
    assert extent(recording.samples)
    measured = findings["sentence"]["measured"]
    assert 0 <= measured["stop_ms"] <= 2000
    assert f"the sound began {measured['onset_ms']} ms after the request" in findings["sentence"]["message"]


def test_the_onset_of_the_sentence_is_the_time_of_its_first_sound(robot: Talk, sink: Sink) -> None:
    with limits(), Client(robot.socket) as client, sink.record() as recording:
        asked_at = time.monotonic()
        played = sentence.speak_by_server(client, SENTENCE_TEXT, LIMIT_S)
        recording.wait_until_quiet(0.1)
        onset, first_sound = played.onset_s, recording.first_sound()
        assert onset is not None
        assert first_sound is not None
        assert_within(abs(asked_at + onset - first_sound), 0.1, "the first sound, compared with the reported onset")


def test_silent_makes_no_sound_and_shows_one_finding_per_line(robot: Talk, sink: Sink) -> None:
    robot.run("set", "--volume", "0.1")
    with sink.record() as recording:
        done = robot.run("doctor", "--silent", timeout=LIMIT_S)
        recording.wait_until_quiet(0.2)
    assert_silent(recording)
    assert done.code == 0
    assert [line[9:23].strip() for line in done.out.splitlines()] == CHECKS
    assert "\x1b" not in done.out
    assert "a sentence was played without sound by talk doctor's own engine, pulse, 0." in done.out
    assert "volume 0.1, default voice" in done.out
    assert "-> talk set --volume 1" in done.out
    # The server's environment doesn't name the runtime directory, although its user may have one.
    warned = ["session", "settings"] if os.path.isdir(f"/run/user/{os.getuid()}") else ["settings"]
    assert [line.split()[1] for line in done.out.splitlines() if line.startswith("warning")] == warned
    warnings = f"{len(warned)} warning{'s' * (len(warned) > 1)}"
    assert done.err == f"talk: a sentence is heard, unless the loudspeaker itself is off; {warnings}\n"


def test_silent_neither_waits_for_goals_nor_adds_any(robot: Talk) -> None:
    """For example from cron, every five minutes, even while goals are spoken."""
    before = logged(robot)
    with Client(robot.socket) as client:
        first = client.say(LONG, rate=80)
        second = client.say("and one that waits")
        assert doctor(robot.env, "--silent", code=0)["sentence"]["state"] == "ok"
        status = client.status()
        assert (status.active and status.active.id, [goal.id for goal in status.pending]) == (first.id, [second.id])
        assert logged(robot) == before


def test_sound_is_not_checked_here_if_the_socket_is_forwarded(robot: Talk, sink: Sink) -> None:
    """With ssh -L, the server's player is on another machine."""
    needs("socat")
    forwarded = f"{robot.socket}.here"
    forwarder = subprocess.Popen(["socat", f"UNIX-LISTEN:{forwarded},fork", f"UNIX-CONNECT:{robot.socket}"])
    try:
        while not os.path.exists(forwarded):
            assert forwarder.poll() is None
            time.sleep(0.01)  # socat doesn't report when it listens
        with sink.record() as recording:
            findings = doctor(robot.env, "--socket", forwarded, code=0)
    finally:
        forwarder.kill()
        forwarder.wait()
    assert (
        "on another machine or in a container: to check its sound, run talk doctor there"
        in findings["session"]["message"]
    )
    assert not findings.keys() & {"player", "device", "cards", "group", "sound server", "loudness"}
    assert "through the server, pulse" in findings["sentence"]["message"]
    assert extent(recording.samples)


def test_silent_plays_zeros_with_the_servers_player_and_device(make_talk: MakeTalk, sink: Sink, tmp_path: Path) -> None:
    script = f"""#!/bin/sh
printf '%s ' "$@" "$PULSE_SERVER" >> {tmp_path}/called
tee -a {tmp_path}/played | aplay -q -t raw -f S16_LE -c 1 -r "$1"
"""
    player = write(tmp_path / "player", script, 0o755)
    talk = make_talk("--player", f"{player} {{rate}} {{device}}", "--device", "robot", sink=sink, forked=False)
    env = clean_environment(str(tmp_path), {"TALK_SOCKET": talk.socket})
    code, out, _ = run_talk(["doctor", "--silent"], env, LIMIT_S)
    assert code == 0, out
    assert (tmp_path / "called").read_text() == f"22050 robot {sink.env['PULSE_SERVER']} "
    played = (tmp_path / "played").read_bytes()
    assert len(played) > 22050 * 2 * 0.3
    assert not any(played)


def test_a_failed_custom_player_is_reported_with_a_command_to_test_it(make_talk: MakeTalk) -> None:
    player = "sh -c 'echo no such card >&2; exit 1'"
    talk = make_talk("--player", player, forked=False)
    step = f"test the player with a second of silence: head -c 44100 /dev/zero | {player}"
    done = talk.run("-q", "doctor", timeout=LIMIT_S)
    assert (done.code, done.err) == (4, "")
    shown = done.out.splitlines()[-1]
    assert "sentence      ABORTED, audio_" in shown
    assert shown.endswith(f"no such card -> {step}")


# The sentence, sent to a server


def test_no_sentence_stays_in_the_queue_of_a_paused_server(scripted: Talk) -> None:
    assert scripted.run("pause").code == 0
    with Client(scripted.socket) as client:
        played = sentence.speak_by_server(client, SENTENCE_TEXT, 10)
        assert played.reason == "paused"
        assert str(played.message).startswith("not spoken: speech is paused by ")
        assert client.status().pending == ()


def test_a_sentence_that_waits_too_long_is_cancelled(scripted: Talk) -> None:
    with Client(scripted.socket) as client:
        goals = [client.say(f"{number} never-ends") for number in ("one", "two", "three", "four")]
        started_at = time.monotonic()
        played = sentence.speak_by_server(client, SENTENCE_TEXT, 0.3)
        assert time.monotonic() - started_at < 8
        assert (played.state, played.reason) == (State.RECALLED, "late")
        assert played.message == "not spoken: it was still waiting behind 4 goals after 0.3 s"
        assert (goals[0].state, len(client.status().pending)) == (State.ACTIVE, 3)
        client.cancel()
        played = sentence.speak_by_server(client, "sentence never-ends", 0.5)
        assert (played.state, played.reason) == (State.PREEMPTED, "late")
        assert "it had not ended after 0.5 s" in str(played.message)
        assert client.status().active is None


def test_the_sentence_preempts_no_goal(make_talk: MakeTalk) -> None:
    talk = make_talk("--preempt", scripted=True)
    with Client(talk.socket) as client:
        first = client.say("sentence length=0.1")
        assert sentence.speak_by_server(client, SENTENCE_TEXT, 10).state is State.SUCCEEDED
        assert first.wait(10).state is State.SUCCEEDED


def wait_until_pending(client: Client) -> None:
    while (status := client.status()).active is None or not status.pending:
        time.sleep(0.01)  # only a watch reports goals of other clients


def test_a_sentence_cancelled_by_another_client_is_reported(scripted: Talk) -> None:
    with Client(scripted.socket) as client, Client(scripted.socket) as other, ThreadPoolExecutor(1) as pool:
        other.say("sentence never-ends")
        playing = pool.submit(sentence.speak_by_server, client, SENTENCE_TEXT, LIMIT_S)
        wait_until_pending(other)
        other.cancel()
        played = playing.result(LIMIT_S)
    assert (played.state, played.reason) == (State.RECALLED, "canceled")


def test_a_signal_cancels_the_sentence(scripted: Talk) -> None:
    with Client(scripted.socket) as client:
        client.say("sentence never-ends")
        process = scripted.start("doctor")
        wait_until_pending(client)
        process.send_signal(signal.SIGINT)
        assert scripted.finish(process, 10).code == 128 + signal.SIGINT
        end = time.monotonic() + 5
        while client.status().pending:
            assert time.monotonic() < end
        client.cancel()


# Without a server


@pytest.mark.usefixtures("nobody_serves")
def test_without_a_server_the_doctors_own_engine_is_heard(home: str, sink: Sink) -> None:
    with sink.record() as recording:
        findings = doctor(environment(home, **sink.env, TALK_SOCKET=f"{home}/s"))
        recording.wait_until_quiet(0.2)
    assert extent(recording.samples)
    assert {finding["check"] for finding in findings.values() if finding["state"] == "failed"} == {"socket"}
    assert findings["socket"]["next"] == "unset TALK_SOCKET, or start a server there: talk serve"
    assert "by talk doctor's own engine, pulse" in findings["sentence"]["message"]
    assert min(findings["sentence"]["measured"].values()) >= 0
    assert "server" not in findings


@pytest.mark.usefixtures("nobody_serves")
def test_without_sound_the_players_error_message_is_shown(home: str) -> None:
    needs("aplay")
    findings = doctor(environment(home, TALK_PLAYER="aplay", ALSA_CONFIG_PATH="/dev/null"))
    assert findings["sentence"]["message"].startswith("ABORTED, audio_device: aplay: audio open error")
    assert findings["sound server"]["state"] == "warning"
    assert "PULSE_SERVER" in findings["sound server"]["message"]


def test_a_missing_library_fails_its_own_check_and_the_sentence(home: str, tmp_path: Path) -> None:
    write(tmp_path / "pyttsx3.py", "raise ModuleNotFoundError('No module named pyttsx3', name='pyttsx3')\n")
    findings = doctor({**file_player(home), **python_path(tmp_path)})
    assert (findings["pyttsx3"]["state"], findings["sentence"]["state"]) == ("failed", "failed")
    assert "pip install pyttsx3" in findings["pyttsx3"]["next"]


def test_a_server_that_disconnects_is_reported(home: str) -> None:
    greeting = b'{"talk": 1, "version": "0.1", "pid": 1, "boot": "abcd"}\n'
    with FakeServer(f"{home}/s", [greeting], closes=True):
        finding = doctor(file_player(home), "--silent")["server"]
    assert finding["state"] == "failed"
    assert "connection to the server was lost" in finding["message"]
    assert "restart it" in finding["next"]


def test_hanging_programs_only_delay_the_doctor(home: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pactl", "aplay", "pw-cli"):
        write(Path(home, "run", name), "#!/bin/sh\nexec sleep 98\n", 0o755)
    env = environment(home, TALK_SOCKET=f"{home}/s")
    monkeypatch.setattr(os, "environ", {**env, "PATH": f"{home}/run:{env['PATH']}"})
    monkeypatch.setattr(sound, "PROGRAM_LIMIT_S", 0.1)
    monkeypatch.setattr(examine, "SENTENCE_LIMIT_S", 0.2)
    started_at = time.monotonic()
    findings = list(examine.LocalExamination(None, silent=False).findings())
    assert time.monotonic() - started_at < LIMIT_S / 2
    assert next_steps(findings)
    messages = {finding.check: finding.message for finding in findings}
    assert "no answer within 0.1 s" in messages["device"]
    assert "does not answer" in messages["sound server"]


def test_a_signal_ends_the_doctor(home: str) -> None:
    env = environment(home, TALK_SOCKET=f"{home}/s", TALK_PLAYER="sleep 97")
    with subprocess.Popen([*TALK, "doctor"], env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for line in process.stdout:
            if "socket" in line.split():
                break
        process.terminate()
        assert process.wait(10) == 128 + 15


def test_the_doctors_process_does_not_load_the_speech_libraries(home: str) -> None:
    code = (
        "import sys\nfrom talkcli.doctor.examine import LocalExamination\n"
        "findings = [*LocalExamination(None, silent=True).findings()]\n"
        "assert findings[-1].check == 'sentence'\n"
        "print([name for name in ('pyttsx3', 'espeakng_loader', 'asyncio') if name in sys.modules], end='')\n"
        "print('espeak' in open('/proc/self/maps').read() if sys.platform == 'linux' else False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=file_player(home), capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "[]False\n"
