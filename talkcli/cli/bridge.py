"""`talk bridge`: it runs the bridge, or prints what a machine or a broker needs for one. It alone imports that."""

from __future__ import annotations

from typing import TYPE_CHECKING

from talkcli.cli import units
from talkcli.cli.command import nearest
from talkcli.cli.show import show
from talkcli.errors import UsageError
from talkcli.fleet import topics
from talkcli.fleet.bridge.policy import ASKABLE
from talkcli.terminal.text import printable

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from talkcli.cli.show import CommonOptions


def bridge(options: CommonOptions, print_unit: str | None, print_acl: bool, **given: Any) -> int:
    """Run the bridge, or print a unit that would, or the broker's rules; return the exit code."""
    _check_names("--name", [] if given["name"] is None else [given["name"]])
    if print_acl:
        show(topics.access(homeassistant=given["homeassistant"], name=given["name"]))
        return 0
    groups = _listed(given["group"])
    _check_names("--group", groups)
    allow = _listed(given["allow"])
    for each in allow:
        if each not in ASKABLE:
            near = nearest(each, ASKABLE)
            hint = f"did you mean '{near}'?" if near else f"there are {', '.join(ASKABLE)}"
            raise UsageError(f"--allow: no request is called '{printable(each)}': {hint}")
    if print_unit:
        units.print_bridge_unit(options, print_unit, given)
        return 0
    found = options.broker()
    from talkcli.fleet.bridge.main import Settings
    from talkcli.fleet.bridge.run import bridge

    settings = Settings(
        given["name"],
        found,
        tuple(allow),
        tuple(groups),
        options.socket,
        with_text=not given["no_text"],
        homeassistant=given["homeassistant"],
    )
    return bridge(settings, options.broker)


def _listed(value: str | None) -> list[str]:
    """Return the words of a list with commas."""
    return [] if value is None else [each.strip() for each in value.split(",")]


def _check_names(option: str, names: Sequence[str]) -> None:
    for each in names:
        fault = topics.fault(each)
        if fault:
            raise UsageError(f"{option}: the name '{printable(each)}' can't be in a topic, it {fault}")
