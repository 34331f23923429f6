"""A fast replacement for `@dataclass(frozen=True, slots=True)`.

`dataclasses` imports `inspect`, the tokenizer and the disassembler, and it compiles six functions for every class. That
would take a third of the 30 ms that a command runs. An engine would lose as much time at each restart after a crash. A
class made by `frozen` costs almost nothing until its first instance.

Code that only the server runs may use `dataclasses` for features that are missing here: fields that can change,
inheritance, ordering and default factories. Type checkers treat `frozen` like a dataclass decorator.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, TypeVar

    from typing_extensions import dataclass_transform

    _T = TypeVar("_T")
else:

    def dataclass_transform(**_):
        """Stand in for the real decorator, which only type checkers need."""
        return lambda decorator: decorator


#: Number of instances after which a class's `__init__` is compiled. With fewer instances, compiling would cost more
#: time than it saves.
_COMPILE_AFTER_COUNT = 150


@dataclass_transform(frozen_default=True)
def frozen(cls: type[_T]) -> type[_T]:
    """Return an immutable version of a class, like `@dataclass(frozen=True, slots=True)`."""
    # Annotations are strings, because every module has `from __future__ import annotations`.
    names = tuple(name for name, kind in cls.__annotations__.items() if not kind.startswith("ClassVar"))
    own = {name: each for name, each in cls.__dict__.items() if name not in {*names, "__dict__", "__weakref__"}}
    defaults = {name: cls.__dict__[name] for name in names if name in cls.__dict__}
    made = {
        "__slots__": names,
        "__match_args__": names,
        "_defaults": defaults,
        "_instance_count": 0,
        "__qualname__": cls.__qualname__,
    }
    meta: Any = type(cls)
    slotted: type[_T] = meta(cls.__name__, cls.__bases__, {**_METHODS, **own, **made})
    return slotted


def fields(instance: object) -> dict[str, Any]:
    """Return the fields of an instance as a dictionary."""
    return {name: getattr(instance, name) for name in instance.__match_args__}  # type: ignore[attr-defined]


def replace(instance: _T, **changes: Any) -> _T:
    """Return a copy of an instance with some fields changed. An unknown field raises TypeError."""
    return type(instance)(**{**fields(instance), **changes})


class _Methods:
    """The methods that `frozen` adds to a class."""

    def __init__(self, *arguments: object, **named: object) -> None:
        """Set the fields of an instance."""
        cls: Any = type(self)
        names = cls.__match_args__
        given = dict(zip(names, arguments, strict=False))
        values = {**cls._defaults, **given, **named}
        cls._instance_count += 1
        # The arguments are valid if they set each field exactly once.
        invalid = values.keys() != set(names) or len(given) != len(arguments) or not named.keys().isdisjoint(given)
        if invalid or cls._instance_count > _COMPILE_AFTER_COUNT:
            cls.__init__ = _compile_init(cls)
            cls.__init__(self, *arguments, **named)  # raises the usual TypeError if the arguments are invalid
            return
        put = object.__setattr__
        for name, value in values.items():
            put(self, name, value)

    def __setattr__(self, name: str, *_: object) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable: {name} can't be changed")

    __delattr__ = __setattr__

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and fields(other) == fields(self)

    def __hash__(self) -> int:
        return hash((type(self), *fields(self).values()))

    def __reduce__(self) -> tuple[object, ...]:
        """Make `copy` and `pickle` call the class instead of setting fields."""
        return type(self), tuple(fields(self).values())

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}={each!r}" for name, each in fields(self).items())
        return f"{type(self).__qualname__}({shown})"


_METHODS = {name: each for name, each in vars(_Methods).items() if callable(each)}


def _compile_init(cls: Any) -> Any:
    """Compile a fast `__init__` for a class. Return the function.

    It is five times as fast as the generic one.
    """
    takes = [f"{each}=_defaults[{each!r}]" if each in cls._defaults else each for each in cls.__match_args__]
    # `__setattr__` always raises an error, so the compiled function calls the slots' setters directly.
    sets = [f"    _{each}_(self, {each})" for each in cls.__match_args__] or ["    pass"]
    setters = {f"_{each}_": getattr(cls, each).__set__ for each in cls.__match_args__}
    namespace: dict[str, Any] = {**setters, "_defaults": cls._defaults}
    exec("\n".join([f"def __init__({', '.join(['self', *takes])}):", *sets]), namespace)
    return namespace["__init__"]
