"""Recorded conversations: requests and replies of protocol 1 stay valid while the protocol is 1.

The recordings are never edited. A new request or field is recorded in a new file beside them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from talkcli.errors import RequestRefused, refusal
from talkcli.goals.goal import Goal
from talkcli.protocol import events
from talkcli.protocol.events import ServerStatus
from talkcli.protocol.lines import decode
from talkcli.protocol.requests import REQUEST_TYPES
from tests.conformance.rawsocket import Raw

if TYPE_CHECKING:
    from collections.abc import Collection

    from tests.conftest import MakeTalk

RECORDINGS = sorted(Path(__file__).parent.glob("*.txt"))
#: The `boot` of the recorded server, which is the first half of its goals' ids.
BOOT = "k3fz"
#: SHA-256 of each recording, to detect accidental edits.
CHECKSUMS = {
    "protocol-1": "5a39d2af4e6c797d4d449d37623fd96d9f78ea4f33952ef545dc1e4e552212fd",
    "protocol-1-audible": "d027e998482272e961e2bebded96fb3d2d3dc4e2410b2d2fd6c0ea2076ce131a",
    "protocol-1-dry-run": "584db313224a04b20bac60f133224c7cc4a4b3a0986cf7808777a71642f35164",
    "protocol-1-growing": "275717f75fd059b2cc27becc7d3b7d24ba731d2ab482d29acf397fb6fbd42cb4",
    "protocol-1-interject": "e891b047c63f0828fd74ae6ec3dde3133d69bbd0f0c0aee769292cd62af3bd9d",
    "protocol-1-lead-in": "3f3263930adb3116d5329efa626e6eaefc47f16290d539d36e352152bc22067e",
    "protocol-1-log": "e6bff73cab3772ced91ee80a2fcfd19a7ee4229aa486dffe357b078973987d15",
    "protocol-1-markdown": "2f65ff7f254ecbd5789e58ac5fb504248d0b3ba2d6cd9b4b746a238dedbab871",
    "protocol-1-pauses": "6eee345b7e2f430238e5e5cf765eeb0ca3fdc712e09dd0c70c8637c3ebcaf9b7",
    "protocol-1-sound": "c738e879bd95c96fc687f2ba98e39b3d6172bed1c61f06841cacbaddcc9fe078",
    "protocol-1-voice": "4053df5d6bb376af2403e923cb48468fdeb25a46323a63e47e472ab823ef457f",
}
#: Fields that depend on the server, the client or the run. Only their types are compared.
VARIES = {
    "version", "pid", "uid", "command", "parent", "socket", "at", "n", "started_at", "queued_at", "ended_at", "uptime",
    "time", "duration", "heard", "message", "clients", "engine", "driver", "synthesizer", "player", "paused_at",
    "paused_until",
}  # fmt: skip
#: Fields of `VARIES` that may also be null.
MAY_BE_NULL = {"pid", "uid", "command", "parent", "duration", "synthesizer", "player"}

Message = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a recording. `kind` is "connect", ">" (from the client) or "<" (from the server)."""

    number: int
    kind: str
    text: str

    @property
    def message(self) -> Message:
        message = json.loads(self.text)
        assert isinstance(message, dict), self
        return message


def read(recording: Path) -> list[Line]:
    rows = enumerate(recording.read_text(encoding="utf-8").splitlines(), 1)
    lines = [Line(number, *row.partition(" ")[::2]) for number, row in rows if not row.startswith("#")]
    assert {line.kind for line in lines} == {"connect", ">", "<"}
    return lines


def server_lines() -> list[Line]:
    return [line for recording in RECORDINGS for line in read(recording) if line.kind == "<"]


def differences(recorded: object, now: object, varies: Collection[str] = VARIES, name: str = "") -> list[str]:
    """Return the differences between a recorded and a current message. Added fields don't count."""
    if isinstance(recorded, dict) and isinstance(now, dict):
        result = [f"{name}.{key} is missing" for key in recorded.keys() - now.keys()]
        for key in recorded.keys() & now.keys():
            result += differences(recorded[key], now[key], varies, f"{name}.{key}")
        return result
    return [] if _alike(name.rpartition(".")[2], recorded, now, varies) else [f"{name}: {recorded!r}, now {now!r}"]


def _alike(key: str, recorded: object, now: object, varies: Collection[str]) -> bool:
    if recorded is None or now is None:
        return recorded is now or key in MAY_BE_NULL & set(varies)
    if key == "spoken" and varies:
        return isinstance(now, str)  # the spoken part of a cancelled goal varies
    if key == "features":
        return isinstance(recorded, list) and isinstance(now, list) and set(recorded) <= set(now)
    kinds = [int if isinstance(value, float) else type(value) for value in (recorded, now)]
    return kinds[0] is kinds[1] and (key in varies or recorded == now)


def next_message(raw: Raw, seen: int, kinds: set[str]) -> tuple[Message, int]:
    """Return the next message of a kind that the recorded client knows, and the number of lines read so far."""
    while True:
        message = raw.receive_lines(seen + 1)[seen]
        seen += 1
        if "event" not in message or message["event"] in kinds:
            return message, seen


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda path: path.stem)
def test_the_server_still_sends_the_recorded_messages(recording: Path, make_talk: MakeTalk) -> None:
    talk = make_talk(scripted=True, watched=False)
    with Raw(talk.socket) as raw:
        boot = raw.receive_lines(1)[0]["boot"]
    lines = read(recording)
    kinds = {line.message["event"] for line in lines if line.kind == "<" and "event" in line.message} - {"alive"}
    raw, seen = Raw(talk.socket), 0
    try:
        for line in lines:
            text = line.text.replace(f'"{BOOT}', f'"{boot}')
            if line.kind == "connect":
                raw.socket.close()
                raw, seen = Raw(talk.socket), 0
            elif line.kind == ">":
                raw.send(text.encode() + b"\n")
            else:
                message, seen = next_message(raw, seen, kinds)
                diff = differences(json.loads(text), message)
                assert not diff, f"line {line.number} of {recording.name}: {diff}\nrecorded: {text}\nnow: {message}"
    finally:
        raw.socket.close()


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda path: path.stem)
def test_recordings_are_never_edited(recording: Path) -> None:
    assert sha256(recording.read_bytes()).hexdigest() == CHECKSUMS[recording.stem], (
        f"{recording.name} was edited: record new messages in a new file, and add its checksum here"
    )


def test_every_request_and_field_is_recorded() -> None:
    recorded: dict[str, set[str]] = {kind: set() for kind in REQUEST_TYPES}
    for line in [line for recording in RECORDINGS for line in read(recording) if line.kind == ">"]:
        try:
            message = line.message
        except ValueError:
            continue  # the recordings contain a malformed line
        recorded.setdefault(message.get("request", ""), set()).update(message)
    missing = {kind: {option.name for option in REQUEST_TYPES[kind].options} - recorded[kind] for kind in REQUEST_TYPES}
    assert not any(missing.values()), f"record these in a new file beside {RECORDINGS[0].name}: {missing}"
    assert all("request" in recorded[kind] for kind in REQUEST_TYPES)


def test_the_client_understands_every_recorded_line() -> None:
    known = 0
    for line in server_lines():
        message = decode(line.text.encode())
        assert message == line.message
        if "talk" in message:
            events.check_greeting(message)
        elif "event" in message:
            event = events.from_json(message)
            assert event is not None, line
            assert not differences(message, event.to_json(), varies=())
            known += 1
        elif "error" in message:
            assert isinstance(refusal(**line.message["error"]), RequestRefused)
        elif "server" in message:
            assert ServerStatus.from_reply(message, []).server == message["server"]
        for name in ("goal", "pending", "recent", "canceled", "ended", "active"):
            if message.get(name) is not None and message.get("event") != "state":
                assert not differences(message[name], Goal.from_json(message[name]).to_json(), varies=()), line
    assert known > 40
