"""`frozen` classes behave like frozen, slotted dataclasses, but are cheap to define until a value is created."""

from __future__ import annotations

import copy
import subprocess
import sys
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from talkcli.frozen import fields, frozen, replace


@frozen
class Point:
    """A place."""

    kind: ClassVar[str] = "point"
    x: int
    y: int = 2
    name: str | None = None

    @property
    def far(self) -> bool:
        return self.x > 100

    @classmethod
    def at(cls, x: int) -> Point:
        return cls(x)


@dataclass(frozen=True, slots=True)
class Model:
    x: int
    y: int = 2
    name: str | None = None


@frozen
class Nothing:
    pass


@pytest.mark.parametrize("args", [(1,), (1, 3), (1, 3, "a"), (1, 2, None)])
def test_a_value_is_created_like_a_dataclass(args: tuple[int, ...]) -> None:
    model, point = Model(*args), Point(*args)  # type: ignore[arg-type]
    assert (point.x, point.y, point.name) == (model.x, model.y, model.name)
    assert fields(point) == {"x": model.x, "y": model.y, "name": model.name}
    assert repr(point) == repr(model).replace("Model", "Point")
    assert point == Point(x=model.x, y=model.y, name=model.name)


INVALID: list[tuple[tuple[Any, ...], dict[str, Any]]] = [
    *(((), {}), ((), {"y": 1}), ((1, 2, "a", 4), {}), ((1,), {"x": 1}), ((1, 2), {"y": 2})),
    *(((1,), {"z": 1}), ((), {"z": 1}), ((1, 2, "a"), {"z": 1})),
]


@pytest.mark.parametrize("before", [0, 1_000], ids=["the first", "one of many"])
@pytest.mark.parametrize(("args", "kwargs"), INVALID)
def test_the_first_values_of_a_class_behave_like_later_ones(
    before: int, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> None:
    @frozen
    class Fresh:
        x: int
        y: int = 2
        name: str | None = None

    make: Any = Fresh
    for number in range(before):
        assert make(number) == make(x=number, y=2)
    for cls in (Model, make):
        with pytest.raises(TypeError, match=r"__init__.*argument"):
            cls(*args, **kwargs)
    assert fields(make(1, name="a")) == fields(make(x=1, name="a")) == {"x": 1, "y": 2, "name": "a"}


def test_a_value_has_its_class_attributes_and_no_dict() -> None:
    point = Point.at(200)
    assert (Point.__doc__, Point.__name__, Point.__module__) == ("A place.", "Point", __name__)
    assert (point.kind, point.far, isinstance(point, Point)) == ("point", True, True)
    assert not hasattr(point, "__dict__")
    match point:
        case Point(x, y):
            assert (x, y) == (200, 2)


def test_the_fields_of_a_value_cannot_be_changed() -> None:
    point = Point(1)
    with pytest.raises(AttributeError, match="x can't be changed"):
        point.x = 2  # type: ignore[misc]
    with pytest.raises(AttributeError):
        point.z = 2  # type: ignore[attr-defined]
    with pytest.raises(AttributeError):
        del point.x
    assert point.x == 1


def test_values_of_one_class_with_equal_fields_are_equal() -> None:
    assert Point(1) == Point(1) != Point(2)
    assert {Point(1), Point(1), Point(2)} == {Point(2), Point(1)}
    assert Point(1) != Model(1)  # type: ignore[comparison-overlap]
    assert Nothing() == Nothing()
    assert bool(Nothing())


def test_replace_returns_a_new_value() -> None:
    point = Point(1, name="a")
    assert replace(point, x=5) == Point(5, 2, "a")
    assert point == copy.copy(point) == copy.deepcopy(point) == Point(1, 2, "a")
    with pytest.raises(TypeError, match="z"):
        replace(point, z=1)


def test_the_module_imports_nothing() -> None:
    command = "import sys; before = set(sys.modules); import talkcli.frozen; print(sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-S", "-c", command], capture_output=True, text=True, check=True, cwd=".")
    assert done.stdout.strip() == "['__future__', 'talkcli', 'talkcli.frozen']"
