"""`talk fleet status`: all robots of a broker at one look. It alone of the commands imports what that takes."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.show import screen, show_found
from talkcli.client.connect import ANSWER_LIMIT
from talkcli.errors import ServerUnavailable
from talkcli.fleet.selection import Selection, several
from talkcli.frozen import replace
from talkcli.terminal.fleet import Robot, robot_lines

if TYPE_CHECKING:
    from talkcli.cli.show import Common
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.roster import Standing


def fleet(options: Common, what: str) -> int | None:
    """Show the robots of a fleet, as they stand or as it happens; return the exit code, None for 0."""
    broker = options.broker()
    text = paths.named_robot(options.robot, options.socket)
    selection = None if text is None else Selection(text)
    return {"status": _status}[what](options, broker, selection)


def _status(options: Common, broker: Broker, selection: Selection | None) -> None:
    """Show how each robot stands."""
    from talkcli.fleet.roster import standings

    single = selection is not None and not several(selection.text)
    found = standings(broker, ANSWER_LIMIT, *([selection.text] if selection and single else []))
    picked = [each for _, each in sorted(found.items()) if selection is None or selection.picks(each.presence)]
    if not picked:
        raise _nobody(broker, selection)

    show_found(
        options,
        (each.to_json() for each in picked),
        lambda: robot_lines([_shown(each) for each in picked], screen(), time.time()),
    )


def _shown(standing: Standing) -> Robot:
    """Return a robot as the table shows it."""
    presence, status = standing.presence, standing.status
    server = None if presence.server is None else str(presence.server.get("version") or "?")
    there = Robot(presence.name, presence.online, server, since=presence.since)
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
