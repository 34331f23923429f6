"""Other callbacks of the event loop are never late because of `talk`."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from tests.support.timing import assert_within, limits
from tests.test_client_reconnecting import restart

if TYPE_CHECKING:
    from tests.support.processes import Talk

#: Runs an event loop until SIGTERM, and prints the duration of its longest callback in seconds.
PROGRAM = """
import asyncio, contextlib, signal, time
from talkcli.aio import Client
from talkcli.errors import TalkError

longest, run = 0.0, asyncio.events.Handle._run

def timed_run(handle):
    global longest
    started_at = time.perf_counter()
    run(handle)
    longest = max(longest, time.perf_counter() - started_at)

async def watch(talk):
    async for event in talk.events(reconnect=True):
        pass

async def speak(talk):
    while True:
        with contextlib.suppress(TalkError):
            await (await talk.say("length=0.05 one two", feedback=True)).wait()
        await asyncio.sleep(0.01)

async def main(with_talk):
    ending, tasks = asyncio.Event(), []
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ending.set)
    async with contextlib.AsyncExitStack() as stack:
        if with_talk:
            talk = await stack.enter_async_context(Client(timeout=0.5))
            tasks = [asyncio.create_task(each(talk)) for each in (watch, speak, speak, speak)]
        asyncio.events.Handle._run = timed_run
        while not ending.is_set():
            await asyncio.sleep(0.01)
        for task in tasks:
            task.cancel()
    print(longest)

asyncio.run(main({with_talk}))
"""


def test_no_callback_takes_long_while_a_server_is_stopped_and_restarted(scripted: Talk) -> None:
    with limits(), contextlib.ExitStack() as stack:
        programs = []
        for uses_talk in (True, False):
            code = PROGRAM.format(with_talk=uses_talk)
            program = subprocess.Popen([sys.executable, "-c", code], env=scripted.env, stdout=subprocess.PIPE)
            programs.append(stack.enter_context(program))
            stack.callback(program.kill)  # needed only if the test fails
        scripted.watcher.wait_for(None, "SUCCEEDED")
        scripted.freeze()
        time.sleep(0.8)
        scripted.thaw()
        restart(scripted)
        scripted.watcher.wait_for(None, "SUCCEEDED")  # the client speaks again
        for program in programs:
            program.terminate()
        with_talk, without = (float(program.communicate(timeout=30)[0]) for program in programs)
        assert [program.returncode for program in programs] == [0, 0]
        assert_within(with_talk, without + 0.02, "the longest callback of a loop with talk")
    scripted.unfinished = True
