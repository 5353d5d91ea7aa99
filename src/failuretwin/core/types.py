"""Array types, and frozen dataclasses of arrays with named leading axes, such as runs.

`Axes` names the axes of a field and its empty value; a field without it is shared by all entries::

    @dataclass(frozen=True)
    class Movements(ArrayStruct):
        target: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]

Indexing, writing, dropping and saving apply to every array of a value and of the values in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

MS_PER_S = 1000.0


def frozen_array(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def as_floats(values: Any) -> FloatArray:
    """Return `values` as a float64 array, copied only if necessary."""
    return np.asarray(values, dtype=np.float64)


# Dataclasses of arrays.

ENTRY_AXES = ("run", "movement")
"""Axes of entries; where an array has them, they come first, in this order."""

Entries = Any
"""Index of runs, or a tuple of indices for runs and movements."""
Change = Callable[[np.ndarray, "Axes"], np.ndarray]


class Axes:
    """Axes of an array.

    Args:
        names: Their names; those of `ENTRY_AXES` first.
        empty: Value of entries without data; its type is the array's type.
    """

    def __init__(self, *names: str, empty: float | bool = 0.0) -> None:
        self.names, self.empty = names, empty
        self._entry = [ENTRY_AXES.index(name) for name in names if name in ENTRY_AXES]

    def of_entries(self, entries: Entries) -> tuple[Any, ...]:
        """Return the part of an index that applies to the axes of this array."""
        index = entries if isinstance(entries, tuple) else (entries,)
        return tuple(index[i] for i in self._entry if i < len(index))


class ArrayStruct:
    """Base of frozen dataclasses of arrays; the arrays themselves are writable."""

    _parts: ClassVar[Mapping[str, Axes | type[ArrayStruct]]]
    """Axes of each array, and the class of each field (or tuple) that holds arrays itself."""

    def __init_subclass__(cls) -> None:
        found: dict[str, Axes | type[ArrayStruct]] = {}
        for name, hint in get_type_hints(cls, include_extras=True).items():
            inner = get_args(hint)[0] if get_origin(hint) is tuple else hint
            axes = [part for part in getattr(hint, "__metadata__", ()) if isinstance(part, Axes)]
            if axes:
                found[name] = axes[0]
            elif isinstance(inner, type) and issubclass(inner, ArrayStruct):
                found[name] = inner
        cls._parts = found

    @classmethod
    def empty(cls, **sizes: int) -> Self:
        """Return a value without data; `sizes` are the lengths of all axes by name."""
        return cls(
            **{
                name: np.full([sizes[axis] for axis in of.names], of.empty)
                if isinstance(of, Axes)
                else of.empty(**sizes)
                for name, of in cls._parts.items()
            }
        )

    def blank(self, *sizes: int) -> Self:
        """Return a value like this one without data, for a number of runs and movements."""

        def emptied(array: np.ndarray, axes: Axes) -> np.ndarray:
            lead = axes.of_entries(sizes)
            return np.full((*lead, *array.shape[len(lead) :]), axes.empty)

        return self._with(emptied)

    def __getitem__(self, entries: Entries) -> Self:
        """Return some of the runs, or of their movements."""
        return self._with(lambda array, axes: array[axes.of_entries(entries)])

    def put(self, entries: Entries, values: Self) -> None:
        """Write values into some of the entries."""
        new = values._arrays()
        for (_, array, axes), (_, value, _) in zip(self._arrays(), new, strict=True):
            array[axes.of_entries(entries)] = value

    def extended_by(self, *others: Self) -> Self:
        """Return these movements with those of others behind them, all of the same runs."""
        return self.joined([self, *others], "movement")

    @classmethod
    def joined(cls, parts: Sequence[Self], along: str = "run") -> Self:
        """Return the entries of several values one after the other, by the name of their axis."""
        each = zip(*(part._arrays() for part in parts), strict=True)

        def one(array: np.ndarray, axes: Axes) -> np.ndarray:
            arrays = [part for _, part, _ in next(each)]
            if along not in axes.names:
                return array
            return np.concatenate(arrays, axis=axes.names.index(along))

        return parts[0]._with(one)

    def forget_oldest(self, runs: IntArray) -> None:
        """Drop the first movement of some runs; the last place becomes empty."""
        for _, array, axes in self._arrays():
            if "movement" in axes.names:
                array[runs, :-1] = array[runs, 1:]
                array[runs, -1] = axes.empty

    def to_arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """Return all arrays by ``prefix/field``, and ``prefix/field/field`` for nested values."""
        return {prefix + name: array for name, array, _ in self._arrays()}

    def from_arrays(self, prefix: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the result of `to_arrays` into the arrays.

        Raises:
            KeyError: If an array is missing.
            ValueError: If an array has another shape.
        """
        for name, array, _ in self._arrays():
            value = arrays[prefix + name]
            if value.shape != array.shape:
                raise ValueError(f"{prefix}{name} has shape {value.shape}, expected {array.shape}")
            array[...] = value

    def _with(self, change: Change) -> Self:
        """Return a copy with every array changed."""
        values: dict[str, Any] = {}
        for name, of in self._parts.items():
            value = getattr(self, name)
            if isinstance(of, Axes):
                values[name] = change(value, of)
            elif isinstance(value, tuple):
                values[name] = tuple(part._with(change) for part in value)
            else:
                values[name] = value._with(change)
        return dataclasses.replace(self, **values)  # type: ignore[type-var]

    def _arrays(self) -> Iterator[tuple[str, np.ndarray, Axes]]:
        """Yield ``/field``, array and axes of every array."""
        for name, of in self._parts.items():
            value = getattr(self, name)
            if isinstance(of, Axes):
                yield f"/{name}", value, of
                continue
            parts = enumerate(value) if isinstance(value, tuple) else [("", value)]
            for i, part in parts:
                for inner, array, axes in part._arrays():
                    yield f"/{name}{i}{inner}", array, axes
