"""Covariances of points in space, many at once: S = A A^T + noise I, solved in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np

from failuretwin.core.types import FloatArray


@dataclass(frozen=True)
class Ellipsoid:
    """Covariances (...) by their adjugates, which numpy handles faster than small matrices.

    Attributes:
        adjugate: xx, yy, zz, xy, xz, yz of the adjugate, each (...).
        determinant: (...).
    """

    adjugate: tuple[FloatArray, ...]
    determinant: FloatArray

    @classmethod
    def of(cls, root: FloatArray, noise: float) -> Ellipsoid:
        """Return S = A A^T + noise I.

        Args:
            root: A, (..., 3, column).
            noise: Variance added on each axis.
        """
        x, y, z = (root[..., axis, :] for axis in range(3))
        dot = "...i,...i->..."
        xx, yy, zz = (np.einsum(dot, a, a) + noise for a in (x, y, z))
        xy, xz, yz = np.einsum(dot, x, y), np.einsum(dot, x, z), np.einsum(dot, y, z)
        adjugate = (
            *(yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy),
            *(xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz),
        )
        return cls(adjugate, xx * adjugate[0] + xy * adjugate[3] + xz * adjugate[4])

    def product(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return a^T S^-1 b of vectors (..., 3), as (...)."""
        return np.asarray(np.sum(a * self.solve(b), axis=-1))

    def solve(self, b: FloatArray) -> FloatArray:
        """Return S^-1 b of vectors (..., 3), as (..., 3)."""
        xx, yy, zz, xy, xz, yz = self.adjugate
        rows = (
            xx * b[..., 0] + xy * b[..., 1] + xz * b[..., 2],
            xy * b[..., 0] + yy * b[..., 1] + yz * b[..., 2],
            xz * b[..., 0] + yz * b[..., 1] + zz * b[..., 2],
        )
        return np.stack(rows, axis=-1) / self.determinant[..., None]

    def log_norm(self, dof: float) -> FloatArray:
        """Return the log density at the centre of a Student t with this scale matrix, (...)."""
        return log_norm(dof) - 0.5 * np.log(self.determinant)


def log_norm(dof: float) -> float:
    """Return the log density at the centre of the standard 3-variate Student t distribution.

    Args:
        dof: Degrees of freedom; infinite: normal.
    """
    if np.isinf(dof):
        return -1.5 * log(2.0 * pi)
    return lgamma((dof + 3.0) / 2.0) - lgamma(dof / 2.0) - 1.5 * log(dof * pi)


def log_fall(square: FloatArray, dof: float) -> FloatArray:
    """Return how far the log density of a 3-variate Student t has fallen from its centre.

    Args:
        square: Squared distance in scales, (...).
        dof: Degrees of freedom; infinite: normal.
    """
    if np.isinf(dof):
        return -0.5 * square
    return -0.5 * (dof + 3.0) * np.log1p(square / dof)


def log_student(error: FloatArray, root: FloatArray, noise: float, dof: float) -> FloatArray:
    """Return log densities of a 3-variate Student t distribution with S = A A^T + noise I.

    Args:
        error: Deviations, (..., 3).
        root: A, (..., 3, column).
        noise: Variance added on each axis.
        dof: Degrees of freedom; infinite: normal.

    Returns:
        (...).
    """
    spread = Ellipsoid.of(root, noise)
    return spread.log_norm(dof) + log_fall(spread.product(error, error), dof)
