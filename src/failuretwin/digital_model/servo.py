"""Servo loop of the published Simulink model, with and without a speed limit.

Each motor is a PI loop around a second-order input filter, and the joint follows exactly:

    (P s + I) / (s (tau s + 1)^2 + P s + I)

All solutions are exact between samples. `ServoUnits` is the count scale of a servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, as_floats

SLOWEST_S = 100.0
"""Longest time constant of a loop [s]; with a slower one no movement is visible."""


@dataclass(frozen=True)
class ServoLoop(Bounded):
    """Gains of one closed loop.

    Attributes:
        P: Proportional gain [-].
        I: Integral gain [1/s].
        filter_s: Time constant tau of the input filter [s].
    """

    P: AtLeastZero
    I: Annotated[float, Bounds(0.0, 1e6)]  # noqa: E741 - the field's name for an integral gain
    filter_s: Annotated[float, Bounds(1e-6, SLOWEST_S)]

    def __post_init__(self) -> None:
        super().__post_init__()
        least, most = (1.0 + self.P) / SLOWEST_S, 2.0 * (1.0 + self.P) / self.filter_s
        if not least <= self.I < most:
            raise InputError(
                f"I is {self.I:g}, expected {least:g} to {most:g}: with less the motor takes "
                f"longer than {SLOWEST_S:g} s to its target, (1 + P) / I; from 2 (1 + P) / "
                "filter_s on the loop is not stable (Routh and Hurwitz)."
            )

    def discretise(self, step: float) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator (b, a) of the loop sampled every `step` [s].

        Exact for an input that is linear between samples (first-order hold).
        """
        b, a = _discretised(self.P, self.I, self.filter_s, step)
        return b.copy(), a.copy()


@lru_cache(maxsize=256)
def _discretised(P: float, I: float, tau: float, step: float) -> tuple[FloatArray, FloatArray]:  # noqa: E741
    from scipy.signal import cont2discrete

    numerator = np.array([P, I])
    denominator = np.array([tau * tau, 2.0 * tau, 1.0 + P, I])
    b, a, _ = cont2discrete((numerator, denominator), step, method="foh")
    return np.ravel(b), np.ravel(a)


def respond(loops: Sequence[ServoLoop], command: FloatArray, step: float) -> FloatArray:
    """Return the angles of motors that start at rest at their first command.

    References are (..., time, motor) [rad], linear between samples that are `step` [s] apart.

    Returns:
        Angles at the same instants, (..., time, motor) [rad].
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


def first_order_lag(
    reference: FloatArray, before: FloatArray, step: float, tau: float
) -> FloatArray:
    """Return references (..., time) behind a first-order lag; exact for lines between samples.

    Args:
        reference: (..., time), sampled every `step` [s].
        before: Output of the lag at the first sample, (...); the result begins with it.
        step: Time between samples [s].
        tau: Time constant [s].
    """
    from scipy.signal import lfilter

    kept = np.exp(-step / tau)
    mean = (1.0 - kept) * tau / step
    out = np.empty_like(reference)
    out[..., 0] = before
    memory = (mean - kept) * reference[..., :1] + kept * before[..., None]
    weights = [1.0 - mean, mean - kept]
    out[..., 1:], _ = lfilter(weights, [1.0, -kept], reference[..., 1:], zi=memory)
    return out


def respond_limited(
    gains: FloatArray, limit: FloatArray, reference: FloatArray, step: float
) -> FloatArray:
    """Return the angles of motors with a speed limit that start at rest.

    Both regimes, free and at the limit, are solved exactly for references linear between samples;
    the regime is chosen at the start of every sample.

    Args:
        gains: P [-], I [1/s] and filter time constant [s] of each variant, (variant, 3).
        limit: Speed limit of each variant, (variant,) [rad/s].
        reference: References, (variant, test, time) [rad].
        step: Time step [s].

    Returns:
        Angles at the same instants, (variant, test, time) [rad].
    """
    free, held = _transitions(gains, step)
    begin = reference[..., :1]
    relative, most = reference - begin, limit[:, None]
    inputs = np.stack([relative[..., :-1], np.diff(relative, axis=-1) / step], axis=-1)
    # What the reference adds in every time step, (time - 1, variant, test, 4).
    drive = np.ascontiguousarray(np.moveaxis(inputs @ free[:, None, 3:], 2, 0))
    response = np.zeros((reference.shape[-1], *reference.shape[:2]))
    x = np.zeros((*reference.shape[:2], 3))
    for i, driven in enumerate(drive):
        ahead = x @ free[:, :3] + driven
        speed = ahead[..., 3]
        too_fast = np.abs(speed) > most
        if too_fast.any():
            capped = np.clip(speed, -most, most)[..., None] * held[:, 3:]
            x = np.where(too_fast[..., None], x @ held[:, :3] + capped, ahead[..., :3])
        else:
            x = ahead[..., :3]
        response[i + 1] = x[..., 2]
    return begin + np.moveaxis(response, 0, -1)


def _transitions(gains: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return the matrices of one time step for the state (u, filtered u, angle).

    Both act from the right. The first, (variant, 5, 4), maps state, reference and its slope to the
    next state and the demanded speed u'; the second, (variant, 4, 3), maps state and capped speed
    to the next state.
    """
    from scipy.linalg import expm

    P, I, rate = gains[:, 0], gains[:, 1], 1.0 / gains[:, 2]  # noqa: E741 - integral gain
    demanded = np.stack([0.0 * P, -P * rate, P * rate - I, I, P], axis=1)
    free = np.zeros((len(gains), 5, 5))
    free[:, 0] = demanded
    free[:, 1, 0] = free[:, 2, 1] = rate
    free[:, 1, 1] = free[:, 2, 2] = -rate
    free[:, 3, 4] = 1.0
    held = np.zeros((len(gains), 4, 4))
    held[:, 1:3, :3] = free[:, 1:3, :3]
    held[:, 0, 3] = 1.0
    ahead, capped = (np.swapaxes(np.asarray(expm(step * m)), 1, 2) for m in (free, held))
    return np.concatenate([ahead[..., :3], demanded[..., None]], axis=2), capped[..., :3]


# Conversion at the border: counts of servos to radians.

LARGEST_SCALE = 2e7
"""Largest value in a count scale: encoders of 24 bits count to 1.7e7."""


@dataclass(frozen=True)
class ServoUnits:
    """The count scale of a position servo: angle = (zero_deg - deg_per_count * counts) in degrees.

    Attributes:
        zero_deg: Joint angle at zero counts [deg].
        deg_per_count: Degrees per count; positive means that counts run against the angle.
        low: Smallest valid count.
        high: Largest valid count.
        noise: Standard deviation of a reading before it is rounded [counts].
    """

    zero_deg: float
    deg_per_count: float
    low: float
    high: float
    noise: float = 0.0

    def __post_init__(self) -> None:
        values = (self.zero_deg, self.deg_per_count, self.low, self.high, self.noise)
        sane = all(abs(value) <= LARGEST_SCALE for value in values)  # which NaN is not
        sane = sane and self.noise >= 0.0
        if not sane or self.deg_per_count == 0.0 or not self.low < self.high:
            raise InputError(
                f"servo_units are zero_deg {values[0]:g}, deg_per_count {values[1]:g}, low "
                f"{values[2]:g}, high {values[3]:g}, noise {values[4]:g}. Expected low below high, "
                f"a count that is not 0 deg, noise from 0, and nothing beyond {LARGEST_SCALE:g}."
            )

    @property
    def rad_per_count(self) -> float:
        """Size of one count [rad], always positive."""
        return abs(self.deg_per_count) * np.pi / 180.0

    def to_rad(self, counts: ArrayLike) -> FloatArray:
        """Return joint angles [rad] of `counts`, clamped to the valid range."""
        clamped = np.clip(as_floats(counts), self.low, self.high)
        return (self.zero_deg - self.deg_per_count * clamped) * np.pi / 180.0

    def to_counts(self, angle: ArrayLike) -> FloatArray:
        """Return unrounded counts of joint angles [rad]."""
        return (self.zero_deg - np.rad2deg(as_floats(angle))) / self.deg_per_count

    def valid(self, counts: ArrayLike) -> np.ndarray:
        """Return which `counts` a healthy servo can report; NaN is not valid."""
        values = as_floats(counts)
        return (values >= self.low) & (values <= self.high)
