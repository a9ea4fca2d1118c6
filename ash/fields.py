"""Fields of nested frozen dataclasses by dotted keys, such as `model.texels`: read, changed, and checked by their type.

A scene, a preset and a user's configuration are varied in one way: a mapping of dotted keys to new values. The key
`train.0.yaw` is a field of the first element of a tuple.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from typing import Any, TypeVar, get_type_hints

from typeguard import TypeCheckError, check_type

from ash.files import InputError

Config = TypeVar("Config")
Changes = tuple[tuple[str, Any], ...]  # Dotted key and value, in order of the keys: what is changed in a configuration.
INFINITE = ("inf", "-inf")  # JSON has no number for them.
WRITTEN: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Leaf:
    """A field that holds no fields itself."""

    key: str  # dotted
    value: Any
    kind: Any  # its annotation
    owner: type  # the dataclass that has it
    name: str  # there


def leaves(config: Any, prefix: str = "") -> Iterator[Leaf]:
    """Every field of a dataclass, and of those within it."""
    for name, value in _parts(config):
        if _has_parts(value):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield Leaf(key=prefix + name, value=value, kind=_hint(config, name), owner=type(config), name=name)


def flat(config: Any) -> dict[str, Any]:
    """The values of all leaves by their keys."""
    return {leaf.key: leaf.value for leaf in leaves(config)}


def changed(before: Any, after: Any) -> Changes:
    """What to replace in `before` to get `after`, two dataclasses of the same type."""
    old = flat(before)
    return tuple((key, value) for key, value in sorted(flat(after).items()) if key not in old or old[key] != value)


def for_json(changes: Changes) -> dict[str, Any]:
    """Changes as a file or a hash takes them: an infinite number by its name, which `apply_overrides` reads."""
    return {key: str(value) if isinstance(value, float) and math.isinf(value) else value for key, value in changes}


def apply_overrides(config: Config, changes: Mapping[str, Any] | Changes, *, of: str) -> Config:
    """The dataclass with other values at dotted keys. A value that is a function is given the whole dataclass.

    All changes of one part come at once, so that fields that must agree are checked together.

    Raises:
        InputError: a key that is not there (the message has the nearest that are), a value of another type, or a value
            that the dataclass refuses. `of` says in the message whose fields these are.
    """
    nested: dict[str, Any] = {}
    for key, value in dict(changes).items():
        place = nested
        *path, last = key.split(".")
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise InputError(f"{of}: {key} and a part of it are both given")
        place[last] = value(config) if callable(value) else value
    return _replaced(config, nested, "", of, tuple(flat(config)))


def suggest(name: str, known: tuple[str, ...]) -> str:
    """The known names that a wrong one may have meant, all of them where none is near; for an error's end."""
    ends = [key for key in known if key.rpartition(".")[2] == name.rpartition(".")[2]]
    close = list(dict.fromkeys([*ends, *get_close_matches(name, known, n=3, cutoff=0.5)]))[:4]
    if close:
        return f"did you mean {' or '.join(close)}?"
    heads = dict.fromkeys(f"{key.partition('.')[0]}.*" if "." in key else key for key in known)
    return f"expected one of {', '.join(heads)}"


def _replaced(config: Any, changes: Mapping[str, Any], prefix: str, of: str, known: tuple[str, ...]) -> Any:
    parts = dict(_parts(config))
    values = {}
    for name, value in changes.items():
        key = f"{prefix}{name}"
        if name not in parts:
            raise InputError(f"{of}: unknown key {key!r}, {suggest(key, known)}")
        if isinstance(value, dict) and _has_parts(parts[name]):
            values[name] = _replaced(parts[name], value, f"{key}.", of, known)
        else:
            values[name] = _of_type(_hint(config, name), value, f"{of}: {key}")
    if isinstance(config, tuple):
        return tuple(values.get(str(index), value) for index, value in enumerate(config))
    return replace(config, **values)


def _parts(config: Any) -> list[tuple[str, Any]]:
    if isinstance(config, tuple):
        return [(str(index), value) for index, value in enumerate(config)]
    return [(field.name, getattr(config, field.name)) for field in fields(config) if field.init]


def _has_parts(value: Any) -> bool:
    """Whether a value's fields have keys of their own: a dataclass, or a tuple of them."""
    if isinstance(value, tuple):
        return bool(value) and all(_has_parts(inner) for inner in value)
    return is_dataclass(value)


def _hint(config: Any, name: str) -> Any:
    return type(config[int(name)]) if isinstance(config, tuple) else _hints(type(config))[name]


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _of_type(hint: Any, value: Any, where: str) -> Any:
    """The value, if it is what the annotation wants: a list stands for a tuple, a whole number for a real one."""
    value = float(value) if hint is float and value in INFINITE else _as_tuple(value)
    try:
        check_type(value, hint)
        if isinstance(value, bool) and hint in (int, float):
            raise TypeCheckError("is true or false")
    except TypeCheckError:
        raise InputError(f"{where}: expected {WRITTEN.get(hint, hint)}, got {value!r}") from None
    return float(value) if hint is float else value


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(inner) for inner in value) if isinstance(value, list | tuple) else value
