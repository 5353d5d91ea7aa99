"""Servo loop of the published Simulink model, with and without a speed limit.

Each motor is a PI loop around a second-order input filter, and the joint follows exactly:

    (P s + I) / (s (tau s + 1)^2 + P s + I)

All solutions are exact for references that are linear between samples. `ServoUnits` is the count
scale of a servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.compiled import compiled
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


def respond(loops: Sequence[ServoLoop], command: FloatArray, step: float) -> FloatArray:
    """Return the angles of motors that start at rest at their first command.

    References are (..., time, motor) [rad], linear between samples that are `step` [s] apart.

    Returns:
        Angles at the same instants, (..., time, motor) [rad].
    """
    if command.ndim < 2 or command.shape[-1] != len(loops):
        raise InputError(
            f"`command` has shape {command.shape}, expected (..., time, {len(loops)} motors)."
        )
    gains = np.array([(loop.P, loop.I, loop.filter_s) for loop in loops])
    cases = np.moveaxis(command, -1, 0).reshape(len(loops), -1, command.shape[-2])
    angles = respond_limited(gains, np.full(len(loops), np.inf), cases, step)
    return np.moveaxis(angles.reshape(len(loops), *command.shape[:-1]), 0, -1)


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
    angle = np.empty(reference.shape)
    _write_angles(reference, step, free, held, limit, angle)
    return angle


@compiled
def _advance(
    drive: FloatArray, free: FloatArray, held: FloatArray, limit: float, ahead: FloatArray
) -> None:
    """Replace the state in `drive` by the next; `ahead` (4,) is scratch."""
    for j in range(4):
        ahead[j] = 0.0
        for i in range(5):
            ahead[j] += drive[i] * free[i, j]
    speed = ahead[3]
    if abs(speed) > limit:
        for j in range(3):
            ahead[j] = np.copysign(limit, speed) * held[3, j]
            for i in range(3):
                ahead[j] += drive[i] * held[i, j]
    for j in range(3):
        drive[j] = ahead[j]


@compiled
def _write_angles(
    reference: FloatArray,
    step: float,
    free: FloatArray,
    held: FloatArray,
    limit: FloatArray,
    angle: FloatArray,
) -> None:
    """Write the angles of `respond_limited`, (variant, test, time)."""
    variants, tests, count = reference.shape
    drive, ahead = np.zeros(5), np.zeros(4)  # state, reference, slope; next state, speed
    for v in range(variants):
        for n in range(tests):
            begin = reference[v, n, 0]
            drive[:] = 0.0
            for t in range(count):
                angle[v, n, t] = begin + drive[2]
                if t + 1 == count:
                    break
                drive[3] = reference[v, n, t] - begin
                drive[4] = (reference[v, n, t + 1] - reference[v, n, t]) / step
                _advance(drive, free[v], held[v], limit[v], ahead)


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
    kept = np.exp(-step / tau)
    mean = (1.0 - kept) * tau / step
    out = np.empty(reference.shape)
    out[..., 0] = before
    count = reference.shape[-1]
    _write_lagged(reference.reshape(-1, count), kept, mean, out.reshape(-1, count))
    return out


@compiled
def _write_lagged(reference: FloatArray, kept: float, mean: float, out: FloatArray) -> None:
    """Write what follows the first samples of `first_order_lag`, (case, time)."""
    for n in range(len(out)):
        for t in range(1, out.shape[1]):
            new = (mean - kept) * reference[n, t - 1] + (1.0 - mean) * reference[n, t]
            out[n, t] = kept * out[n, t - 1] + new


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
