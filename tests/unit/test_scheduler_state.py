"""Only `talkcli.goals` changes the scheduler's state. The source of all other packages is checked for this."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import talkcli
from talkcli.goals.memory import RecentGoals
from talkcli.goals.queue import Queue
from talkcli.goals.record import Record
from talkcli.goals.scheduler import Scheduler
from talkcli.goals.voices import NeuralVoice, VoiceScheduler

PACKAGE = Path(talkcli.__file__).parent
#: Attributes of the scheduler, of its records and of its other objects.
STATE = {
    *(name for cls in (Record, NeuralVoice) for name in cls.__slots__),
    *(
        name
        for part in (Scheduler("4k7f", max_queue=1), RecentGoals(), Queue(), VoiceScheduler())
        for name in vars(part)
    ),
}
#: Objects of the scheduler that other packages may read, with the methods that they may call.
READ = {"recent": {"find", "latest", "log"}, "pending": {"first"}, "voices": {"failure", "to_json"}}


def writes(source: str) -> list[str]:
    """Return the places in a module's source that write to the scheduler's state."""
    written = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
            base = ast.unparse(node.value)
            own = base in {"self", "cls"}
            if "scheduler" in base or (not own and node.attr in STATE):
                written.append(ast.unparse(node))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            part = node.func.value
            inner = isinstance(part, ast.Attribute) and "scheduler" in ast.unparse(part.value)
            if inner and isinstance(part, ast.Attribute) and node.func.attr not in READ.get(part.attr, set()):
                written.append(ast.unparse(node.func))
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in {"setattr", "object.__setattr__"}:
            written.append(ast.unparse(node))
    return written


def users() -> list[Path]:
    """Return the modules that can access a scheduler or a record."""
    return sorted((PACKAGE / "server").glob("*.py"))


def test_only_the_server_imports_the_scheduler() -> None:
    """This ensures that the test below checks all modules that could change the state."""
    names = ("goals.scheduler", "goals.record", "goals.queue", "goals.memory", "goals.voices")
    for path in PACKAGE.rglob("*.py"):
        if path.parent.name not in {"goals", "server"}:
            source = path.read_text("utf-8")
            assert not any(f"talkcli.{name} import" in source for name in names), path


@pytest.mark.parametrize("path", users(), ids=lambda path: path.name)
def test_no_module_outside_goals_writes_to_the_schedulers_state(path: Path) -> None:
    assert writes(path.read_text("utf-8")) == []


@pytest.mark.parametrize(
    "line",
    [
        "self._scheduler.settings = replace(self._scheduler.settings, ttl=1)",
        "scheduler.active.paused = True",
        "record.reason = None",
        "del self.speech.scheduler.active",
        "active.spoken_end += 1",
        "speech.scheduler.voices.request('piper/joe', now)",
        "self._scheduler.pending.remove(record)",
        "scheduler.recent.add(record)",
        "setattr(record, 'state', state)",
    ],
)
def test_a_write_is_detected(line: str) -> None:
    assert writes(line)
