"""Outcomes: what may have become of each moment, with residual and scale.

    r_a = e - y(q_a)
    S_a = sigma^2 J diag(s^2) J^T + tau^2 J diag(u) J^T + J diag(v) J^T + sn^2 I

with poses q_a, scatter s and its factor sigma, variances u by uneven starts on the way and their
factor tau^2, other variances v of single motors, and the noise sn of the sensor.

Section: docs/inference.md#outcomes
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.compiled import compiled, laid_out
from failuretwin.core.types import FloatArray
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.theta import Shown


def seen_variance(jacobian: FloatArray, variance: FloatArray) -> FloatArray:
    """Return J diag(v) J^T, (..., channel, channel) [m2].

    Args:
        jacobian: J, (..., channel, motor) [m/rad].
        variance: v, (..., motor) [rad2].
    """
    channels, motors = jacobian.shape[-2:]
    lead = jacobian.shape[:-2]
    flat = laid_out(np.broadcast_to(variance, (*lead, motors))).reshape(-1, motors)
    found = np.empty((*lead, channels, channels))
    J = laid_out(jacobian).reshape(-1, channels, motors)
    _write_seen_variance(J, flat, found.reshape(-1, channels, channels))
    return found


@compiled
def _write_seen_variance(J: FloatArray, variance: FloatArray, found: FloatArray) -> None:
    """Write J diag(v) J^T, (item, channel, channel)."""
    for n in range(len(J)):
        for c in range(J.shape[1]):
            for d in range(c + 1):
                total = 0.0
                for k in range(J.shape[2]):
                    total += J[n, c, k] * J[n, d, k] * variance[n, k]
                found[n, c, d] = found[n, d, c] = total


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of moments, (run, ..., outcome).

    Attributes:
        residual: Seen minus expected, (..., outcome, channel) [m].
        scatter: J diag(s^2) J^T, (..., outcome, channel, channel) [m2].
        late: J diag(u) J^T, same axes [m2]; without channels where all moments are at rest.
        beside: J diag(v) J^T, same axes [m2].
    """

    residual: FloatArray
    scatter: FloatArray
    late: FloatArray
    beside: FloatArray

    @classmethod
    def of_poses(
        cls,
        moments: Moments,
        shown: Shown,
        variance: FloatArray,
        late: FloatArray,
        beside: FloatArray,
    ) -> Outcomes:
        """Return the outcomes of some poses.

        Args:
            moments: The moments.
            shown: What the sensors show of them, (run, moment, ...).
            variance: Of the scatter of each motor, (..., motor) [rad2].
            late: By uneven starts, (run, moment, ..., motor) [rad2].
            beside: Variance of single motors beside these, same axes [rad2].
        """
        expected, jacobian = shown
        point = moments.point
        between = expected.ndim - point.ndim
        point = point.reshape(*point.shape[:2], *(1,) * between, point.shape[-1])
        scatter = seen_variance(jacobian, variance)
        extra, uneven = np.broadcast_to(0.0, scatter.shape), scatter[..., :0, :0]
        if beside.any():
            extra = seen_variance(jacobian, beside)
        if moments.late.any():
            uneven = seen_variance(jacobian, late)
        return cls(point - expected, scatter, uneven, extra)

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """All that is known of them, in the order of attributes."""
        return self.residual, self.scatter, self.late, self.beside

    def with_rows(self) -> Outcomes:
        """Return the same with an axis for rows behind that of runs."""
        return Outcomes(*(x[:, None] for x in self.arrays))

    def rows_first(self) -> Outcomes:
        """Return outcomes (run, moment, row, ...) as (run, row, moment, ...)."""
        return Outcomes(*(np.swapaxes(x, 1, 2) for x in self.arrays))

    @classmethod
    def joined(cls, *parts: Outcomes) -> Outcomes:
        """Return the outcomes of several sets, (run, moment, outcome, ...)."""
        return cls(
            *(np.concatenate(x, axis=2) for x in zip(*(p.arrays for p in parts), strict=True))
        )
