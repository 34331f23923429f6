"""`talk bridge` as a process: one bridge in one event loop, until a signal ends it."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING

from talkcli.daemon import log
from talkcli.errors import EXIT_OK
from talkcli.fleet.bridge.main import Bridge

if TYPE_CHECKING:
    from collections.abc import Callable

    from talkcli.fleet.bridge.main import Settings
    from talkcli.fleet.broker import Broker


def bridge(settings: Settings, reread: Callable[[], Broker]) -> int:
    """Be the robot on the broker until SIGTERM or SIGINT, and return the exit code.

    `reread` returns the broker as it is to be connected to from now on: a password may be another. UsageError where
    what TLS needs can't be read; AddressInUse where an older bridge of this name is there.
    """
    asyncio.run(_run(settings, reread))
    return EXIT_OK


async def _run(settings: Settings, reread: Callable[[], Broker]) -> None:
    loop, one = asyncio.get_running_loop(), Bridge(settings, reread)

    def on_signal(number: signal.Signals) -> None:
        log.line(f"{number.name}: ending")
        one.end()

    loop.set_exception_handler(log.loop_bug)
    # A shell without job control starts what is in the background with SIGINT ignored: so it stays.
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        loop.add_signal_handler(signal.SIGINT, on_signal, signal.SIGINT)
    loop.add_signal_handler(signal.SIGTERM, on_signal, signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that goes away doesn't take the robot along
    await one.run()
