"""`Talk`, which starts, watches and ends a server for a test, shown with a small program in the server's place."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tests.support import processes
from tests.support.surroundings import MARK, marked

if TYPE_CHECKING:
    import pathlib

    from tests.conftest import MakeTalk

#: Greets, answers each request, sends one goal's events to a watcher; ends as its arguments say.
PROGRAM = """
import json, os, signal, socketserver, subprocess, sys

class Handler(socketserver.StreamRequestHandler):
    def say(self, **message):
        self.wfile.write(json.dumps(message).encode() + b"\\n")

    def handle(self):
        self.say(talk=1, version="0", pid=os.getpid(), boot="test", features=[])
        for line in self.rfile:
            request = json.loads(line)
            self.say(seq=request["seq"], ok=True, socket=os.environ.get("XDG_RUNTIME_DIR"))
            if request["request"] == "watch":
                for n, state in enumerate(sys.argv[2].split(",")):
                    self.say(event="state", id="a", state=state, n=n, at=0)

class Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True

def end(*_):
    if "keeps-socket" not in sys.argv:
        os.unlink(os.environ["TALK_SOCKET"])
    os._exit(int(sys.argv[1]))

print("serving", sys.argv[3:], file=sys.stderr, flush=True)
if "fails" in sys.argv:
    sys.exit("no voice")
if "leaves" in sys.argv:
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
if "traceback" in sys.argv:
    print("Traceback (most recent call last):", file=sys.stderr, flush=True)
signal.signal(signal.SIGTERM, end)
Server(os.environ["TALK_SOCKET"], Handler).serve_forever()
"""
WELL = "PENDING,ACTIVE,SUCCEEDED"


@pytest.fixture
def program(tmp_path: pathlib.Path) -> str:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return str(path)


def test_a_good_server_is_started_watched_and_ended(make_talk: MakeTalk, program: str) -> None:
    talk = make_talk("0", WELL, program=program)
    assert talk.running
    assert talk.log == "serving []\n"
    assert talk.watcher.wait_for("a", "SUCCEEDED")["n"] == 2
    with talk.connect() as wire:
        assert wire.greeting["pid"] == talk.pid
    assert talk.request("status", timeout=1) == {"seq": 1, "ok": True, "socket": None}
    talk.freeze()
    talk.stop()
    assert not talk.running
    talk.start_server()
    assert talk.running
    talk.watcher.wait_for("a", "SUCCEEDED")


def test_a_server_that_was_killed_owes_no_end(make_talk: MakeTalk, program: str) -> None:
    talk = make_talk("0", "ACTIVE", program=program)
    talk.watcher.wait_for("a", "ACTIVE")
    talk.kill()
    assert not talk.running


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (("1", WELL), "ended with 1"),
        (("0", "ACTIVE"), "no terminal state"),
        (("0", WELL + ",SUCCEEDED"), "more than one terminal state"),
        (("0", WELL, "keeps-socket"), "left its socket"),
        (("0", WELL, "leaves"), "left running"),
        (("0", WELL, "traceback"), "Traceback"),
    ],
)
def test_a_bad_end_is_noticed(arguments: tuple[str, ...], fault: str, program: str) -> None:
    talk = processes.Talk(arguments, program=program)
    directory = talk.directory
    try:
        last = arguments[1].count(",")
        talk.watcher.wait_until(lambda each: each.get("n") == last)
        with pytest.raises(AssertionError, match=fault):
            talk.stop(gone_within=0.2)
    finally:
        talk.close()
    assert not os.path.exists(directory)


def test_a_server_that_does_not_start_is_told_with_its_log(program: str) -> None:
    with pytest.raises(AssertionError, match="no voice"):
        processes.Talk(("0", WELL, "fails"), program=program)


def test_closing_ends_everything_without_a_word(program: str) -> None:
    talk = processes.Talk(("0", WELL, "leaves"), program=program, env={"EXTRA": "1"})
    mark = talk.env[MARK].removesuffix("-client")
    client = talk.start("status")
    assert talk.env["EXTRA"] == "1"
    assert len(marked(mark)) == 2
    talk.close()
    assert marked(mark) == []
    assert client.returncode is not None
