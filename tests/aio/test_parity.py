"""The asyncio library and the blocking library have the same names, parameters, defaults and errors."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import pytest

import talkcli
from talkcli import aio
from talkcli.errors import BadOption, UnknownGoal, UsageError
from tests.support.loop import in_loop
from tests.support.surroundings import needs_packages

if TYPE_CHECKING:
    from types import ModuleType

    from tests.support.processes import Talk

#: For each class, its public names by what the asyncio library makes of the blocking library's method. An awaited
#: method is a coroutine function. An iterated method returns an asynchronous iterator, and an entered one returns an
#: asynchronous context manager. The same method never waits.
TABLE = {
    "Client": {
        "awaited": "say dry_run play follow cancel status goal log voices sounds settings set pause resume close",
        "iterated": "events",
        "entered": "stream saying paused",
        "same": "path server_pid",
        "only asyncio": "connect",
        "only blocking": "over",
    },
    "GoalHandle": {"awaited": "wait cancel", "iterated": "events feedback", "same": "id state poll request_cancel"},
    "SpeechStream": {"awaited": "write wait", "same": "goal"},
    "Fleet": {
        "awaited": "robots",
        "entered": "robot",
        "iterated": "say cancel wait status pause resume set",
    },
}
ROWS = [
    (name, kind, method) for name, kinds in TABLE.items() for kind, some in kinds.items() for method in some.split()
]
#: Calls that fail in both libraries, for each way in which a method makes its request: the error and its message.
ERRORS: list[tuple[str, dict[str, Any], type[Exception], str]] = [
    ("say", {"text": "a", "loud": True}, TypeError, "loud"),
    ("play", {"text": "chirp", "rate": 200}, UsageError, "a sound can't have the option rate"),
    ("stream", {"throttle": 5}, UsageError, "by its key"),
    ("follow", {"ids": ["nobody"]}, UnknownGoal, "nobody"),
    ("set", {"voice": "parrot"}, BadOption, "parrot"),
]


def public(module: ModuleType, name: str) -> set[str]:
    needs_packages("paho")
    kind = getattr(module, name)
    return {each for each in {*dir(kind), *inspect.get_annotations(kind)} if not each.startswith("_")}


@pytest.mark.parametrize("name", TABLE)
def test_the_table_has_all_public_names(name: str) -> None:
    names = {kind: set(some.split()) for kind, some in TABLE[name].items()}
    alone = {library: names.pop(f"only {library}", set()) for library in ("asyncio", "blocking")}
    common = set().union(*names.values())
    assert public(aio, name) == common | alone["asyncio"]
    assert public(talkcli, name) == common | alone["blocking"]
    assert name in aio.__all__


@pytest.mark.parametrize(("name", "kind", "method"), [row for row in ROWS if not row[1].startswith("only")])
def test_a_method_has_the_parameters_and_defaults_of_the_blocking_one(name: str, kind: str, method: str) -> None:
    blocking, own = (inspect.getattr_static(getattr(each, name), method, None) for each in (talkcli, aio))
    assert inspect.iscoroutinefunction(own) == (kind == "awaited")
    if kind == "same" and name == "Client":
        blocking, own = blocking.fget, own.fget
    if callable(own):
        # Some blocking methods get their parameters from `say` by a decorator for type checkers.
        model = talkcli.Client.say if method in {"saying", "play"} else blocking
        assert inspect.signature(own).parameters == inspect.signature(model).parameters


@pytest.mark.parametrize("name", ["Client", "Fleet"])
def test_the_constructors_have_the_same_parameters(name: str) -> None:
    assert inspect.signature(getattr(aio, name)) == inspect.signature(getattr(talkcli, name))


@in_loop
async def test_a_call_fails_with_the_error_of_the_blocking_one(scripted: Talk) -> None:
    async def call(own: aio.Client, method: str, arguments: dict[str, Any]) -> None:
        result = getattr(own, method)(**arguments)
        if inspect.isawaitable(result):
            await result

    with talkcli.Client(scripted.socket) as talk:
        async with aio.Client(scripted.socket) as own:
            for method, arguments, error, words in ERRORS:
                with pytest.raises(error, match=words) as blocking:
                    getattr(talk, method)(**arguments)
                with pytest.raises(error, match=words) as caught:
                    await call(own, method, arguments)
                assert error is TypeError or repr(caught.value) == repr(blocking.value)
