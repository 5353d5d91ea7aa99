"""Vectors of three coordinates, each a number or an array over poses.

Entries of constant transforms that are 0 or 1 cost nothing: a chain is mostly such entries.
"""

from __future__ import annotations

from collections.abc import Iterator

from failuretwin.core.types import FloatArray

Scalar = float | FloatArray
"""A coordinate: the same for every pose (float) or one per pose (array)."""
Vector = tuple[Scalar, Scalar, Scalar]

CHUNK = 8000
"""Poses at a time: 64 kB an array, so that the working set stays in the second-level cache."""


def chunks(count: int) -> Iterator[slice]:
    """Return slices of `CHUNK` that cover `count` poses."""
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


def scale(factor: float, value: Scalar) -> Scalar:
    """Return `factor` times `value`."""
    if factor == 0.0 or (isinstance(value, float) and value == 0.0):
        return 0.0
    if factor == 1.0:
        return value
    return -value if factor == -1.0 else factor * value


def add(a: Scalar, b: Scalar) -> Scalar:
    """Return `a` plus `b`."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def turn(T: FloatArray, v: Vector) -> Vector:
    """Return the direction `v` turned by the constant transform `T`."""
    rows = T[:3, :3].tolist()
    x, y, z = (add(add(scale(r[0], v[0]), scale(r[1], v[1])), scale(r[2], v[2])) for r in rows)
    return x, y, z


def move(T: FloatArray, v: Vector) -> Vector:
    """Return the point `v` moved by the constant transform `T`."""
    x, y, z = turn(T, v)
    offset = T[:3, 3].tolist()
    return add(x, offset[0]), add(y, offset[1]), add(z, offset[2])


def spin(c: FloatArray, s: FloatArray, v: Vector) -> Vector:
    """Return `v` turned about z by the angles with cosine `c` and sine `s`."""
    x, y, z = v
    x_zero = isinstance(x, float) and x == 0.0
    y_zero = isinstance(y, float) and y == 0.0
    if x_zero and y_zero:
        return v
    if x_zero:
        return -(s * y), c * y, z
    if y_zero:
        return c * x, s * x, z
    return c * x - s * y, s * x + c * y, z
