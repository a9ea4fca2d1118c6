"""JSON to frozen dataclasses: every value has exactly the type that its field says, or one line names the place."""

import types
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints


def from_json(kind: Any, value: Any, *, place: str = "") -> Any:
    """Build `kind` (a dataclass, or a container of plain values) from what JSON gave.

    Whole numbers do as floats, lists as tuples; nothing else is converted. Fields with defaults may be absent.

    Raises:
        ValueError: a value is of another type, a key is missing or unknown; names the place, as in `views[3].frame`.
    """
    return _convert(kind, value, place)


def _convert(kind: Any, value: Any, place: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        return _dataclass(kind, value, place)
    if origin in (Union, types.UnionType):
        return _either(inner, value, place)
    if origin is Literal:
        return _require(value in inner and isinstance(value, str), value, kind, place)
    if origin is tuple:
        return _tuple(inner, value, place)
    if origin is dict:
        _require(isinstance(value, dict), value, "an object", place)
        if inner[1] is str and all(type(each) is str for each in value.values()):  # A manifest's million hashes.
            return dict(value)
        return {str(key): _convert(inner[1], each, _below(place, str(key))) for key, each in value.items()}
    if kind is Any:
        return value
    if kind is float and type(value) is int and abs(value) < 2**53:
        return float(value)
    return _require(type(value) is kind, value, kind, place)


def _dataclass(kind: Any, value: Any, place: str) -> Any:
    _require(isinstance(value, dict), value, f"an object with {', '.join(f.name for f in fields(kind))}", place)
    known = {field.name: field for field in fields(kind)}
    if unknown := sorted(set(value) - set(known)):
        raise ValueError(f"{place or 'here'}: unknown key {unknown[0]!r:.60}, expected some of {', '.join(known)}")
    hints = get_type_hints(kind)
    given = {}
    for name, field in known.items():
        if name in value:
            given[name] = _convert(hints[name], value[name], _below(place, name))
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{place or 'here'}: the key {name!r} is missing")
    return kind(**given)


def _either(kinds: tuple[Any, ...], value: Any, place: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    (kind,) = (kind for kind in kinds if kind is not type(None))
    return _convert(kind, value, place)


def _tuple(kinds: tuple[Any, ...], value: Any, place: str) -> Any:
    _require(isinstance(value, list), value, "a list", place)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    _require(len(kinds) == len(value), value, f"a list of {len(kinds)}", place)
    return tuple(_convert(kind, each, f"{place}[{k}]") for k, (kind, each) in enumerate(zip(kinds, value, strict=True)))


def _require(holds: bool, value: Any, expected: Any, place: str) -> Any:
    if not holds:
        name = getattr(expected, "__name__", str(expected))
        raise ValueError(f"{place or 'here'}: expected {name}, got {value!r:.60}")
    return value


def _below(place: str, name: str) -> str:
    return f"{place}.{name:.60}" if place else name[:60]
