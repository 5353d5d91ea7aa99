"""How long after its command a movement begins: one distribution, wherever it is asked for.

    p(tau) = (1 - r) N(tau; lag, 0.018^2 s^2) + r U(tau; lag + late starts)

Section: docs/inference.md#outcomes
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray

PUNCTUAL_STEPS_S = np.array([-0.04, -0.02, 0.0, 0.02, 0.04])
"""Punctual starts to sum over, around the lag expected [s]."""
PUNCTUAL_SPREAD_S = 0.018
"""Standard deviation of the lag from movement to movement [s]."""
LATE_STEP_S = 0.1
"""Step of the late starts to sum over [s]."""


@dataclass(frozen=True)
class StartNodes:
    """Delays to sum over.

    Attributes:
        delay: (node,) [s].
        log_weight: Log probability of each, (node,).
        step_s: How coarse the sum over them is [s].
    """

    delay: FloatArray
    log_weight: FloatArray
    step_s: float


@dataclass(frozen=True)
class StartDelay:
    """The delay tau between a command and the start of its movement, which all motors share.

    With the probability r that the movement starts late,

        p(tau) = (1 - r) N(tau; lag, 0.018^2 s^2) + r U(tau; lag + late starts)

    Attributes:
        punctual: Nodes of the first part.
        late: Nodes of the second.
    """

    punctual: StartNodes
    late: StartNodes

    @classmethod
    def of(cls, lag_s: float, late_s: tuple[float, float]) -> StartDelay:
        """Return the distribution of a robot.

        Args:
            lag_s: Mean lag of its motion behind the command [s].
            late_s: Shortest and longest late start, beside the lag [s].
        """
        weight = np.exp(-0.5 * (PUNCTUAL_STEPS_S / PUNCTUAL_SPREAD_S) ** 2)
        usual = np.maximum(lag_s + PUNCTUAL_STEPS_S, 0.0)
        low, high = late_s
        held_up = lag_s + np.arange(low, high + 0.5 * LATE_STEP_S, LATE_STEP_S)
        even = np.full(len(held_up), -np.log(len(held_up)))
        return cls(
            StartNodes(usual, np.log(weight / weight.sum()), 0.0),
            StartNodes(held_up, even, LATE_STEP_S),
        )

    def nodes(self, late: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return all delays, (node,) [s], and how probable each is, (..., node).

        Args:
            late: r, the probability that each movement starts late, (...).
        """
        parts = ((1.0 - late, self.punctual), (late, self.late))
        shares = [chance[..., None] * np.exp(nodes.log_weight) for chance, nodes in parts]
        delay = np.concatenate([self.punctual.delay, self.late.delay])
        return delay, np.concatenate(shares, axis=-1)
