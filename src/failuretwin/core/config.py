"""TOML tables as frozen dataclasses: a wrong key, type or number is an error."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import textwrap
import tomllib
import types
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from failuretwin.core.errors import InputError, reason, unknown_name
from failuretwin.core.foreign import read_text

T = TypeVar("T")
SHOWN = 200
"""Longest part of a wrong value in an error text [characters]."""


@dataclass(frozen=True)
class Bounds:
    """Closed interval of a number, or of every number of a tuple; NaN lies outside.

    With `in_order` the value is a pair: lowest, highest.
    """

    low: float = 0.0
    high: float = 1e6
    in_order: bool = False

    def check(self, name: str, value: float | tuple[float, ...]) -> None:
        """Raise InputError unless `value` lies within."""
        values = value if isinstance(value, tuple) else (value,)
        outside = [number for number in values if not self.low <= number <= self.high]
        span = f"from {self.low:g} to {self.high:g}"
        if self.in_order and (outside or values[0] > values[1]):
            raise InputError(
                f"{name} is [{values[0]:g}, {values[1]:g}], expected the lowest and the highest "
                f"value, in order, {span}."
            )
        if outside:
            raise InputError(f"{name} is {outside[0]:g}, expected a number {span}.")


Share = Annotated[float, Bounds(0.0, 1.0)]
AtLeastZero = Annotated[float, Bounds()]


class Bounded:
    """Base of dataclasses whose fields are checked against their `Bounds` annotations."""

    def __post_init__(self) -> None:
        for name, bounds in _bounds_of(type(self)):  # type: ignore[arg-type]
            bounds.check(name, getattr(self, name))


@cache
def _bounds_of(cls: type) -> list[tuple[str, Bounds]]:
    hints = get_type_hints(cls, include_extras=True)
    marks = [(name, mark) for name, hint in hints.items() for mark in get_args(hint)[1:]]
    return [(name, mark) for name, mark in marks if isinstance(mark, Bounds)]


def read_toml(path: Path) -> dict[str, Any]:
    """Return the table in a TOML file."""
    text = read_text(path, "text", "Expected a TOML file.")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not a TOML file: {error}.") from error
    except (ValueError, RecursionError) as error:  # a number of 5000 digits, lists in lists
        raise InputError(f"{path}: not a TOML file: {reason(error)}.") from error


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Return a table of TOML or JSON as the dataclass `cls`, keys and types checked recursively.

    Args:
        cls: A dataclass; fields may be numbers, text, booleans, tuples, dictionaries of text to
            numbers, dataclasses, tuples of dataclasses, or any of these or None.
        table: Keys and values as read from the file.
        where: Name of the file and table for error texts.
    """
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    for key in table:
        if key not in fields:
            raise InputError(f"{where}: {unknown_name('key', key, fields)}")
    hints = get_type_hints(cls)
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _convert(hints[name], table[name], f"{where}: {name}")
        elif _required(field):
            raise InputError(f"{where}: key {name!r} is missing. Add it.")
    try:
        return cls(**values)
    except InputError as error:
        includes_place = str(error).startswith(where)
        raise InputError(f"{error}" if includes_place else f"{where}: {error}") from error


def _required(field: dataclasses.Field[Any]) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        inner = next(a for a in args if a is not type(None))
        return None if value is None else _convert(inner, value, where)
    if origin is tuple:
        return _convert_tuple(args, value, where)
    table = origin in (dict, Mapping)
    if (dataclasses.is_dataclass(hint) or table) and not isinstance(value, dict):
        raise _wrong(where, value, "a table")
    if dataclasses.is_dataclass(hint):
        return from_table(hint, value, where)  # type: ignore[arg-type]
    if table:
        return {key: _convert(args[1], item, f"{where}.{key}") for key, item in value.items()}
    return _convert_plain(hint, value, where)


def _convert_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _wrong(where, value, "a list")
    if args[-1] is Ellipsis:
        return tuple(_convert(args[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if len(value) != len(args):
        raise _wrong(where, value, f"{len(args)} values")
    return tuple(_convert(a, v, where) for a, v in zip(args, value, strict=True))


def _convert_plain(hint: Any, value: Any, where: str) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and is_number:
        try:
            return float(value)
        except OverflowError:
            raise InputError(f"{where} is a whole number of more than 300 digits.") from None
    if hint in (str, bool, int) and type(value) is hint:
        return value
    names = {float: "a number", str: "text", bool: "true or false", int: "a whole number"}
    raise _wrong(where, value, names[hint])


def _wrong(where: str, value: Any, expected: str) -> InputError:
    return InputError(f"{where} is {textwrap.shorten(repr(value), SHOWN)}, expected {expected}.")


# Values as canonical JSON: equal values give equal text, whatever process writes it.

PLAIN = (str, bool, int, float, type(None))


def canonical(value: Any) -> Any:
    """Return `value` in JSON types; dataclasses carry the name of their type.

    Args:
        value: Plain values, arrays, mappings with text keys, sequences and dataclasses, nested to
            any depth. Paths become None: the place of a file says nothing about its contents.

    Raises:
        TypeError: If a value has any other type.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: canonical(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, PLAIN):
        return value
    if isinstance(value, Path):
        return None
    if isinstance(value, np.ndarray | np.generic):
        return canonical(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): canonical(item) for key, item in value.items()}
    if isinstance(value, tuple | list | range):
        return [canonical(item) for item in value]
    raise TypeError(f"no canonical form of {value!r}: make {type(value).__name__} a dataclass.")


def fingerprint(value: Any) -> str:
    """Return the SHA-256 of the canonical JSON of `value`, 64 hexadecimal digits."""
    text = json.dumps(canonical(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
