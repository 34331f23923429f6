"""A client that is refused changes nothing, even with requests that it sent before it left."""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING

from talkcli.server.run import DOOR

if TYPE_CHECKING:
    from tests.conftest import MakeTalk
    from tests.support.processes import Talk


def test_what_a_client_past_the_door_sent_before_it_closed_is_not_carried_out(make_talk: MakeTalk) -> None:
    talk = make_talk("--max-clients", "1", scripted=True, watched=False)
    with contextlib.ExitStack() as stack:
        asking = stack.enter_context(talk.connect())
        before = asking.request("status")["server"]
        for _ in range(DOOR):
            stack.enter_context(connected(talk))
        asking.request("hello", urgent=True)
        send_and_go(talk, b'{"request":"set","volume":0.1,"preempt":true}\n', b'{"request":"pause"}\n')
        with connected(talk) as last:  # once it is answered, the clients before it have been served
            while last.recv(4096):
                pass
        after = asking.request("status")["server"]
    changed = {each for each in ("volume", "preempt", "paused") if before[each] != after[each]}
    assert not changed
    assert "a bug" not in talk.log


def test_what_follows_ten_bad_lines_is_not_carried_out_where_the_client_has_gone_either(scripted: Talk) -> None:
    send_and_go(scripted, b"garbage\n" * 10 + b'{"request":"pause"}\n')
    assert scripted.request("status")["server"]["paused"] is False


def connected(talk: Talk) -> socket.socket:
    """Return a connection that has said nothing."""
    found = socket.socket(socket.AF_UNIX)
    found.connect(talk.socket)
    return found


def send_and_go(talk: Talk, *lines: bytes) -> None:
    """Connect, send and close once for each of these lines, while the server is frozen."""
    talk.freeze()
    for each in lines:
        with connected(talk) as client:
            client.sendall(each)
    talk.thaw()
