"""`talk fleet`: all robots of a broker, at one look or as it happens; what that takes is imported for it alone."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.show import note, screen, show_result
from talkcli.client.connect import ANSWER_LIMIT
from talkcli.errors import EXIT_SIGPIPE, ServerUnavailable
from talkcli.fleet.desk.selection import Selection
from talkcli.fleet.desk.sighting import Away, Back, Begun, Changed, Happened, Missed
from talkcli.frozen import replace
from talkcli.terminal.fleet import FleetTranscript, Robot, robot_lines

if TYPE_CHECKING:
    from collections.abc import Iterator

    from talkcli.cli.show import CommonOptions
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.sighting import Sighting
    from talkcli.fleet.presence import Presence
    from talkcli.fleet.status import Standing
    from talkcli.goals.goal import JsonObject


def fleet(options: CommonOptions, what: str) -> int | None:
    """Show the robots of a fleet, as they stand or as it happens; return the exit code, None for 0."""
    broker = options.broker()
    text = paths.named_robot(options.robot, options.socket)
    selection = None if text is None else Selection(text)
    if what == "watch":
        return _watch(options, broker, selection)
    _status(options, broker, selection)
    return None


def _status(options: CommonOptions, broker: Broker, selection: Selection | None) -> None:
    """Show how each robot stands."""
    from talkcli.fleet.desk.roster import standings

    found = standings(broker, ANSWER_LIMIT, selection.only if selection else None)
    picked = [each for _, each in sorted(found.items()) if selection is None or selection.picks(each.presence)]
    if not picked:
        raise _nobody(broker, selection)

    show_result(
        options,
        (each.to_json() for each in picked),
        lambda: robot_lines([_shown(each) for each in picked], screen(), time.time()),
    )


def _watch(options: CommonOptions, broker: Broker, selection: Selection | None) -> int:
    """Show what happens, and which robots come and go; return the exit code."""
    from talkcli.cli.interrupts import Interrupts, has_reader
    from talkcli.fleet.desk.lookout import Lookout

    if not has_reader():
        return EXIT_SIGPIPE
    teller = _Teller(options, broker, FleetTranscript(full=screen().width is None))
    # The reader of its output, too, ends it: the next event may be far.
    with Interrupts(output=True) as interrupts:
        for seen in Lookout(broker, selection).follow(interrupts.watched):
            teller.tell(seen)
    return interrupts.exit_code


class _Teller:
    """Shows what happens to a fleet, for people or for programs."""

    def __init__(self, options: CommonOptions, broker: Broker, transcript: FleetTranscript) -> None:
        self._options, self._broker, self._transcript = options, broker, transcript

    def tell(self, seen: Sighting) -> None:
        """Show what has happened; what the broker itself does is said on standard error."""
        if not isinstance(seen, Away | Back):
            show_result(self._options, _objects(seen), lambda: self._lines(seen))
        elif self._options.quiet:
            return
        elif isinstance(seen, Away):
            note(f"{seen.why}; it is tried again for {seen.limit:g} s")
        else:
            note(f"the broker at {self._broker.url} is back, after {seen.after:.1f} s")

    def _lines(self, seen: Begun | Changed | Happened | Missed) -> list[str]:
        transcript, now = self._transcript, time.time()
        if isinstance(seen, Begun):
            robots = [_shown(each) for each in seen.standings]
            return transcript.begin(robots, self._broker.url, screen(), now)
        if isinstance(seen, Changed):
            robot = Robot(seen.name, online=False) if seen.now is None else _there(seen.now)
            same = seen.before is not None and seen.now is not None and seen.before.session == seen.now.session
            return transcript.change(_there(seen.before) if seen.before and same else None, robot, screen(), now)
        if isinstance(seen, Happened):
            return transcript.lines(seen.name, seen.event, screen(), now)
        name = seen.standing.presence.name
        return [line for each in seen.events for line in transcript.lines(name, each, screen(), now)]


def _objects(seen: Begun | Changed | Happened | Missed) -> Iterator[JsonObject]:
    """Make the objects that programs are shown."""
    if isinstance(seen, Begun | Missed):
        for each in seen.standings if isinstance(seen, Begun) else [seen.standing]:
            yield {"robot": each.presence.name, "event": "snapshot", **each.to_json()}
    elif isinstance(seen, Changed):
        presence = None if seen.now is None else seen.now.to_json()
        yield {"robot": seen.name, "event": "presence", "presence": presence}
    else:
        yield {"robot": seen.name, **seen.message}


def _there(presence: Presence) -> Robot:
    """Return a robot as it is shown, of whose goals nothing is known."""
    server = None if presence.server is None else str(presence.server.get("version") or "?")
    return Robot(presence.name, presence.online, server, since=presence.since)


def _shown(standing: Standing) -> Robot:
    """Return a robot as the table shows it."""
    there, status = _there(standing.presence), standing.status
    if status is None:
        return there
    last = status.last
    return replace(
        there,
        active=status.active,
        text=status.text,
        pending=status.pending,
        paused=status.paused,
        last=None if last is None else last.state,
        last_at=None if last is None else last.at,
    )


def _nobody(broker: Broker, selection: Selection | None) -> ServerUnavailable:
    """Return the error that says that no robot is meant."""
    if selection is None:
        return ServerUnavailable(f"no robot is known at {broker.url}; on each robot: talk bridge --name NAME")
    if selection.group is not None:
        words = f"no robot of the group '{selection.group}' is known at {broker.url}"
        return ServerUnavailable(f"{words}; on a robot of it: talk bridge --group {selection.group}")
    return ServerUnavailable(f"no robot '{selection.text}' is known at {broker.url}: 'talk fleet status' lists all")
