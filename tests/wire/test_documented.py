"""The tables of states, requests, events, errors, limits and exit codes in the documents match the code."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING

from talkcli import errors, paths
from talkcli.cli import commands
from talkcli.fleet import topics
from talkcli.fleet.bridge import policy
from talkcli.goals import states
from talkcli.goals.goal import Goal
from talkcli.goals.memory import MAX_RECALLED_GOALS, MAX_REJECTED_GOALS, MAX_SPOKEN_GOALS
from talkcli.goals.options import GROWTH_FACTOR, MAX_TEXT_BYTES, MAX_TEXT_CHARS
from talkcli.goals.states import State
from talkcli.protocol import events
from talkcli.protocol.features import FEATURES
from talkcli.protocol.lines import MAX_LINE_BYTES
from talkcli.protocol.requests import REQUEST_TYPES
from talkcli.server import connection, stream
from talkcli.server.requests import MAX_CLIENT_REQUESTS, MAX_KEPT_REQUEST_BYTES, RECENT_GOALS, REQUEST_BYTES
from talkcli.server.run import ServerSettings
from talkcli.server.speech import MAX_UNHEARD_CHARS
from tests.support.documents import FLEET, README, ROOT, WIRE, code_spans, first_column, tables
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    import pytest

    from tests.support.processes import Talk

NUMERALS = {5: "five"}
ERRORS, LIMITS = tables(WIRE.section("Errors and limits"))


def test_states_and_requests_are_documented() -> None:
    states = tables(WIRE.section("States"))[0]
    documented = {code_spans(row[0])[0]: (int(row[1]), row[3] == "yes") for row in states[1:]}
    assert documented == {state.name: (int(state), state.terminal) for state in State}
    requests = {request for row in tables(WIRE.section("Requests"))[1][1:] for request in code_spans(row[0])[:1]}
    assert requests == set(REQUEST_TYPES)


def test_documented_features_match_the_code() -> None:
    (table,) = [each for each in tables(WIRE.text) if each[0][0] == "feature"]
    assert [code_spans(row[0]) for row in table[1:]] == [[each] for each in FEATURES]


def test_documented_keys_and_error_codes_match_the_code() -> None:
    """`tests/golden` and the tests of the faults check which code a fault has."""
    assert first_column(tables(WIRE.section("The goal"))[0]) == list(Goal("", State.PENDING).to_json())
    codes = first_column(ERRORS)
    refused: list[type[errors.RequestRefused]] = [
        errors.UnknownGoal,
        errors.BadRequest,
        *errors.BadRequest.__subclasses__(),
    ]
    assert {error.code for error in refused} <= set(codes)
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "talkcli").rglob("*.py"))
    for code in (*codes, *first_column(tables(FLEET.section("What is refused"))[0])):
        assert f'"{code}"' in sources, code


def test_keys_of_the_server_are_documented(scripted: Talk) -> None:
    form = r"the object `server` has these keys: (.*?)\.$"
    (listed,) = re.findall(form, WIRE.section("Requests"), re.MULTILINE | re.DOTALL)
    assert code_spans(listed) == list(scripted.request("status")["server"])


def test_numbers_of_kept_goals_are_documented() -> None:
    assert RECENT_GOALS == 10
    kept = f"{MAX_SPOKEN_GOALS:,} spoken goals, {MAX_RECALLED_GOALS:,} RECALLED ones and {MAX_REJECTED_GOALS} REJECTED"
    assert f"The server keeps the last {kept} ones." in WIRE.section("The goal")


def test_documented_limits_match_the_code() -> None:
    limits = {row[0]: row[1] for row in LIMITS[1:]}
    assert limits["a request"].startswith(f"{MAX_LINE_BYTES:,} bytes")
    assert f"within {connection.FIRST_REQUEST_S:g} s" in limits["the first request"]
    assert f"within {connection.LINE_LIMIT_S:g} s" in limits["a line"]
    text = f"{MAX_TEXT_CHARS:,} characters (`--max-text`), or {NUMERALS[GROWTH_FACTOR]} times as many if it grows"
    assert limits["a text"].startswith(text)
    assert f"at most {MAX_TEXT_BYTES:,} bytes" in limits["a text"]
    assert f"at most {MAX_UNHEARD_CHARS:,} characters are unheard" in limits["a growing text"]
    assert limits["invalid lines"].startswith(f"{connection.MAX_BAD_LINES} ")
    read = limits["a client that doesn't read"]
    assert f"{stream.CONGESTION_BYTES // 1024} KiB" in read
    assert f"{connection.MAX_CLIENT_OUTPUT_BYTES // 2**20} MiB" in read
    assert f"past {stream.MAX_TOTAL_OUTPUT_BYTES // 2**20} MiB for all" in limits["clients that don't read"]
    assert limits["clients"].startswith(f"{ServerSettings().max_clients} ")
    assert limits["queue"].startswith(f"{ServerSettings().max_queue} ")
    assert limits["waiting requests"].startswith(
        f"{MAX_CLIENT_REQUESTS:,} of one connection, and {MAX_KEPT_REQUEST_BYTES >> 20} MiB for all"
    )
    assert f"and {REQUEST_BYTES >> 10} KiB each)" in limits["waiting requests"]


def test_documented_limits_of_a_fleet_match_the_code() -> None:
    needs_packages("paho")
    from talkcli.fleet import link
    from talkcli.fleet.bridge import main as bridge
    from talkcli.fleet.bridge import publisher, session

    limits = {row[0]: row[1] for row in tables(FLEET.section("Limits"))[0][1:]}
    assert limits["a request"].startswith(f"{MAX_LINE_BYTES:,} bytes")
    assert limits["correlation data"] == f"{policy.MAX_CORRELATION_BYTES} bytes"
    requests = " ".join(FLEET.section("Requests and replies").split())
    assert f"with more than {policy.MAX_CORRELATION_BYTES} bytes of correlation data" in requests
    assert f"at most {(link.MAX_PACKET_BYTES - link.MAX_HEADER_BYTES) // 1024} KiB" in limits["a reply's payload"]
    of_user = policy.MAX_REMOTE_GOALS * policy._PENDING_PER_FREE_PLACE // (policy._PENDING_PER_FREE_PLACE + 1)
    assert limits["pending goals of all remote clients; of one user"] == f"{policy.MAX_REMOTE_GOALS}; {of_user}"
    assert limits["remote clients"].startswith(
        f"{session.MAX_SESSIONS}, and {session.MAX_WAITING_REQUESTS} requests of each"
    )
    assert limits["waiting requests"].startswith(f"{session.MAX_WAITING_BYTES >> 20} MiB for all remote clients")
    assert limits["a silent remote client"] == f"{session.CLIENT_SILENCE_LIMIT_S:g} s"
    assert limits["remembered ids"] == f"{policy.MAX_REMEMBERED_IDS:,}"
    assert f"past {bridge.SLOW_BROKER_BYTES // 1024} KiB" in limits["a slow broker"]
    assert f"past {bridge.STUCK_BROKER_BYTES // 2**20} MiB" in limits["a slow broker"]
    section = " ".join(FLEET.section("Topics").split())
    assert f"1 to {topics.MAX_NAME_CHARS} characters" in section
    assert f"expires after {bridge.PRESENCE_EXPIRY_S} s, renewed every {bridge.PRESENCE_EVERY_S:g} s" in section
    assert f"expires after {publisher.EVENT_EXPIRY_S} s" in section
    assert f"more than {policy.STALE_AFTER_S:g} s ago" in " ".join(FLEET.section("What is refused").split())


def test_documented_socket_paths_match_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    variables = {"XDG_RUNTIME_DIR": "/own/run", "TMPDIR": "/own/tmpdir", "TEMP": "/own/temp", "TMP": "/own/tmp"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.platform", "linux")
    (paragraph,) = re.findall(r"^\*\*Connecting\..*?\n\n", WIRE.text, re.MULTILINE | re.DOTALL)
    sockets = [path for path in code_spans(paragraph) if path.endswith(".sock")]
    for name, value in variables.items():
        sockets = [path.replace(f"${name}/", f"{value}/") for path in sockets]
    assert [path.replace("UID", str(os.getuid())) for path in sockets] == paths.client_sockets(None)


def test_events_are_documented() -> None:
    table = {code_spans(row[0])[0]: set(code_spans(row[2])) for row in tables(WIRE.section("Events"))[0][1:]}
    sent = {kind: set(event.__annotations__) for kind, event in events._EVENTS_BY_KIND.items() if kind != "snapshot"}
    assert set(table) == {*sent, "alive"}
    assert all(fields <= table[kind] for kind, fields in sent.items())


def test_exit_codes_and_commands_are_documented() -> None:
    rows = [row[0] for row in tables(README.section("Exit codes"))[0][1:]]
    assert rows[-1] == f"{errors.EXIT_SIGNAL}+n"
    classes = [cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, errors.TalkError)]
    used = {error.exit_code for error in classes} | set(states.EXIT_CODES.values())
    used |= {errors.EXIT_OK, errors.EXIT_ERROR, errors.EXIT_USAGE, errors.EXIT_DIFFER, errors.EXIT_TIMEOUT}
    assert sorted(map(int, rows[:-1])) == sorted(used)
    for command in commands.COMMANDS:
        assert re.search(rf"\btalk (?:-\S+ |--robot \S+ )*{command}\b", README.text), command
