"""How `talk doctor` judges facts about voice, sound, socket, server and sentence, and how it shows the findings."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from talkcli import __version__, paths
from talkcli.doctor import report, sentence, server, sound, voice
from talkcli.doctor.examine import LocalExamination
from talkcli.doctor.report import FAILURE, OK, WARNING, Finding, failure, next_steps, ok, warning
from talkcli.doctor.sentence import SentenceResult, find_playback_step
from talkcli.doctor.server import SocketPlace
from talkcli.doctor.sound import SoundServer, UserSession
from talkcli.doctor.voice import SENTENCE_TEXT, EngineOptions, EngineReport
from talkcli.engine.players import DUMMY_SINK
from talkcli.engine.protocol import Ready
from talkcli.errors import Busy, ServerUnavailable, TalkError
from talkcli.frozen import replace
from talkcli.goals.goal import Goal
from talkcli.goals.states import State
from talkcli.paths import PLACE_ABSENT, PLACE_FORBIDDEN
from talkcli.terminal.text import Screen, width
from tests.faults.broken import write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from talkcli.client.client import Client

MISSING = "libespeak-ng is missing (libespeak-ng.so.1: cannot open): install it"
READY = Ready("espeak", "eSpeak NG 1.51 (system)", None)
ENGINE = EngineReport(READY, ("en",) * 141)
SPOKEN = Goal("4k7f-1", State.SUCCEEDED, text="x")
SERVER: dict[str, object] = {
    "pid": 4711, "version": __version__, "engine": "ready", "player": "aplay", "uptime": 100.0, "rate": 200,
    "volume": 1.0, "voice": None, "pitch": 50, "preempt": False, "ttl": None, "paused": False, "pending": 0,
    "clients": 1, "max_clients": 256,
}  # fmt: skip


def find(findings: list[Finding], check: str) -> Finding:
    return next(finding for finding in findings if finding.check == check)


def test_the_next_step_is_taken_from_the_first_failure() -> None:
    played, group = ok("sentence", "played"), warning("group", "not in audio", "usermod")
    lost = failure("socket", "no server", "talk serve")
    stuck = failure("sentence", "ABORTED", "look at the loudspeaker")
    muted = failure("loudness", "muted", "unmute")
    assert next_steps([ok("python", "3"), group, stuck]) == ["look at the loudspeaker"]
    assert next_steps([muted, lost, played]) == next_steps([muted, lost, stuck]) == ["unmute"]
    assert next_steps([group, lost, stuck]) == ["talk serve", "look at the loudspeaker"]
    assert next_steps([failure("socket", "found elsewhere", "unset TALK_SOCKET"), stuck]) == ["unset TALK_SOCKET"]
    assert next_steps([group, played]) == []
    conclusion = report.format_conclusion([lost, stuck], Screen())
    assert conclusion.endswith("do this next:\n  talk serve\nand then:\n  look at the loudspeaker")


def step_after(reason: str, message: str, player: str | None = None, earlier: str | None = None) -> str:
    """Return the next step after a sentence that failed like this. `earlier` is the next step of the earlier checks."""
    played = SentenceResult(State.ABORTED, reason, message, player=player)
    return str(sentence.judge_sentence(played, silent=False, playback_step=earlier, device="usb").next)


def test_the_next_step_for_a_missing_device_comes_from_the_device_checks() -> None:
    findings = [warning("cards", "none", "plug in"), warning("group", "not in audio", "usermod"), ok("python", "3")]
    assert find_playback_step(findings) == "usermod"
    assert find_playback_step(findings[2:]) is None
    assert step_after("audio_device", "aplay: Permission denied", earlier="usermod") == "usermod"
    assert step_after("audio_lost", "unplugged", earlier="usermod") == "usermod"
    assert "another program" in step_after("audio_device", "aplay: Device or resource busy", earlier="usermod")
    assert "talk set --voice" in step_after("nothing_to_say", "nothing", earlier="usermod")
    assert step_after("audio_device", "aplay: No such device") == sentence.ADVICE["audio_device"]
    assert "usermod" in step_after("audio_device", "aplay: Operation not permitted")


def test_a_custom_player_is_to_be_tested_by_hand_unless_the_cause_is_known() -> None:
    cards = warning("cards", "none in this container", "start the container with --device /dev/snd")
    missing = warning("player", "it is not there", "name a program that is there")
    assert find_playback_step([cards], custom_player=True) is None
    assert find_playback_step([cards, missing], custom_player=True) == "name a program that is there"
    stalled = ("audio_stalled", "it accepted no sound for 5 s")
    by_hand = "test the player with a second of silence: head -c 44100 /dev/zero | sox -r 22050 -d usb"
    assert step_after(*stalled, "sox -r {rate} -d {device}") == by_hand
    assert step_after(*stalled, "aplay -r {rate}") == sentence.ADVICE["audio_stalled"]
    assert "another program" in step_after("audio_device", "Device or resource busy", "sox")


BUSY = SentenceResult(State.ABORTED, "audio_device", "aplay: audio open error: Device or resource busy")


def test_a_device_that_is_busy_with_the_servers_speech_is_ok() -> None:
    finding = sentence.judge_sentence(replace(BUSY, beside_speech=True), silent=True, device=None)
    assert (finding.state, "busy, because the server is speaking" in finding.message) == (OK, True)
    finding = sentence.judge_sentence(BUSY, silent=True, device=None)
    assert (finding.state, "another program uses the device" in str(finding.next)) == (FAILURE, True)
    gone = SentenceResult(State.ABORTED, "audio_device", "aplay: audio open error: No such device")
    assert sentence.judge_sentence(replace(gone, beside_speech=True), silent=True, device=None).state == FAILURE


def test_the_servers_goals_before_and_after_show_whether_it_spoke(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sentence, "speak_by_engine", lambda *_: BUSY)

    def spoke(before: tuple[Goal | None, Sequence[Goal]], after: tuple[Goal | None, Sequence[Goal]]) -> bool:
        statuses = (SimpleNamespace(active=active, recent=recent) for active, recent in (before, after))
        client = cast("Client", SimpleNamespace(status=statuses.__next__))
        played = sentence.speak_beside_server(client, EngineOptions(), 1.0)
        assert played == replace(BUSY, beside_speech=played.beside_speech)
        return played.beside_speech

    assert spoke((SPOKEN, ()), (None, ()))
    assert spoke((None, ()), (SPOKEN, ()))
    assert spoke((None, ()), (None, [SPOKEN]))
    assert spoke((None, ()), (None, [replace(SPOKEN, state=State.PREEMPTED)]))
    assert not spoke((None, ()), (None, ()))
    assert not spoke((None, [SPOKEN]), (None, [SPOKEN]))
    assert not spoke((None, ()), (None, [replace(SPOKEN, state=State.RECALLED)]))


STALLED = SentenceResult(State.ABORTED, "audio_stalled", "aplay accepted no sound for 3 s")
CLIENT = cast("Client", object())
WARNED = [warning("sound server", "it hangs", "restart it")]


def examine(
    played: SentenceResult, client: Client | None = CLIENT, *, silent: bool = False, **facts: object
) -> Finding:
    """Return the finding about a sentence with this result. `facts` are attributes of the examination."""
    examination = LocalExamination(None, silent=silent)
    engine = EngineReport(reason=played.reason, message=str(played.message)) if client is None else ENGINE
    session = UserSession(0, "root", server_pid=7)
    facts = {"client": client, "engine": engine, "session": session, "findings": WARNED, **facts}
    for name, value in {"server_pid": 7, "env": {}, **facts}.items():
        setattr(examination, f"_{name}", value)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("speak_beside_server", "speak_by_server", "speak_by_engine"):
            patch.setattr(sentence, name, lambda *_: played)
        patch.setattr(sound, "suspended_sinks", lambda _: ("usb",))
        return examination._speak_sentence()


HUNG = SentenceResult(State.ABORTED, "engine_hung", "silence")


def test_the_next_step_after_a_sentence_depends_on_the_earlier_checks() -> None:
    assert examine(STALLED).next == examine(STALLED, silent=True).next == "pactl suspend-sink usb 0"
    assert examine(STALLED, hangs=True).next == "restart it"
    custom = examine(replace(STALLED, player="mine"), server={"player": "mine"})
    assert str(custom.next).startswith("test the player with")
    assert examine(HUNG, None, hangs=True).next == "restart it"
    assert str(examine(HUNG, None).next).startswith("run talk doctor again")
    assert str(examine(STALLED, silent=True, server_pid=None).next).startswith("run 'talk doctor --silent' there")


def test_a_server_is_to_be_examined_by_the_user_who_runs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = SentenceResult(State.ABORTED, "audio_device", "aplay: audio open error: No such device")
    monkeypatch.setattr(sound, "file_owner", lambda path: 33 if path == "/proc/7" else None)
    root = UserSession(0, "root")
    assert str(examine(gone, silent=True, session=root).next).endswith(": sudo -u '#33' talk doctor --silent")
    monkeypatch.setattr(sound, "file_owner", lambda _: None)  # as if /proc were mounted with hidepid
    assert examine(gone, silent=True, session=root).next == examine(gone, silent=True).next == "restart it"


def test_a_sentence_played_by_a_silent_player_is_reported_as_such() -> None:
    played = SentenceResult(State.SUCCEEDED, duration=1.0, player="null")
    assert "a sentence was played without sound" in examine(played, server={"player": "null"}).message
    assert "without sound" not in examine(played, server={"player": "aplay"}).message


def test_without_a_server_the_sentence_uses_the_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[object, ...]] = []

    def by_engine(*arguments: object) -> SentenceResult:
        given.append(arguments)
        return STALLED

    monkeypatch.setattr(sentence, "speak_by_engine", by_engine)
    monkeypatch.setenv("TALK_PLAYER", "pacat")
    monkeypatch.setenv("TALK_VOICE", "de")
    for silent in (False, True):
        LocalExamination(None, silent=silent)._speak_sentence()
    setting = EngineOptions("pacat", None, "de")
    assert [call[:3] for call in given] == [(SENTENCE_TEXT, setting, 1.0), (SENTENCE_TEXT, setting, 0.0)]


def test_silent_mode_uses_the_servers_settings_and_players(monkeypatch: pytest.MonkeyPatch) -> None:
    def setting(configured: str | None, *, named: bool) -> EngineOptions:
        monkeypatch.setattr(sound, "server_names_player", lambda *_: named)
        examination = LocalExamination(None, silent=True)
        examination._server = {"player": configured, "device": "usb", "voice": "de", "driver": "espeak"}
        examination._env = {}
        return examination._copy_server_options(7)

    rest = ("usb", "de", "espeak")
    assert setting("aplay", named=False) == EngineOptions(None, *rest, "aplay", {})
    assert setting("aplay", named=True) == EngineOptions("aplay", *rest, None, {})
    assert setting("mine -x", named=False) == EngineOptions("mine -x", *rest, None, {})
    assert setting("file:/tmp/x.wav", named=True) == EngineOptions("null", *rest, None, {})
    assert setting("null", named=True) == EngineOptions("null", *rest, None, {})
    assert setting(None, named=False) == EngineOptions(None, *rest, None, {})


def test_control_characters_are_escaped_in_every_finding() -> None:
    finding = failure("device", "aplay: \x1b[2Jred", "remove \u202e it\n")
    assert (finding.message, finding.next) == ("aplay: \\x1b[2Jred", "remove \\u202e it\\n")


@pytest.mark.parametrize(
    ("reason", "message", "check", "step"),
    [
        ("engine_failed", "pyttsx3 is missing (no module): install it", "pyttsx3", "pip"),
        ("engine_failed", "libespeak-ng is missing: install it", "libespeak-ng", "libesp"),
        ("engine_failed", "espeak-ng data is missing", "libespeak-ng", "espeak-ng-data"),
        ("engine_crashed", "it was killed by SIGSEGV", "libespeak-ng", "reinstall"),
        ("engine_hung", "the engine process did not respond", "libespeak-ng", "if the sound server hangs"),
        ("unknown_voice", 'unknown voice "x"', "voices", "talk voices"),
    ],
)
def test_an_engine_failure_is_reported_by_the_right_check(reason: str, message: str, check: str, step: str) -> None:
    engine = EngineReport(reason=reason, message=message)
    finding = find(voice.judge_engine("2.99", engine, server_engine=None), check)
    assert finding.state == FAILURE
    assert message in finding.message
    assert step in (finding.next or "")
    beside_server = voice.judge_engine("2.99", engine, server_engine="ready")
    assert find(beside_server, check).state == WARNING, "the server has its own engine"


def test_a_working_engine_is_reported_with_its_version_and_voices() -> None:
    findings = voice.judge_engine("2.99", ENGINE, server_engine=None)
    assert [finding.check for finding in findings] == ["pyttsx3", "libespeak-ng", "voices"]
    assert {finding.state for finding in findings} == {OK}
    assert "1.51 (system)" in findings[1].message
    assert "141" in findings[2].message
    for voices in (None, ()):
        engine = EngineReport(READY, voices)
        assert voice.judge_engine("2.99", engine, server_engine="starting")[-1].state == WARNING


def test_a_missing_library_is_fixed_before_a_silent_player() -> None:
    for engine in (ENGINE, EngineReport(reason="engine_failed", message=MISSING)):
        judged = voice.judge_engine("2.99", engine, server_engine=MISSING)
        assert next_steps([*judged, sound.judge_silent_player("null", set_by_server=True)]) == [voice.INSTALL_LIBRARY]


PATH = "/run/user/1000/talk/talk.sock"


NO_ANSWER, FULL, NONE = ServerUnavailable("it does not answer"), Busy("too many"), ServerUnavailable("no server")
OTHER_SOCKET = "/run/user/7/talk/talk.sock"


@pytest.mark.parametrize(
    ("place", "named_by", "error", "others", "message", "step"),
    [
        (SocketPlace(PATH, PLACE_FORBIDDEN, 7), None, NONE, [], "permission denied (uid 7)", "ask uid 7 for access"),
        (SocketPlace(PATH, server.PLACE_CLOSED), None, NONE, [], "for a directory", "talk serve --socket PATH"),
        (SocketPlace(PATH, PLACE_ABSENT), "--socket", NONE, [], "--socket names", "leave out --socket, or"),
        (SocketPlace(PATH, server.PLACE_LISTENING), None, NO_ANSWER, [], "it does not answer", "restart"),
        (SocketPlace(PATH, server.PLACE_LISTENING), None, FULL, [], "too many", "--max-clients"),
        (SocketPlace(PATH, PLACE_ABSENT), None, NONE, [OTHER_SOCKET], "not found", f"talk --socket {OTHER_SOCKET}"),
    ],
)
def test_a_missing_server_is_explained_by_the_state_of_its_socket(
    monkeypatch: pytest.MonkeyPatch,
    place: SocketPlace,
    named_by: str | None,
    error: TalkError,
    others: list[str],
    message: str,
    step: str,
) -> None:
    monkeypatch.setattr(paths, "client_sockets", lambda _: [])
    monkeypatch.setattr("glob.glob", lambda _: others)
    judgement = server.explain_missing_server([place], named_by, error)
    assert judgement.state == FAILURE
    assert message in judgement.message
    assert step in str(judgement.next)


def test_root_is_advised_to_use_the_server_of_the_user_who_called_sudo(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SocketPlace(PATH, server.PLACE_LISTENING, 1000, 7)
    monkeypatch.setattr(paths, "sudo_caller_socket", lambda: PATH)
    monkeypatch.setattr(server, "_probe_path", lambda *_: found)
    for place in (SocketPlace("/a", PLACE_ABSENT), replace(found, state=server.PLACE_FOREIGN)):
        step = server.explain_missing_server([place], None, NONE).next
        assert step == f"use the server of the user who called sudo: talk --socket {PATH} doctor"
    assert "--max-clients" in str(server.explain_missing_server([found], None, FULL).next)


def test_another_users_socket_before_the_servers_one_is_a_warning() -> None:
    message = f"the server is on {PATH} (process 4711)"
    finding = server.judge_found_server(message, [SocketPlace("/a", PLACE_ABSENT)])
    assert (finding.state, finding.message) == (OK, message)
    finding = server.judge_found_server(message, [SocketPlace("/a", server.PLACE_FOREIGN, 7)])
    assert finding.state == WARNING
    assert "/a: another user's server (uid 7)" in finding.message


PRONUNCIATIONS = {"file": "/n.txt", "terms": 3, "problems": ["line 4: write it like this"]}


@pytest.mark.parametrize(
    ("change", "check", "state", "step"),
    [
        ({}, "server", OK, "None"),
        ({"paused": True}, "server", FAILURE, "talk resume"),
        ({"paused": True, "paused_at": -9, "paused_until": None}, "server", FAILURE, "talk resume"),
        ({"paused": True, "paused_at": -600, "paused_until": 600}, "server", OK, "None"),
        ({"paused": True, "paused_at": -601, "paused_until": 1}, "server", WARNING, "talk resume"),
        ({"paused": True, "paused_at": -1, "paused_until": 601}, "server", WARNING, "talk resume"),
        ({"version": "0.0.1"}, "server", WARNING, "restart the server"),
        ({"engine": "pyttsx3 is missing"}, "server", WARNING, "install the missing part"),
        ({"volume": 0.0}, "settings", FAILURE, "talk set --volume 1"),
        ({"volume": 0.1}, "settings", WARNING, "talk set --volume 1"),
        ({"ttl": 5.0, "lead_in": 300, "preempt": True}, "settings", OK, "None"),
        ({"history": {"path": "/h.db", "with_text": True, "error": None}}, "history", OK, "None"),
        ({"history": {"path": "/h.db", "error": "disk full", "dropped": 3}}, "history", WARNING, "free some space"),
        ({"pronunciations": {**PRONUNCIATIONS, "problems": []}}, "pronunciation", OK, "None"),
        ({"pronunciations": PRONUNCIATIONS}, "pronunciation", WARNING, "correct the file"),
        ({"volume": 0.1 + 0.2, "ttl": 1.23456789012}, "settings", OK, "None"),
    ],
)
def test_a_server_is_judged_by_the_status_that_it_reports(
    change: dict[str, object], check: str, state: str, step: str
) -> None:
    finding = find(server.judge_server({**SERVER, **change}, [], 0.0), check)
    assert (finding.state, step in str(finding.next)) == (state, True)
    assert not re.search(r"\.\d{5}", finding.message)


def test_recent_failures_are_counted_and_the_last_one_is_shown() -> None:
    for beginning in ("speech failed", "Talk aborted"):  # older servers send the second one
        message = f"{beginning}: aplay: device is busy"
        aborted = Goal("4k7f-2", State.ABORTED, reason="audio_device", ended_at=0.0, message=message)
        finding = find(server.judge_server(SERVER, [SPOKEN, aborted], 600.0), "recent goals")
        assert finding.state == WARNING
        assert "ABORTED: 1 of the last 2 goals, most recently 4k7f-2, 10 min ago" in finding.message
        assert "audio_device: aplay: device is busy" in finding.message
    assert "another program uses the device" in str(finding.next)
    finding = find(server.judge_server(SERVER, [aborted, SPOKEN], 600.0), "recent goals")
    assert (finding.state, "1 succeeded since then" in finding.message) == (OK, True)
    assert find(server.judge_server(SERVER, [SPOKEN], 0.0), "recent goals").message == "the last goal did not fail"


def test_the_next_step_after_a_text_without_words_depends_on_the_text() -> None:
    goal = Goal("4k7f-2", State.ABORTED, text="...", reason="nothing_to_say", message="speech failed: nothing")
    assert find(server.judge_server(SERVER, [goal], 0.0), "recent goals").next == (
        "send a text with words: this one has no letters or digits"
    )
    foreign = replace(goal, text="你好")
    assert "choose a voice" in str(find(server.judge_server(SERVER, [foreign], 0.0), "recent goals").next)


def test_the_result_of_the_sentence_is_shown_with_the_next_step() -> None:
    played = SentenceResult(State.SUCCEEDED, duration=1.7, player="aplay", by_server=True)
    finding = sentence.judge_sentence(played, silent=False, device=None)
    assert finding.state == OK
    assert finding.message.endswith("was played to the end through the server, aplay, 1.7 s")
    assert finding.measured == {"onset_ms": None, "stop_ms": None}
    finding = sentence.judge_sentence(replace(played, onset_s=0.0174, stop_s=0.013), silent=False, device=None)
    assert finding.message.endswith(", 1.7 s; the sound began 17 ms after the request, and stops 13 ms after a cancel")
    assert finding.measured == {"onset_ms": 17, "stop_ms": 13}
    assert "a sentence was played without sound" in sentence.judge_sentence(played, silent=True, device=None).message
    for beginning in ("speech failed: ", "Talk aborted: ", ""):  # older servers send the second one
        message = f"{beginning}aplay: audio open error: Permission denied"
        denied = SentenceResult(State.ABORTED, "audio_device", message)
        finding = sentence.judge_sentence(denied, silent=False, device=None)
        assert finding.message == "ABORTED, audio_device: aplay: audio open error: Permission denied"
    assert "usermod -aG audio" in str(finding.next)
    stalled = SentenceResult(State.ABORTED, "audio_stalled", "aplay accepted no sound for 3 s")
    finding = sentence.judge_sentence(replace(stalled, suspended=("usb",)), silent=False, device=None)
    assert (finding.next, "suspended: usb" in finding.message) == ("pactl suspend-sink usb 0", True)
    finding = sentence.judge_sentence(replace(played, muted_device="usb"), silent=False, device="usb")
    assert (finding.state, "pactl set-sink-mute usb 0" in str(finding.next)) == (FAILURE, True)
    late = SentenceResult(State.RECALLED, "late", "not spoken: it was still waiting behind 7 goals after 20 s")
    finding = sentence.judge_sentence(late, silent=False, device=None)
    assert finding.message.startswith("not spoken: it was still waiting behind 7 goals")
    assert "talk status" in str(finding.next)
    assert "run talk doctor again" in str(
        sentence.judge_sentence(
            SentenceResult(State.PREEMPTED, "canceled", "Talk preempted"), silent=False, device=None
        ).next
    )


def test_the_advice_depends_on_the_message_and_the_player() -> None:
    assert "apt-get install -y libespeak-ng1" in sentence.advise("engine_failed", MISSING)
    assert sentence.advise("engine_failed", "no module named pyttsx3") == sentence.ADVICE["engine_failed"]
    assert "PulseAudio" in sentence.advise("no_player", "no sound server is running", "pulse")
    assert sentence.advise("no_player", "no player found", "aplay") == sentence.ADVICE["no_player"]


FINDINGS = [
    ok("python", "Python 3.11.2"),
    warning("sound server", "one " * 40, "do " * 40),
    failure("socket", "no server", "talk serve"),
]


@pytest.mark.parametrize("columns", [40, 80, 120])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    screen = Screen(columns, colour=True)
    for finding in FINDINGS:
        lines = report.format_finding(finding, screen)
        assert max(map(width, lines)) <= columns, lines
        assert all("\x1b" not in line or line.endswith("\x1b[0m") or "\x1b[0m  " in line for line in lines)
        if finding.next is not None:
            assert any("-> " in line for line in lines)
    conclusion = report.format_conclusion(FINDINGS, screen).splitlines()
    assert max(map(len, conclusion), default=0) + len("talk: ") <= columns + 12


def test_in_a_pipe_a_finding_is_one_line_without_colour() -> None:
    assert [report.format_finding(finding, Screen()) for finding in FINDINGS[::2]] == [
        ["ok       python        Python 3.11.2"],
        ["failed   socket        no server -> talk serve"],
    ]
    assert report.format_conclusion(FINDINGS, Screen()) == "a sentence would not be heard; do this next:\n  talk serve"
    played = [ok("python", "3"), ok("sentence", "played")]
    assert report.format_conclusion(played, Screen()) == "a sentence is heard, unless the loudspeaker itself is off"
    assert report.format_conclusion([FINDINGS[1], *played], Screen()).endswith("; 1 warning")


# Sound


PI = UserSession(1000, "pi", gids=(1000, 29), runtime_dir="/run/user/1000", runtime_owner=1000)
CARDS = ("USB Audio Device",)
NO_SERVER = SoundServer(error="Connection refused")
WIRE = SoundServer("PipeWire without PulseAudio support", accepts_pulse=False)
PULSE = SoundServer(name="PulseAudio (on PipeWire 1.2.7)", default_sink="alsa_output.usb")


def judged_server(server: SoundServer, cards: tuple[str, ...] = CARDS, session: UserSession = PI) -> Finding:
    return sound.judge_sound_server(server, cards, session)


def player(configured: str | None, used: str | None, *installed: str, by_server: bool = False) -> Finding:
    """Return the finding about a player if only these programs are installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sound, "on_path", lambda program, _: program in installed)
        return sound.check_player({}, configured, used, used_by_server=by_server)


def test_a_sound_card_without_a_sound_server_is_ok() -> None:
    assert {sound.check_cards(CARDS, SoundServer(), PI).state, judged_server(SoundServer()).state} == {OK}
    used = player(None, "aplay", "aplay", "pacat")
    assert (used.state, used.message) == (OK, "aplay is used; other players: pacat")


def test_a_responding_sound_server_needs_no_player_program() -> None:
    assert (
        player(None, "pulse", "aplay", "pacat").message
        == "pulse is used to play through the sound server; other players: aplay, pacat"
    )
    only_server = player(None, "pulse")
    assert (only_server.state, only_server.message) == (OK, "pulse is used to play through the sound server")
    assert player("pulse", "pulse", by_server=True).message == "pulse (set by the server)"
    configured = player("pacat", "pacat", "aplay", "pacat", "pw-cat")
    assert configured.message == "pacat (set by TALK_PLAYER); other players: aplay, pw-cat"


def test_the_engine_process_or_else_the_sound_server_determines_the_player(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sound, "on_path", lambda program, _: program in {"aplay", "pacat"})
    monkeypatch.setattr(sound, "_read_levels", lambda *_: ())
    monkeypatch.setattr(sound, "run_program", lambda *_, **__: sound.ProgramOutput("it is not there"))

    def first(server: SoundServer, chosen: str | None = None, *, by_server: bool = False) -> str:
        monkeypatch.setattr(sound, "find_sound_server", lambda *_: server)
        examination = LocalExamination(None, silent=True)
        examination._engine, examination._env = EngineReport(replace(READY, player=chosen)), {}
        examination._client = CLIENT if by_server else None
        message = find(list(examination._check_sound()), "player").message
        return message.partition(" is used")[0]

    monkeypatch.delenv("TALK_PLAYER", raising=False)
    assert first(PULSE) == first(WIRE, "pulse") == "pulse"
    assert first(PULSE, "aplay") == first(WIRE) == first(NO_SERVER) == "aplay"
    assert first(PULSE, "aplay", by_server=True) == "pulse", "the server has another engine"


def test_a_player_that_needs_a_sound_server_is_warned_about_if_none_is_running(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound, "on_path", lambda *_: False)
    monkeypatch.setattr(sound, "find_cards", tuple)
    monkeypatch.setattr(sound, "find_sound_server", lambda *_: SoundServer())
    examination = LocalExamination(None, silent=True)
    for player, state in (("pulse", WARNING), ("aplay", OK)):
        examination._server = {"player": player, "device": "usb"}
        findings = list(examination._check_sound())
        assert find(findings, "sound server").state == state
        assert (find_playback_step(findings) == sound.START_SOUND_SERVER) == (state == WARNING)


def test_a_sound_server_with_only_a_dummy_output_is_a_warning() -> None:
    finding = judged_server(replace(PULSE, default_sink=DUMMY_SINK))
    assert (finding.state, finding.next) == (
        WARNING, "connect a loudspeaker, and check that it is listed: pactl list short sinks"
    )  # fmt: skip
    assert "has only the dummy output auto_null, which nobody can hear" in finding.message
    assert sound.check_cards((), replace(PULSE, default_sink=DUMMY_SINK), PI).state == WARNING


def test_a_missing_player_is_reported_with_its_package() -> None:
    finding = player(None, None)
    assert (finding.state, finding.next) == (FAILURE, "sudo apt-get install -y alsa-utils")
    assert player(None, None, by_server=True).state == WARNING
    finding = player("pw-cat", "pw-cat", "aplay")
    assert (finding.state, finding.next) == (FAILURE, "sudo apt-get install -y pipewire-bin")
    for command in ("/opt/play -x", "'"):
        finding = player(command, command, "aplay")
        assert (finding.state, f"{command} (set by TALK_PLAYER) is not installed" in finding.message) == (FAILURE, True)
    assert player("/opt/play -x", "/opt/play -x", "/opt/play", "aplay").state == OK


def test_a_silent_player_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    for player in ("null", "file:/tmp/x.wav"):
        monkeypatch.setenv("TALK_PLAYER", player)
        examination = LocalExamination(None, silent=True)
        examination._env = {"PATH": "/nowhere"}
        (finding,) = examination._check_sound()
        assert (finding.check, finding.state, finding.next) == ("player", FAILURE, "unset TALK_PLAYER")
        assert "without --player" in str(sound.judge_silent_player(player, set_by_server=True).next)


def test_a_step_that_needs_pactl_names_its_package(tmp_path: Path) -> None:
    muted = failure("loudness", "muted", "pactl set-sink-mute @DEFAULT_SINK@ 0")
    without = {"PATH": str(tmp_path)}
    step = f"{muted.next} (to install pactl: sudo apt-get install -y pulseaudio-utils)"
    assert sound.with_pactl_hint(muted, without).next == step
    other = failure("socket", "no server", "talk serve")
    assert sound.with_pactl_hint(other, without) == other
    write(tmp_path / "pactl", "", 0o755)
    assert sound.with_pactl_hint(muted, without) == muted


def test_a_missing_device_is_to_be_connected_or_passed_to_the_container() -> None:
    finding = sound.check_cards((), NO_SERVER, PI)
    assert (finding.state, "connect a loudspeaker" in str(finding.next)) == (WARNING, True)
    finding = sound.check_cards((), NO_SERVER, replace(PI, origins=("a container",)))
    assert "--device /dev/snd" in str(finding.next)
    assert sound.check_cards((), PULSE, PI).state == OK


@pytest.mark.parametrize(
    ("change", "step"),
    [
        ({"origins": ("a container",)}, "PULSE_SERVER"),
        ({"origins": ("a system service",)}, "--print-unit user"),
        ({"uid": 0, "sudo_uid": 1000}, "run talk doctor without sudo"),
        ({"runtime_dir": None, "usual_runtime_dir": "/run/user/1000"}, "export XDG_RUNTIME_DIR=/run/user/1000"),
        ({}, "systemctl --user restart"),
    ],
)
def test_the_next_step_to_reach_a_sound_server_depends_on_the_session(change: dict[str, object], step: str) -> None:
    server = replace(NO_SERVER, sockets=("/run/user/1000/pulse/native",))
    finding = judged_server(server, session=replace(PI, **change))
    assert finding.state == WARNING
    assert "/run/user/1000/pulse/native cannot be reached from here: Connection refused" in finding.message
    assert step in str(finding.next)


def test_an_unusable_sound_server_is_reported_with_its_cause() -> None:
    assert "does not answer" in judged_server(SoundServer(hangs=True)).message
    assert "unset PULSE_SERVER" in str(judged_server(SoundServer(pulse_server="unix:/x", error="refused")).next)
    finding = judged_server(SoundServer(sockets=("/run/user/1000/pipewire-0",)))
    assert finding.next == "sudo apt-get install -y pulseaudio-utils"
    service = judged_server(SoundServer(), (), replace(PI, origins=("a cron job",)))
    assert service.state == WARNING


def test_a_missing_runtime_directory_is_reported_with_the_variable_to_set() -> None:
    finding = sound.judge_session(replace(PI, runtime_dir=None, runtime_owner=None, usual_runtime_dir="/run/user/1000"))
    assert (finding.state, finding.next) == (WARNING, "export XDG_RUNTIME_DIR=/run/user/1000")
    assert "cron, sudo" in finding.message
    served = sound.judge_session(replace(PI, runtime_dir=None, usual_runtime_dir="/run/user/1000", server_pid=7))
    assert " for the server, and restart it" in str(served.next)
    assert sound.judge_session(replace(PI, runtime_dir=None)).state == OK
    assert "does not exist" in sound.judge_session(replace(PI, runtime_owner=None)).message
    assert "belongs to uid 33" in sound.judge_session(replace(PI, runtime_owner=33)).message


SOUND_OUTPUTS = [
    ("Mute: yes\nVolume: mono: 65536 / 100% / 0.00 dB\n", FAILURE, "out is muted"),
    ("Volume: 0.05\n", WARNING, "out is at 5%, which may be too quiet"),
    ("Volume: 0.40 [MUTED]\n", FAILURE, "out is muted"),
    ("Volume: 0.00\n", FAILURE, "out is at 0%"),
    ("  Left: Playback 0 [0%] [-65.25dB] [off]\n  Right: 9 [40%] [on]\n", OK, "out is at 40%"),
    ("  Mono: Playback 0 [0%] [-65.25dB] [off]\n", FAILURE, "out is muted"),
    ("  Mono: Playback [on]\n", OK, "out is not muted"),
]


@pytest.mark.parametrize(("text", "state", "message"), SOUND_OUTPUTS)
def test_a_muted_or_quiet_output_is_reported(text: str, state: str, message: str) -> None:
    finding = sound.judge_level("out", text, "unmute", "louder", in_use=True)
    assert (finding.check, finding.state, finding.message) == ("loudness", state, message)
    assert finding.next == (None if state == OK else "unmute" if message == "out is muted" else "louder")
    finding = sound.judge_level("out", text, "unmute", "louder", in_use=False)
    assert finding.state == (OK if state == OK else WARNING), "another device is in use"


def test_the_worst_of_several_outputs_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def levels(*texts: str) -> list[Finding]:
        outputs = [(f"out{number}", text, "unmute", "louder") for number, text in enumerate(texts)]
        monkeypatch.setattr(sound, "_read_levels", lambda *_: outputs)
        return sound.check_levels({}, NO_SERVER, CARDS, in_use=True)

    assert levels() == []
    assert [finding.message for finding in levels("[40%] [on]", "[on]")] == ["out0 is at 40%, out1 is not muted"]
    assert [finding.message for finding in levels("[40%] [on]", "[5%] [on]", "[off]")] == ["out2 is muted"]


def test_a_player_with_an_unknown_program_is_custom() -> None:
    assert all(map(sound.is_custom_command, ("sleep 100", "/opt/bin/play -x", "false")))
    assert not any(map(sound.is_custom_command, ("/usr/bin/aplay -q", "pacat", "null", "file:a.wav", "'", "", None)))
