"""Frozen, slotted values: what `@dataclass(frozen=True, slots=True)` makes, without its cost at the start.

`dataclasses` imports `inspect`, and with it the tokenizer and the disassembler, and compiles six functions for each
class, used or not: a third of the start of a command that lives for thirty milliseconds, and as much of the start of an
engine process, for which somebody waits after a crash. A class of these costs next to nothing until the first value of
it is made. The server, which runs for months, may use `dataclasses` for what this leaves out: fields that can be
changed, inheritance, order, factories of defaults.

Type checkers take `frozen` for a dataclass decorator.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, TypeVar

    from typing_extensions import dataclass_transform

    _T = TypeVar("_T")
else:

    def dataclass_transform(**_):
        """Stand in for the one that tells type checkers what a decorator does: here it does nothing."""
        return lambda decorator: decorator


#: Values of a class that are made before an `__init__` of its own is worth what it takes to compile.
_FEW = 100


@dataclass_transform(frozen_default=True)
def frozen(cls: type[_T]) -> type[_T]:
    """Make a class of annotated fields, some with defaults, one of values: compared, hashed, shown by them."""
    # Annotations are strings, by the modules' `from __future__ import annotations`.
    names = tuple(name for name, kind in cls.__annotations__.items() if not kind.startswith("ClassVar"))
    own = {name: each for name, each in cls.__dict__.items() if name not in {*names, "__dict__", "__weakref__"}}
    defaults = {name: cls.__dict__[name] for name in names if name in cls.__dict__}
    made = {
        "__slots__": names,
        "__match_args__": names,
        "_defaults": defaults,
        "_made": 0,
        "_names": frozenset(names),
        "__qualname__": cls.__qualname__,
    }
    meta: Any = type(cls)
    slotted: type[_T] = meta(cls.__name__, cls.__bases__, {**_METHODS, **own, **made})
    return slotted


def fields(instance: object) -> dict[str, Any]:
    """Return the fields of a value, by their names."""
    return {name: getattr(instance, name) for name in instance.__match_args__}  # type: ignore[attr-defined]


def replace(instance: _T, **changes: Any) -> _T:
    """Return a value like this one but for these fields; TypeError for a field that it doesn't have."""
    return type(instance)(**{**fields(instance), **changes})


def _init_of_few(self: object, *arguments: object, **named: object) -> None:
    """Set the fields of one of the first values of a class, of which there may never be more."""
    cls: Any = type(self)
    names = cls.__match_args__
    given = dict(zip(names, arguments, strict=False))
    values = {**cls._defaults, **given, **named}
    cls._made += 1
    # As many as there are fields, none of them twice, and each of a name that a slot has.
    odd = len(values) != len(names) or len(given) != len(arguments) or not named.keys().isdisjoint(given)
    if odd or cls._made > _FEW or not values.keys() <= cls._names:
        cls.__init__ = _compiled(cls)
        cls.__init__(self, *arguments, **named)  # which also says what is odd about them
        return
    put = object.__setattr__
    for name, value in values.items():
        put(self, name, value)


def _compiled(cls: Any) -> Any:
    """Return an `__init__` that is five times as fast, and takes as long to make as a hundred values."""
    takes = [f"{each}=_defaults[{each!r}]" if each in cls._defaults else each for each in cls.__match_args__]
    # The slots' own setters go past `__setattr__`, which refuses.
    sets = [f"    _{each}_(self, {each})" for each in cls.__match_args__] or ["    pass"]
    setters = {f"_{each}_": getattr(cls, each).__set__ for each in cls.__match_args__}
    namespace: dict[str, Any] = {**setters, "_defaults": cls._defaults}
    exec("\n".join([f"def __init__({', '.join(['self', *takes])}):", *sets]), namespace)
    return namespace["__init__"]


def _refuse(self: object, name: str, *_: object) -> None:
    raise AttributeError(f"{type(self).__name__} is a value: its {name} can't be changed")


def _equal(self: object, other: object) -> bool:
    return type(other) is type(self) and fields(other) == fields(self)


def _hashed(self: object) -> int:
    return hash((type(self), *fields(self).values()))


def _reduced(self: object) -> tuple[object, ...]:
    """Say how a copy is made: by a call, for nothing can be set."""
    return type(self), tuple(fields(self).values())


def _shown(self: object) -> str:
    shown = ", ".join(f"{name}={each!r}" for name, each in fields(self).items())
    return f"{type(self).__qualname__}({shown})"


_METHODS: dict[str, object] = {
    "__init__": _init_of_few,
    "__setattr__": _refuse,
    "__delattr__": _refuse,
    "__eq__": _equal,
    "__hash__": _hashed,
    "__reduce__": _reduced,
    "__repr__": _shown,
}
