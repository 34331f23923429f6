"""The command `talk fleet`, which shows the robots of a fleet."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from talkcli import paths
from talkcli.cli.show import note, screen, show_result
from talkcli.client.connect import ANSWER_LIMIT_S
from talkcli.errors import EXIT_SIGPIPE, ServerUnavailable
from talkcli.fleet.desk.request import Selection
from talkcli.fleet.desk.table import FleetTranscript, format_robots
from talkcli.fleet.payloads import Presence, RobotInfo
from talkcli.polling import run_blocking

if TYPE_CHECKING:
    from talkcli.cli.show import CommonOptions
    from talkcli.fleet.broker import Broker
    from talkcli.fleet.desk.watch import FleetEvent
    from talkcli.goals.goal import JsonObject
    from talkcli.terminal.text import Screen


def fleet(options: CommonOptions, action: str, long: bool) -> int | None:
    """Show the robots of a fleet, or watch their events.

    Return the exit code, or None for success.
    """
    broker = options.broker()
    text = paths.named_robot(options.robot, options.socket)
    selection = None if text is None else Selection(text)
    if action == "watch":
        return _watch(options, broker, selection, long=long)
    from talkcli.fleet.desk.watch import read_robots

    found = run_blocking(read_robots(broker, ANSWER_LIMIT_S, selection.name if selection else None))
    selected = [each for each in found if selection is None or selection.includes(each.presence)]
    if not selected:
        raise _no_robot_error(broker, selection)
    output = screen(long=long)
    show_result(options, [each.to_json() for each in selected], lambda: format_robots(selected, output, time.time()))
    return None


def _no_robot_error(broker: Broker, selection: Selection | None) -> ServerUnavailable:
    """Return the error to raise if no robot matches the selection."""
    if selection is None:
        return ServerUnavailable(
            f"no robot has connected to {broker.url} yet; start on each robot: talk bridge --name NAME"
        )
    if selection.group is not None:
        words = f"the group '{selection.group}' has no robots at {broker.url}"
        return ServerUnavailable(f"{words}; add robots to it with 'talk bridge --group {selection.group}'")
    words = f"no robot at {broker.url} matches '{selection.text}'"
    return ServerUnavailable(f"{words}; list all robots with: talk fleet status")


def _watch(options: CommonOptions, broker: Broker, selection: Selection | None, *, long: bool) -> int:
    """Show the events of the selected robots until interrupted. Return the exit code."""
    from talkcli.cli.interrupts import Interrupts, has_reader
    from talkcli.fleet.desk.watch import FleetWatch

    if not has_reader():
        return EXIT_SIGPIPE
    transcript = FleetTranscript(full=screen().width is None)
    # Watch the output, too. Otherwise, a closed pipe would only be noticed at the next event.
    with Interrupts(output=True) as interrupts:
        for event in FleetWatch(broker, selection).events(interrupts.watched):
            _show_event(options, broker, transcript, event, screen(long=long))
    return interrupts.exit_code


def _show_event(
    options: CommonOptions, broker: Broker, transcript: FleetTranscript, event: FleetEvent, screen: Screen
) -> None:
    """Print an event of the fleet.

    Messages about a lost or recovered broker go to standard error.
    """
    from talkcli.fleet.desk.watch import BrokerAway, EventsMissed, FleetSnapshot, RobotChanged, RobotEvent

    now = time.time()
    if isinstance(event, FleetSnapshot):
        robots = [each.presence for each in event.robots]
        objects = (_snapshot_object(each) for each in event.robots)
        show_result(options, objects, lambda: transcript.begin(robots, broker.url, screen, now))
    elif isinstance(event, RobotChanged):
        message: JsonObject = {"robot": event.name, "event": "presence", "presence": event.now and event.now.to_json()}
        robot = event.now or Presence(event.name, online=False)
        show_result(options, [message], lambda: transcript.change_lines(event.before, robot, screen, now))
    elif isinstance(event, RobotEvent):
        message = {"robot": event.name, **event.message}
        show_result(options, [message], lambda: transcript.lines(event.name, event.event, screen, now))
    elif isinstance(event, EventsMissed):
        name = event.robot.presence.name
        lines = (line for each in event.events for line in transcript.lines(name, each, screen, now))
        show_result(options, [_snapshot_object(event.robot)], lambda: lines)
    elif not options.quiet:
        if isinstance(event, BrokerAway):
            note(f"{event.why}; reconnecting for up to {event.limit:g} s")
        else:
            note(f"the broker at {broker.url} is back after {event.after:.1f} s")


def _snapshot_object(robot: RobotInfo) -> JsonObject:
    """Return the JSON object for a robot's whole state."""
    return {"robot": robot.presence.name, "event": "snapshot", **robot.to_json()}
