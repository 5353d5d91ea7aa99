"""The servo loop of the published Simulink model, solved exactly between samples.

Each motor is a PI loop around a second-order input filter and the joint follows exactly:
closed loop (P s + I) / (s (tau s + 1)^2 + P s + I).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray


@dataclass(frozen=True)
class ServoLoop:
    """Gains of one closed loop.

    Attributes:
        P: Proportional gain [-].
        I: Integral gain [1/s].
        filter_s: Time constant tau of the input filter [s].
    """

    P: float
    I: float  # noqa: E741 - the field's name for an integral gain
    filter_s: float

    def discretise(self, step: float) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator (b, a) of the loop sampled every `step` [s].

        Exact for an input that is linear between samples (first-order hold).
        """
        from scipy.signal import cont2discrete

        tau = self.filter_s
        numerator = np.array([self.P, self.I])
        denominator = np.array([tau * tau, 2.0 * tau, 1.0 + self.P, self.I])
        b, a, _ = cont2discrete((numerator, denominator), step, method="foh")
        return np.ravel(b), np.ravel(a)


def respond(loops: Sequence[ServoLoop], command: FloatArray, step: float) -> FloatArray:
    """Return the angles of motors that start at rest at their first command.

    Args:
        loops: One loop for each motor.
        command: References, (..., time, motor) [rad], linear between samples.
        step: Time step [s].

    Returns:
        Angles at the same instants, (..., time, motor) [rad].

    Raises:
        InputError: If the last axis does not hold one column for each loop.
    """
    from scipy.signal import lfilter

    if command.ndim < 2 or command.shape[-1] != len(loops):
        raise InputError(
            f"`command` has shape {command.shape}, expected (..., time, {len(loops)} motors)."
        )
    response = np.empty((*command.shape[:-2], len(loops), command.shape[-2]))
    for motor, loop in enumerate(loops):
        b, a = loop.discretise(step)
        start = command[..., :1, motor]
        response[..., motor, :] = start + lfilter(b, a, command[..., motor] - start)
    return np.swapaxes(response, -1, -2)
