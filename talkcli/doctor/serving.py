"""The server, as it describes itself: version, engine, settings, and what has failed lately. Pure."""

from __future__ import annotations

import time

from talkcli import __version__
from talkcli.doctor.findings import Finding, done, failed, warning
from talkcli.doctor.sentence import remedy
from talkcli.frozen import TYPE_CHECKING
from talkcli.goals.options import told
from talkcli.goals.states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from talkcli.goals.goal import Goal, JsonObject

#: Volume below which a server's setting may be why nobody hears it.
_FAINT = 0.2


def gone(words: str) -> Finding:
    """Return what is to be said of a server that took this client and then did not answer."""
    return failed("server", words, "look at its log, and start it again: talk serve")


def judge(server: JsonObject, log: Sequence[Goal], now: float) -> list[Finding]:
    """Judge a server by its own description and by the goals that ended last, oldest first."""
    return [_itself(server), _settings(server), _failures(log, now, server)]


def _itself(server: JsonObject) -> Finding:
    version, engine = server.get("version"), server.get("engine")
    parts = [f"talk {version}", f"up {_span(server.get('uptime'))}", f"engine {engine}"]
    parts += [f"{name} {server[name]}" for name in ("synthesizer", "player", "device") if server.get(name)]
    parts.append(f"{server.get('pending')} waiting, {server.get('clients')} of {server.get('max_clients')} clients")
    words = "; ".join(parts)
    if server.get("paused") is True:
        return failed("server", f"speech is paused; {words}", "talk resume")
    if engine not in {"ready", "starting"}:
        return warning("server", words, remedy("engine_failed", words))
    if version != __version__:
        step = "start the server again, with the talk that is installed now"
        return warning("server", f"{words}; this is talk {__version__}", step)
    return done("server", words)


def _settings(server: JsonObject) -> Finding:
    volume = server.get("volume")
    lead_in = [f"lead-in {server['lead_in']} ms"] if server.get("lead_in") else []
    words = ", ".join([*told(server), *lead_in])
    if isinstance(volume, int | float) and volume < _FAINT:
        broken = failed if volume <= 0 else warning
        return broken("settings", words, "talk set --volume 1")
    return done("settings", words)


def _failures(log: Sequence[Goal], now: float, server: JsonObject) -> Finding:
    if not log:
        return done("failures", "none: this server has spoken nothing yet")
    aborted = [each for each in log if each.state is State.ABORTED]
    many = "the last goal" if len(log) == 1 else f"the last {len(log)} goals"
    if not aborted:
        return done("failures", f"none in {many}")
    last = aborted[-1]
    words = (last.message or "").removeprefix("Talk aborted: ")
    when = "" if last.ended_at is None else f", {_when(last.ended_at, now)}"
    who = f"{many} ABORTED, {last.id}" if len(log) == 1 else f"{len(aborted)} of {many} ABORTED, last {last.id}"
    told = f"{who}{when}: {last.reason}: {words}"
    after = [each for each in log[log.index(last) + 1 :] if each.state is State.SUCCEEDED]
    if after:
        return done("failures", f"{told}; {len(after)} succeeded since")
    return warning("failures", told, remedy(last.reason, words, server.get("player"), server.get("device")))


def _when(at: float, now: float) -> str:
    ago = f"{_span(now - at)} ago"
    return f"{ago} ({time.strftime('%H:%M:%S', time.localtime(at))})"


def _span(seconds: object) -> str:
    """Return a length of time for people, in its largest unit."""
    if not isinstance(seconds, int | float):
        return "?"
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"
