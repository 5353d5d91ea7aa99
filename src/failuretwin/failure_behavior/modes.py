"""Fault modes: small values that say what a fault does to targets and to motor angles.

A mode never touches the twin. It acts at two places: on the targets that the motor follows, and on
the angles that come out. `FaultValue` is one fault as it strikes one run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import FloatArray

PUBLISHED_ONSET_S = 0.49
"""Onset of stuck faults in the published data: frozen from 0-based sample 49 of 100 Hz on [s]."""

PUBLISHED_ERROR_RAD = (np.deg2rad(10 * 0.24), np.deg2rad(50 * 0.24))
"""Bounds of the paper's steady-state errors: 10 and 50 counts of 0.24 deg [rad]."""


@dataclass(frozen=True)
class FaultValue:
    """One fault as it strikes one run.

    Attributes:
        fault: Motor and mode.
        onset_s: When it begins [s].
        offset: Error added to each movement's target, (movement,) [rad]; zeros for none.
        magnitude: Size in the mode's unit; NaN where it follows from the motion (stuck).
    """

    fault: Fault
    onset_s: float
    offset: FloatArray
    magnitude: float

    def detail(self) -> dict[str, Any]:
        """Return the full truth as a JSON object."""
        return {
            "motor": self.fault.motor,
            "mode": self.fault.mode,
            "onset_s": self.onset_s,
            "offset_rad": [float(x) for x in self.offset],
        }


class FaultMode(Protocol):
    """A fault mode with the distributions of its parameters."""

    @property
    def mode(self) -> str:
        """Id of the mode."""
        ...

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Return the fault as it strikes one run of `movements` within `duration` [s]."""
        ...

    def hold(self, position: FloatArray, time: FloatArray, onset_s: float) -> FloatArray:
        """Return the angles (time,) [rad] of the faulty motor after the fault has acted."""
        ...


@dataclass(frozen=True)
class Stuck:
    """The motor keeps the angle that it has at the onset.

    Attributes:
        onset_s: Range of the onset [s]; the default is that of the published data.
    """

    onset_s: tuple[float, float] = (PUBLISHED_ONSET_S, PUBLISHED_ONSET_S)
    mode: str = "stuck"

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Draw the onset uniformly from its range, at most `duration` [s]."""
        onset = min(float(rng.uniform(*self.onset_s)), duration)
        return FaultValue(Fault(motor, self.mode), onset, np.zeros(movements), np.nan)

    def hold(self, position: FloatArray, time: FloatArray, onset_s: float) -> FloatArray:
        """Freeze `position` (time,) from the first grid time at or after the onset on."""
        held = position.copy()
        first = int(np.searchsorted(time, onset_s - 1e-9))
        if first < len(time):
            held[first:] = position[first]
        return held


@dataclass(frozen=True)
class SteadyStateError:
    """Every target is missed by an error of random size and sign, drawn anew for each movement.

    Attributes:
        bounds: Smallest and largest size of the error [rad].
    """

    bounds: tuple[float, float] = PUBLISHED_ERROR_RAD
    mode: str = "steady_state_error"

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not 0.0 <= low <= high:
            raise InputError(
                f"error bounds are {low:g} and {high:g} rad, expected 0 <= low <= high."
            )

    def draw(
        self, motor: str, movements: int, duration: float, rng: np.random.Generator
    ) -> FaultValue:
        """Draw one signed error for each movement."""
        sign = np.where(rng.random(movements) < 0.5, -1.0, 1.0)
        offset = sign * rng.uniform(*self.bounds, movements)
        rms = float(np.sqrt(np.mean(offset**2))) if movements else 0.0
        return FaultValue(Fault(motor, self.mode), 0.0, offset, rms)

    def hold(self, position: FloatArray, time: FloatArray, onset_s: float) -> FloatArray:
        """Return `position` as it is: the fault acts on targets alone."""
        return position


MODES: dict[str, FaultMode] = {
    "stuck": Stuck(),
    "steady_state_error": SteadyStateError(),
}
"""The fault modes that can be simulated, with the paper's distributions."""
