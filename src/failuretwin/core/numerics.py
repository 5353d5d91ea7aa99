"""Numerics of probabilities: log sums, quantiles, Student t densities, covariances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.types import BoolArray, FloatArray, as_floats


@dataclass(frozen=True)
class Weighted:
    """A discrete distribution: values and weights, (value,) each; weights need not sum to 1."""

    values: FloatArray
    weights: FloatArray

    def quantiles(self, levels: tuple[float, ...]) -> FloatArray:
        """Return quantiles, (level,)."""
        return weighted_quantiles(self.values, self.weights, levels)

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return draws, (count,), by linear interpolation of the quantiles."""
        return self.quantiles(tuple(rng.random(count).tolist()))


def log_sum(values: FloatArray, axis: int | tuple[int, ...]) -> FloatArray:
    """Return log(sum(exp(values))) along `axis`; an all -inf slice gives -inf."""
    top = np.max(values, axis=axis, keepdims=True)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.sum(np.exp(values - safe), axis=axis, keepdims=True)) + safe
    return np.squeeze(total, axis=axis)


def log_of(values: ArrayLike) -> FloatArray:
    """Return the logarithm, -inf for 0 without a warning."""
    with np.errstate(divide="ignore"):
        return np.log(as_floats(values))


SAME_LEVEL = 1e-10
"""Probabilities that differ by less are equal."""
SAME_VALUE = 1e-9
"""Values that differ by a smaller share of their range are equal [-]."""


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, levels: tuple[float, ...]
) -> FloatArray:
    """Return quantiles of each row of weighted `values`, (..., value) -> (..., level).

    Linear between the middles of the weights. Values that differ only by rounding form one atom
    with a step, so that their order does not matter. A level at the end of a step gives the middle
    between that atom and the next.
    """
    order = np.argsort(values, axis=-1)
    values = np.take_along_axis(values, order, axis=-1)
    weights = np.take_along_axis(weights, order, axis=-1)
    flat = values.reshape(-1, values.shape[-1]), weights.reshape(-1, values.shape[-1])
    rows = [_quantiles(row, weight, levels) for row, weight in zip(*flat, strict=True)]
    return np.array(rows).reshape(*values.shape[:-1], len(levels))


def _quantiles(values: FloatArray, weights: FloatArray, levels: tuple[float, ...]) -> FloatArray:
    """Return quantiles of one row of sorted values, (level,)."""
    first = np.append(True, np.diff(values) > SAME_VALUE * (values[-1] - values[0]))
    at = np.flatnonzero(first)
    weights = np.add.reduceat(weights, at)
    alone = np.diff(at, append=len(values)) == 1
    inset = np.where(alone, 0.5 * weights, 0.0)
    end = np.cumsum(weights)
    steps = np.stack([end - weights + inset, end - inset], axis=1).ravel()
    total = max(float(end[-1]), np.finfo(float).tiny)
    asked = np.array(levels)[:, None] + SAME_LEVEL * np.array([-1.0, 1.0])
    return np.interp(asked, steps / total, np.repeat(values[first], 2)).mean(axis=1)


# Covariances of what sensors see, many at once: S = A A^T + noise I.


@dataclass(frozen=True)
class Covariance(ABC):
    """Covariances (...) of deviations in d dimensions, S = A A^T + noise I.

    Attributes:
        determinant: (...).
        dims: Dimension of the Student t density; less than d where deviations lie on a surface,
            such as rotations among matrices.
    """

    determinant: FloatArray
    dims: int

    @staticmethod
    def of(root: FloatArray, noise: float, dims: int | None = None) -> Covariance:
        """Return S = A A^T + noise I; three dimensions in closed form, others by inversion.

        A is (..., d, column); the Student t density has d dimensions, or `dims`.
        """
        made = Ellipsoid if root.shape[-2] == 3 else DenseCovariance
        return made.of_root(root, noise, dims or root.shape[-2])

    @abstractmethod
    def solve(self, b: FloatArray) -> FloatArray:
        """Return S^-1 b of vectors (..., d), as (..., d)."""

    @property
    @abstractmethod
    def inverse_root(self) -> FloatArray:
        """A with A^T A = S^-1, upper triangular, (..., d, d): whitens deviations."""

    def product(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return a^T S^-1 b of vectors (..., d), as (...)."""
        return np.asarray(np.sum(a * self.solve(b), axis=-1))

    def log_norm(self, dof: float) -> FloatArray:
        """Return the log density at the centre of a Student t with this scale matrix, (...)."""
        return log_norm(dof, self.dims) - 0.5 * np.log(self.determinant)

    def log_student(self, error: FloatArray, dof: float) -> FloatArray:
        """Return log t_nu(error; S) of deviations (..., d), as (...)."""
        return self.log_norm(dof) + log_fall(self.product(error, error), dof, self.dims)


@dataclass(frozen=True)
class Ellipsoid(Covariance):
    """Covariances in three dimensions by their adjugates, faster than small matrices in numpy.

    Attributes:
        adjugate: xx, yy, zz, xy, xz, yz of the adjugate, each (...).
    """

    adjugate: tuple[FloatArray, ...]

    @classmethod
    def of_root(cls, root: FloatArray, noise: float, dims: int) -> Ellipsoid:
        """Return A A^T + noise I; see `Covariance.of`."""
        x, y, z = (root[..., axis, :] for axis in range(3))
        dot = "...i,...i->..."
        xx, yy, zz = (np.einsum(dot, a, a) + noise for a in (x, y, z))
        xy, xz, yz = np.einsum(dot, x, y), np.einsum(dot, x, z), np.einsum(dot, y, z)
        adjugate = (
            *(yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy),
            *(xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz),
        )
        determinant = xx * adjugate[0] + xy * adjugate[3] + xz * adjugate[4]
        return cls(determinant, dims, adjugate)

    def solve(self, b: FloatArray) -> FloatArray:
        """Return S^-1 b of vectors (..., 3), as (..., 3)."""
        xx, yy, zz, xy, xz, yz = self.adjugate
        rows = (
            xx * b[..., 0] + xy * b[..., 1] + xz * b[..., 2],
            xy * b[..., 0] + yy * b[..., 1] + yz * b[..., 2],
            xz * b[..., 0] + yz * b[..., 1] + zz * b[..., 2],
        )
        return np.stack(rows, axis=-1) / self.determinant[..., None]

    @property
    def inverse_root(self) -> FloatArray:
        """A with A^T A = S^-1, upper triangular, (..., 3, 3): whitens deviations."""
        xx, yy, zz, xy, xz, yz = (part / self.determinant for part in self.adjugate)
        root = np.zeros((*self.determinant.shape, 3, 3))
        root[..., 0, 0] = np.sqrt(xx)
        root[..., 0, 1], root[..., 0, 2] = xy / root[..., 0, 0], xz / root[..., 0, 0]
        root[..., 1, 1] = np.sqrt(yy - root[..., 0, 1] ** 2)
        root[..., 1, 2] = (yz - root[..., 0, 1] * root[..., 0, 2]) / root[..., 1, 1]
        rest = zz - root[..., 0, 2] ** 2 - root[..., 1, 2] ** 2
        root[..., 2, 2] = np.sqrt(np.maximum(rest, 0.0))
        return root


@dataclass(frozen=True)
class DenseCovariance(Covariance):
    """Covariances in any number of dimensions.

    Attributes:
        inverse: S^-1, (..., d, d).
    """

    inverse: FloatArray

    @classmethod
    def of_root(cls, root: FloatArray, noise: float, dims: int) -> DenseCovariance:
        """Return A A^T + noise I; see `Covariance.of`."""
        matrix = root @ np.swapaxes(root, -1, -2) + noise * np.eye(root.shape[-2])
        return cls(np.linalg.det(matrix), dims, as_floats(np.linalg.inv(matrix)))

    def solve(self, b: FloatArray) -> FloatArray:
        """Return S^-1 b of vectors (..., d), as (..., d)."""
        return np.asarray(np.einsum("...ij,...j->...i", self.inverse, b))

    @property
    def inverse_root(self) -> FloatArray:
        """A with A^T A = S^-1, upper triangular, (..., d, d): whitens deviations."""
        return np.swapaxes(np.linalg.cholesky(self.inverse), -1, -2)


# Student t in d dimensions, with nu degrees of freedom and scale S; nu infinite: normal.
#
#   log t_nu(x; S) = log c - 1/2 log |S| - (nu + d)/2 log(1 + x^T S^-1 x / nu)
#   log c = log Gamma((nu + d)/2) - log Gamma(nu/2) - d/2 log(nu pi)
#
# Integrated over some of the d directions it is a Student t of the others, with the same nu.


NORMAL_DOF = 1e8
"""Degrees of freedom from which a Student t equals a normal in double precision."""


def log_norm(dof: float, dims: int = 3) -> float:
    """Return log c for `dof` = nu and `dims` = d; infinite nu: normal."""
    if dof > NORMAL_DOF:
        return -0.5 * dims * log(2.0 * pi)
    return lgamma((dof + dims) / 2.0) - lgamma(dof / 2.0) - 0.5 * dims * log(dof * pi)


def log_fall(square: FloatArray, dof: float, dims: int = 3) -> FloatArray:
    """Return the log density of a Student t relative to its centre, (...).

    `square` is x^T S^-1 x, (...); `dof` is nu, infinite: normal; `dims` is d.
    """
    if np.isinf(dof):
        return -0.5 * square
    fall = np.asarray(square / dof)
    np.log1p(fall, out=fall)
    fall *= -0.5 * (dof + dims)
    return fall


def log_student(error: FloatArray, root: FloatArray, noise: float, dof: float) -> FloatArray:
    """Return log t_nu(error; A A^T + noise I) in d dimensions, (...).

    Deviations are (..., d), A is (..., d, column), and `noise` is a variance on each axis; nu
    infinite: normal.
    """
    return Covariance.of(root, noise).log_student(error, dof)


def log_normal_2d(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return log N(error; 0, S) in two dimensions, (...), in closed form.

    The error is (..., 2), the covariance S (..., 2, 2).
    """
    (aa, ab), (_, bb) = np.moveaxis(covariance, (-2, -1), (0, 1))
    a, b = np.moveaxis(error, -1, 0)
    determinant = aa * bb - ab * ab
    square = (bb * a * a + aa * b * b - 2.0 * ab * a * b) / determinant
    return np.asarray(-0.5 * (square + np.log(determinant)) - log(2.0 * pi))


# Medians of some of the values, many at once.


def masked_median(values: FloatArray, kept: BoolArray) -> FloatArray:
    """Return the median of the kept values in each row, (row,); 0 without any.

    Values are (row, value), as is which of them are kept.
    """
    if values.shape[1] == 0:
        return np.zeros(len(values))
    ordered = np.sort(np.where(kept, values, np.inf), axis=1)
    count = kept.sum(axis=1)
    row = np.arange(len(values))
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[1] - 1)
    middle = 0.5 * (ordered[row, low] + ordered[row, high])
    return np.where(count > 0, middle, 0.0)


# Points and velocities along paths that are straight from knot to knot, many at once.


def along_polyline(
    path: FloatArray, longest: FloatArray, since: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return position and velocity on polylines with equal times between knots.

    Before the first knot and after the last one the motion is at rest.

    Args:
        path: The knots, (item, case, knot, axis).
        longest: Time of the last knot, (item, case) [s]; the first is at 0.
        since: Times, (item, 1, reading, shift) [s].

    Returns:
        For each axis, (item, case, reading, shift).
    """
    items, cases, knots, axes = path.shape
    interval = longest[..., None, None] / (knots - 1)
    knot = since / interval
    moving = ((knot > 0.0) & (knot < knots - 1)) / interval
    knot = np.clip(knot, 0.0, knots - 1)
    low = np.minimum(knot.astype(np.int64), knots - 2)
    share = knot - low
    low += knots * np.arange(items * cases).reshape(items, cases, 1, 1)
    place, velocity = [], []
    for axis in range(axes):
        values = np.ascontiguousarray(path[..., axis]).ravel()
        before = values[low]
        step = values[low + 1] - before
        place.append(before + share * step)
        velocity.append(step * moving)
    return place, velocity
