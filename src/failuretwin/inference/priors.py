"""What is believed before a run is seen: onsets, ranges of sizes, odds of health.

The odds of each mode and its sizes stand in its class.

Section: docs/diagnosis.md#priors-odds-onset-sizes
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode, Range
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.inference.onset import OnsetPrior
from failuretwin.inference.settings import USUAL, InferenceSettings


@dataclass(frozen=True)
class Priors:
    """What is believed before the run is seen.

    Attributes:
        onset: When a motor may have got stuck.
        error_ranges: Run-level ranges of steady-state errors [rad], equally likely.
        healthy_odds: How many times as probable it is that all is well as its mode
            says, which leaves no more for it than for a stuck motor.

    Raises:
        InputError: If there is no range, or one or the odds make no sense.
    """

    onset: OnsetPrior = field(default_factory=OnsetPrior)
    error_ranges: Sequence[Range] = USUAL.error_ranges
    healthy_odds: float = 1.0

    def __post_init__(self) -> None:
        sound = all(0.0 <= low < high < np.inf for low, high in self.error_ranges)
        if not self.error_ranges or not sound:
            raise InputError(
                f"error_ranges are {self.error_ranges}, expected pairs 0 <= low < high [rad]."
            )
        if not 0.0 < self.healthy_odds < np.inf:
            raise InputError(f"healthy_odds are {self.healthy_odds:g}, expected above 0.")

    def ranges_of(self, mode: FaultMode) -> Sequence[Range]:
        """Return the ranges of sizes that are considered of a mode, equally likely."""
        return self.error_ranges if isinstance(mode, SteadyStateError) else (mode.considered,)


MONITORING = Priors(healthy_odds=30.0)
"""Beliefs of who watches a robot at work: faults are rare, and a single movement that went wrong is
more often a lost command. Chosen on emulated robots: about one false alarm an hour."""


def priors_of(
    robot: Robot, error_range_counts: tuple[float, float] | None, onset_s: float | None
) -> Priors:
    """Return priors with what is known of the faults, the default for what is not.

    Args:
        robot: The robot, for its servo units.
        error_range_counts: Range of steady-state errors [servo units].
        onset_s: Onset of stuck faults [s].

    Raises:
        InputError: If the range is not 0 <= low < high, no motor can be off by that much, or the
            onset is negative.
    """
    priors = Priors(error_ranges=InferenceSettings.of(robot).error_ranges)
    if error_range_counts is not None:
        low, high = error_range_counts
        if not 0.0 <= low < high < np.inf:
            raise InputError(f"--sse-range is {low:g} {high:g}, expected 0 <= LOW < HIGH.")
        units, count = robot.servo_units, robot.servo_units.rad_per_count
        most = units.high - units.low
        if high > most:
            raise InputError(
                f"--sse-range is {low:g} {high:g}, but the motors turn through {most:g} servo "
                f"units ({np.rad2deg(most * count):.0f} deg) and can be off by no more. Expected "
                f"HIGH up to {most:g}."
            )
        priors = replace(priors, error_ranges=((low * count, high * count),))
    if onset_s is not None:
        if not 0.0 <= onset_s < np.inf:
            raise InputError(f"--onset is {onset_s:g} s, expected 0 or more.")
        priors = replace(priors, onset=replace(priors.onset, known_s=onset_s))
    return priors
