"""What is believed before a run is seen: onsets, ranges of sizes, odds of health.

The odds of each mode and its sizes stand in its class.

Section: docs/inference.md#priors
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.arm_classes import class_of
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode, Range, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.fault_sizes import SizePrior
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.settings import WIDEST_ERROR
from failuretwin.inference.set_ups.setup_prior import SetupPrior

# When a fault may have begun: which movement it spoils first, and what that says of the onset.

QUADRATURE = np.linspace(0.05, 0.95, 10)
"""Points at which an interval of time is sampled, as shares of its length."""


@dataclass(frozen=True)
class OnsetPrior:
    """When a fault may have begun; onsets too late to show in the run are not considered.

    Attributes:
        prior_before_run: Probability that the fault was there before the run; of a stuck motor,
            that it was stuck before the run or gets stuck on its first ramp. The rest is spread
            evenly over the time after that. One for all modes, or by mode; None: as the mode says.
        free: Probability that the held angle of a stuck motor is unrelated to the commands,
            anywhere in range.
        known_s: The onset of a stuck motor, where it is known [s].

    Raises:
        InputError: If a probability or the onset makes no sense.
    """

    prior_before_run: float | Mapping[str, float] | None = None
    free: float = 0.2
    known_s: float | None = None

    def __post_init__(self) -> None:
        early = self.prior_before_run
        told = list(early.values()) if isinstance(early, Mapping) else [early]
        for name, value in (*(("prior_before_run", one) for one in told), ("free", self.free)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise InputError(f"{name} is {value:g}, expected a probability from 0 to 1.")
        if self.known_s is not None and not 0.0 <= self.known_s < np.inf:
            raise InputError(f"known_s is {self.known_s:g}, expected 0 or more [s].")

    def before_run(self, mode: str) -> float:
        """Return the probability that a fault of this mode was there before the run."""
        early = self.prior_before_run
        told = early.get(mode) if isinstance(early, Mapping) else early
        return MODES[mode].before_run if told is None else told


@dataclass(frozen=True)
class OnsetIntervals:
    """The time in which an onset spoils each movement first [s].

    With the probability P0 that the fault was there before the run, and the length T of each,

        p(m0) = P0 [m0 = 1] + (1 - P0) T(m0) / sum of T

    Attributes:
        begin: Begin of each; of the first movement, the start of the run. (run, movement), or
            (run, movement, part) where a movement has several; NaN without a movement.
        end: End of each, same axes.
        at_first: How P0 is shared among the parts of the first movement, (part,), whose time then
            counts no more: P0 stands for it. None: there is one part, and its time counts.
    """

    begin: FloatArray
    end: FloatArray
    at_first: FloatArray | None = None

    @property
    def length(self) -> FloatArray:
        """T, axes as of `begin` [s]; 0 without a movement."""
        return np.nan_to_num(np.maximum(self.end - self.begin, 0.0))

    def weights(self, prior_before_run: float) -> FloatArray:
        """Return p(m0), the prior probability of each interval, axes as of `begin`.

        Args:
            prior_before_run: P0.
        """
        length = self.length
        if self.at_first is not None:
            length[:, 0] = 0.0
        total = length.sum(axis=tuple(range(1, length.ndim)), keepdims=True)
        share = np.where(total > 0.0, prior_before_run, 1.0)
        weights = (1.0 - share) * length / np.where(total > 0.0, total, 1.0)
        weights[:, 0] += share[:, 0] * (1.0 if self.at_first is None else self.at_first)
        return weights

    def holding(self, onset_s: float) -> FloatArray:
        """Return 1 for the interval that holds a known onset, or the last if none does, else 0."""
        inside = (self.begin <= onset_s) & (onset_s < self.end)
        by_run = inside.reshape(len(inside), -1)
        by_run[~by_run.any(axis=1), -1] = True
        return by_run.reshape(inside.shape).astype(np.float64)

    def samples(
        self, prior_before_run: float, points: FloatArray = QUADRATURE
    ) -> tuple[FloatArray, FloatArray]:
        """Return onsets [s] and their share of their interval, each (run, movement, sample).

        A fault that was there before the run counts as an onset at 0.

        Args:
            prior_before_run: P0.
            points: Where in an interval onsets are sampled, as shares of its length.
        """
        weight = self.weights(prior_before_run)[:, 0]
        some = weight > prior_before_run
        before = np.divide(prior_before_run, weight, out=np.ones_like(weight), where=some)
        return self.spread(before, points)

    def spread(
        self, before: FloatArray, points: FloatArray = QUADRATURE
    ) -> tuple[FloatArray, FloatArray]:
        """Return `samples` with a given share of those before the run.

        Args:
            before: That share of the first interval of each run, (run,).
            points: Where in an interval onsets are sampled, as shares of its length.
        """
        begin = np.nan_to_num(self.begin)[..., None]
        onset = begin + np.concatenate([[0.0], points]) * self.length[..., None]
        onset[..., 0] = 0.0
        share = np.full(onset.shape, 1.0 / len(points))
        share[..., 0] = 0.0
        share[:, 0, 0], share[:, 0, 1:] = before, (1.0 - before[:, None]) / len(points)
        return onset, share

    def onsets(self, prior_before_run: float) -> Callable[[int], tuple[FloatArray, FloatArray]]:
        """Return `samples` of a run by its index, with an axis for nodes: (movement, 1, sample)."""
        onset, share = self.samples(prior_before_run)
        return lambda run: (onset[run, :, None], share[run, :, None])


def next_movement(movements: Movements) -> OnsetIntervals:
    """Return the intervals of a fault that acts on the movements that start after its onset."""
    return OnsetIntervals(_before(movements.start), movements.start)


def immediate(evidence: SettledEvidence) -> OnsetIntervals:
    """Return the intervals of a fault that acts at once: up to where the tool is seen at rest.

    Of a movement that is never seen at rest: up to the last reading or the next movement.
    """
    middle = 0.5 * (np.minimum(evidence.begin, evidence.end) + evidence.end)
    end = np.where(evidence.movements.exists, middle, np.nan)
    return OnsetIntervals(_before(end), end)


def plateau_or_ramp(start: FloatArray, reached: FloatArray) -> OnsetIntervals:
    """Return the intervals of a motor that gets stuck on a plateau or on the ramp that follows.

    That before the run or on the first ramp is P0; half of it each.

    Args:
        start: When each ramp begins, (run, movement) [s].
        reached: When it ends, (run, movement) [s].

    Returns:
        Intervals (run, movement, plateau | ramp).
    """
    plateau = np.minimum(_before(reached), start)
    begin, end = np.stack([plateau, start], axis=-1), np.stack([start, reached], axis=-1)
    return OnsetIntervals(begin, end, np.array([0.5, 0.5]))


def _before(end: FloatArray) -> FloatArray:
    """Return the end of the interval before each, (run, movement); of the first, 0."""
    return np.concatenate([np.zeros_like(end[:, :1]), end[:, :-1]], axis=1)


@dataclass(frozen=True)
class Priors:
    """What is believed before the run is seen.

    Attributes:
        onset: When a motor may have got stuck.
        error_ranges: Run-level ranges of steady-state errors [rad, or m of a joint that slides],
            equally likely; those of some motors by name, or the same for all. None: as the profile
            says, else from what can be seen of each motor up to `LARGEST_ERROR_RAD`.
        healthy_odds: How many times as probable it is that all is well as its mode
            says, which leaves no more for it than for a stuck motor.
        setup: How far the set-up of the sensor may be off.
        fault_factors: How many times as probable a fault is as its mode says, by
            ``MOTOR:MODE``; faults that are left out: as their mode says.
        load_changes: Share of runs in which a healthy arm picks up a load or sets one down;
            assumed. 0: never.

    Raises:
        InputError: If there is no range, or one or the odds make no sense.
    """

    onset: OnsetPrior = field(default_factory=OnsetPrior)
    error_ranges: Sequence[Range] | Mapping[str, Sequence[Range]] | None = None
    healthy_odds: float = 1.0
    setup: SetupPrior = field(default_factory=SetupPrior)
    fault_factors: Mapping[str, float] = field(default_factory=dict)
    load_changes: float = 0.03

    def __post_init__(self) -> None:
        for ranges in self._stated:
            if not ranges or not all(0.0 <= low < high < np.inf for low, high in ranges):
                raise InputError(
                    f"error_ranges are {ranges}, expected pairs 0 <= low < high [rad]."
                )
        if not 0.0 < self.healthy_odds < np.inf:
            raise InputError(f"healthy_odds are {self.healthy_odds:g}, expected above 0.")
        if not 0.0 <= self.load_changes < 1.0:
            raise InputError(
                f"load_changes are {self.load_changes:g}, expected 0 or more, below 1."
            )

    def factor_of(self, hypothesis: Hypothesis) -> float:
        """Return how many times as probable a hypothesis is as its modes say."""
        known = (self.fault_factors.get(str(fault), 1.0) for fault in hypothesis.faults)
        return math.prod(known, start=1.0)

    @property
    def _stated(self) -> Sequence[Sequence[Range]]:
        """The ranges of errors that are stated, those of all motors or of each."""
        if self.error_ranges is None:
            return ()
        if isinstance(self.error_ranges, Mapping):
            return tuple(self.error_ranges.values())
        return (self.error_ranges,)

    def sizes_of(self, mode: FaultMode, model: HealthyModel, motor: int) -> SizePrior:
        """Return what is believed of the size of a fault: ranges that are stated are as likely.

        Args:
            mode: The mode.
            model: The healthy robot.
            motor: Index of the motor.
        """
        if not mode.down_to_visible:
            return SizePrior.even([mode.considered])
        redrawn, told = mode.signature is Signature.REDRAWN_OFFSET, self.error_ranges
        if isinstance(told, Mapping):
            told = told.get(model.motor_names[motor])
        if redrawn and told is not None:
            return SizePrior.even(told)
        if model.settings.least_error_rad:
            ranges = model.settings.error_ranges if redrawn else (mode.considered,)
            return SizePrior.even(ranges)
        return visible_sizes(mode, model, motor)


LARGEST_ERROR_RAD = 0.9
"""Largest steady-state error considered where nothing is said of them [rad]."""
LEAST_ERROR = 0.5
"""Smallest size considered, in the angle that one settled position shows: a few of them show less,
and what nothing shows keeps "healthy" from being surer than it can be."""
LARGER = 2.5
"""Where each range of sizes begins, in the begin of the one before."""
GROWN_S = 10.0
"""Time in which the slowest drift comes to what can be seen [s]: a run."""


WITHIN_A_DAY = 0.02
"""Probability that a fault is smaller than what healthy motors differ by from day to day, where so
little shows: not none, lest "healthy" be surer than it can be; assumed."""


def visible_sizes(mode: FaultMode, model: HealthyModel, motor: int, smaller: int = 0) -> SizePrior:
    """Return sizes of a fault of a motor, from what can be seen of it to the mode's largest.

    Each range is as wide as the paper's, five times its least size, and begins at 2.5 times that of
    the one before: all orders of magnitude are as likely, but for those below what healthy motors
    of the kind differ by from day to day.

    Args:
        mode: The mode; its sizes are offsets [rad], or grow with the time [rad/s].
        model: The healthy robot.
        motor: Index of the motor.
        smaller: Ranges that are added below what one settled position shows, as many movements
            together show less.
    """
    low, high = model.twin.robot.travel[motor]
    largest = LARGEST_ERROR_RAD if mode.sizes is None else mode.considered[1]
    if model.twin.robot.slides[motor]:
        largest *= (high - low) / np.pi
    within = 1.0 / GROWN_S if mode.signature is Signature.GROWING_OFFSET else 1.0
    shown = within * LEAST_ERROR * model.least_visible[motor] / LARGER**smaller
    least = max(shown, within * _of_a_day(model, motor))
    count = 1 + max(0, int(np.ceil(np.log(largest / WIDEST_ERROR / least) / np.log(LARGER))))
    lows = np.geomspace(least, max(least, largest / WIDEST_ERROR), count).tolist()
    fewer = int(np.ceil(np.log(least / shown) / np.log(LARGER)))
    below = np.geomspace(shown, least, fewer, endpoint=False).tolist()
    tiny = WITHIN_A_DAY if below else 0.0
    shares = np.repeat([tiny / max(fewer, 1), (1.0 - tiny) / count], [fewer, count])
    ranges = tuple((low, WIDEST_ERROR * low) for low in (*below, *lows))
    return SizePrior(ranges, tuple(shares.tolist()), visible=True)


def shares_above(sizes: SizePrior, off_rad: FloatArray) -> FloatArray:
    """Return the share of each range in runs whose motor is off by so much anyhow, (run, range).

    Ranges that begin below `LEAST_ERROR` of it have `WITHIN_A_DAY` together: one moment shows too
    little of them.

    Args:
        sizes: Sizes of the fault.
        off_rad: Deviation of a healthy motor in one moment, (run,) [rad].
    """
    shares = np.tile(np.array(sizes.shares), (len(off_rad), 1))
    lows = np.array([low for low, _ in sizes.ranges])
    tiny = lows < LEAST_ERROR * off_rad[:, None]
    total = np.sum(shares * tiny, axis=1, keepdims=True)
    if not sizes.visible or not (total < 1.0).all():
        return shares
    left = np.minimum(total, WITHIN_A_DAY)
    rest = shares * (1.0 - left) / (1.0 - total)
    return np.where(tiny, shares * left / np.where(total > 0.0, total, 1.0), rest)


def _of_a_day(model: HealthyModel, motor: int) -> float:
    """Return what a healthy motor differs by from day to day [rad]; a fault is larger.

    Zero of a slide, and of a robot that is said to be ideal.
    """
    robot = model.twin.robot
    if robot.slides[motor] or model.imperfections.settling is None:
        return 0.0
    return class_of(robot).session_rad


MONITORING = Priors(healthy_odds=30.0)
"""Beliefs of who watches a robot at work: faults are rare, and a single movement that went wrong is
more often a lost command. Chosen on emulated robots: about one false alarm an hour."""


def priors_of(
    robot: Robot,
    error_range_counts: tuple[float, float] | None,
    onset_s: float | None,
    error_range: tuple[float, float, str] | None = None,
) -> Priors:
    """Return priors with what is known of the faults, the default for what is not.

    Args:
        robot: The robot, for its servo units and what its motors turn through.
        error_range_counts: Range of steady-state errors [servo units].
        onset_s: Onset of stuck faults [s].
        error_range: Range of steady-state errors and its unit, one of `ERROR_UNITS`; motors that
            are not measured in it keep the default.

    Raises:
        InputError: If the range is not 0 <= low < high, no motor can be off by that much, the unit
            is not known or fits no motor, both ranges are given, or the onset is negative.
    """
    priors = Priors()
    if error_range_counts is not None:
        if error_range is not None:
            raise InputError("--sse-range and --error-range say the same. Give one of them.")
        ranges = _error_ranges(robot, *error_range_counts, "counts", "--sse-range")
        priors = replace(priors, error_ranges=ranges)
    if error_range is not None:
        priors = replace(priors, error_ranges=_error_ranges(robot, *error_range, "--error-range"))
    if onset_s is not None:
        if not 0.0 <= onset_s < np.inf:
            raise InputError(f"--onset is {onset_s:g} s, expected 0 or more.")
        priors = replace(priors, onset=replace(priors.onset, known_s=onset_s))
    return priors


ERROR_UNITS = ("deg", "rad", "mm", "m", "counts", "percent")
"""Units of `--error-range`; per cent are of what a motor turns through."""


def _error_ranges(
    robot: Robot, low: float, high: float, unit: str, option: str
) -> dict[str, tuple[Range]]:
    """Return the range of errors of each motor that is measured in a unit [rad or m], by name.

    Args:
        robot: The robot.
        low: The least.
        high: The largest.
        unit: One of `ERROR_UNITS`.
        option: Where they come from, for errors.

    Raises:
        InputError: See `priors_of`.
    """
    if unit not in ERROR_UNITS:
        raise InputError(f"{option}: {unknown_name('unit', unit, ERROR_UNITS)}")
    if not 0.0 <= low < high < np.inf:
        raise InputError(f"{option} is {low:g} {high:g}, expected 0 <= LOW < HIGH.")
    factors = {
        motor: _in_si(robot, k, unit)
        for k, motor in enumerate(robot.motor_names)
        if unit == "percent" or robot.slides[k] == (unit in ("mm", "m"))
    }
    if not factors:
        kind = "turn. Expected deg, rad" if unit in ("mm", "m") else "slide. Expected mm, m"
        raise InputError(
            f"{option} is in {unit}, but all motors of {robot.name!r} {kind} or percent."
        )
    most = max(_turns_through(robot, robot.motor_names.index(m), unit) for m in factors)
    if high > most * (1.0 + 1e-9):
        span = f"{most:g} {unit}"
        if unit == "counts":
            degrees = np.rad2deg(most * robot.servo_units.rad_per_count)
            span = f"{most:g} servo units ({abs(degrees):.0f} deg)"
        raise InputError(
            f"{option} is {low:g} {high:g}, but the motors turn through {span} and can be off by "
            f"no more. Expected HIGH up to {most:g}."
        )
    return {motor: ((low * factor, high * factor),) for motor, factor in factors.items()}


def _in_si(robot: Robot, motor: int, unit: str) -> float:
    """Return how much a unit is of a motor [rad or m]."""
    if unit == "counts":
        return abs(robot.servo_units.rad_per_count)
    if unit == "percent":
        return 0.01 * float(np.ptp(robot.travel[motor]))
    return {"deg": float(np.deg2rad(1.0)), "mm": 1e-3}.get(unit, 1.0)


def _turns_through(robot: Robot, motor: int, unit: str) -> float:
    """Return what a motor turns or slides through, in a unit."""
    if unit == "counts":
        return robot.servo_units.high - robot.servo_units.low
    return float(np.ptp(robot.travel[motor])) / _in_si(robot, motor, unit)
