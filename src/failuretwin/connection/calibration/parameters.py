"""What was learned as figures with 95 % intervals: shares from counts, and the fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import brentq
from scipy.special import bdtr, betaincinv

from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.calibration.result import SETTLING_UNITS, Z_95, Parameter
from failuretwin.connection.calibration.settling_fit import (
    DOF_PRIOR_SPREAD,
    SettlingPosterior,
)
from failuretwin.connection.calibration.timing_fit import BOUNDS, TimingFit
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunSet, measured_rate
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.arm_classes import class_of
from failuretwin.digital_model.nonidealities import LostCommand, Range, Readings, Schedule, Timing
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import largest_load
from failuretwin.inference.together.habits import HEAVIEST, RATE_COUNT

# How often things go wrong by chance, from counts in healthy logs.

TRAVEL_RAD = 0.105
"""Travel below which a lost command cannot be told from a bad one [rad], 25 counts."""
LEVEL = (0.025, 0.975)
PRIOR_MOVEMENTS = 2.0
"""Late movements that the rate of the punctual ones is worth."""


@dataclass(frozen=True)
class Rate:
    """A share estimated from a count, with a Beta prior: the Jeffreys prior, or what is usual.

    Attributes:
        hits: How often it happened.
        trials: Out of how many.
        usual: Mean of the prior [-].
        weight: Trials that the prior counts for.
    """

    hits: int
    trials: int
    usual: float = 0.5
    weight: float = 1.0

    @property
    def mean(self) -> float:
        """Posterior mean [-]."""
        return (self.hits + self.weight * self.usual) / (self.trials + self.weight)

    @property
    def identified(self) -> bool:
        """Whether it was seen to happen; otherwise there is only a bound from above."""
        return self.hits > 0

    @property
    def interval(self) -> Range:
        """95 % interval [-]; it reaches 0 or 1 where nothing or everything was hit.

        What is called identified has been seen at least once, and of rare things that alone makes
        the count too high: the interval is that of a binomial count which is not 0. Half the
        probability of the count itself lies on either side (mid-P), as with the Jeffreys prior.
        """
        if self.hits == 0:
            return 0.0, 1.0 if self.trials == 0 else float(
                betaincinv(0.5, self.trials + 0.5, LEVEL[1])
            )
        low = 0.0 if self._below(0.0) <= LEVEL[1] else self._rate_at(LEVEL[1])
        return low, 1.0 if self.hits == self.trials else self._rate_at(LEVEL[0])

    def _below(self, rate: float) -> float:
        """Return the probability of fewer hits, and half that of as many, if there are any."""
        if rate == 0.0:
            return 0.5 if self.hits == 1 else 1.0
        none = (1.0 - rate) ** self.trials
        fewer, up_to = bdtr([self.hits - 1, self.hits], self.trials, rate)
        return float((0.5 * (fewer + up_to) - none) / (1.0 - none))

    def _rate_at(self, level: float) -> float:
        return float(brentq(lambda rate: self._below(rate) - level, 1e-9, 1.0 - 1e-9))


@dataclass(frozen=True)
class LossRates:
    """How often each set of motors loses a command, in punctual and in late movements."""

    motors: tuple[str, ...]
    punctual: Rate
    late: Rate

    def entry(self) -> LostCommand:
        """Return it as a value of the digital model."""
        return LostCommand(self.motors, self.punctual.mean, self.late.mean)


def loss_rates(
    observations: Observations,
    lost: BoolArray,
    punctual: BoolArray,
    delayed: BoolArray,
    robot: Robot,
) -> list[LossRates]:
    """Return the rate of each motor, of each pair, and of each larger set that was seen.

    Before any log the punctual rate is that of the arm's class, and the late one is the punctual.
    `lost` are the motors that stayed, (movement, motor); movements (run, movement) that are neither
    punctual nor delayed do not count.
    """
    at, names, kind = observations.at, robot.motor_names, class_of(robot)
    seen = {tuple(np.flatnonzero(row).tolist()) for row in lost if row.any()}
    usual_sets = {one for size in (1, 2) for one in combinations(range(len(names)), size)}
    rates = []
    for members in sorted(seen | usual_sets, key=lambda m: (len(m), m)):
        chosen = np.array(members)
        pattern = np.isin(np.arange(len(names)), chosen)
        exactly = (lost == pattern).all(axis=1)
        # A motor that is told to stay cannot be seen to lose a command.
        travel = np.abs(observations.target - observations.origin)[:, chosen].min(axis=1)
        told = travel > TRAVEL_RAD
        usual = kind.lost if len(members) == 1 else kind.lost_together
        on_time, late = (
            (int(np.sum(exactly & told & some)), int(np.sum(told & some)))
            for some in (punctual[at], delayed[at])
        )
        rate = Rate(*on_time, usual, RATE_COUNT)
        lost_late = Rate(*late, rate.mean, PRIOR_MOVEMENTS)
        rates.append(LossRates(tuple(names[m] for m in members), rate, lost_late))
    return rates


def glitch_rates(runs: RunSet) -> list[Rate] | None:
    """Return the share of spoilt readings of each motor; None where motors were not read."""
    if "position" not in runs:
        return None
    finite = np.isfinite(as_floats(runs["position"].values))
    rows = int(finite.any(axis=2).sum())
    return [Rate(rows - int(finite[..., motor].sum()), rows) for motor in range(finite.shape[2])]


def median_interval(values: FloatArray) -> tuple[float, float, float]:
    """Return the median and its 95 % interval by order statistics, whatever the distribution.

    How many of n values lie below the median is binomial; below six values even the extremes hold
    it less often than that.
    """
    from scipy.stats import binom

    ordered, count = np.sort(values), len(values)
    rank = int(binom.ppf(LEVEL[0], count, 0.5))
    low = ordered[max(rank - 1, 0)]
    high = ordered[min(count - rank, count - 1)]
    return float(np.median(values)), float(low), float(high)


def spread_of(values: FloatArray) -> Range:
    """Return the range of uniform draws, robustly: median and twice the median deviation."""
    middle = float(np.median(values))
    half = 2.0 * float(np.median(np.abs(values - middle)))
    return middle - half, middle + half


# Fits told as parameters: value, interval, and whether the logs say it at all.

LEARNED = 0.3
"""A parameter is identified if the logs bring its deviation below this share of the prior's."""
LOAD_FLOOR_NM = 1e-6
DELAY_BOUNDS = BOUNDS[0]
"""Where a delay that the logs do not tell may lie [s]."""
INVERSE_DOF_SPREAD = float(
    np.sqrt(np.expm1(DOF_PRIOR_SPREAD**2)) * np.exp(DOF_PRIOR_SPREAD**2 / 2.0)
)
"""Prior deviation of the inverse degrees of freedom, times their median: log-normal."""
UNLOADED = "gravity does not load this motor"

ADVICE = {
    "bias": "more movements that come to rest, to targets all over the range",
    "compliance": "movements of this motor with the arm stretched out to either side",
    "friction": "movements to the same pose from both sides",
    "scatter": "more movements that come to rest",
    "tail_dof": "a hundred movements or more",
}


def settling_parameters(fit: SettlingPosterior, robot: Robot, payload: float) -> list[Parameter]:
    """Return bias, compliance, friction and scatter of each motor, and the tails."""
    load = largest_load(robot, payload)
    found = []
    for group, (name, unit) in enumerate(SETTLING_UNITS.items()):
        for k, motor in enumerate(robot.motor_names):
            at = group * len(load) + k
            value, deviation = float(fit.mode[at]), float(fit.deviation[at])
            learned = bool(deviation < LEARNED * fit.prior_deviation[at])
            note = "" if learned else f"the logs do not say; it takes {ADVICE[name]}"
            if name == "compliance" and load[k] < LOAD_FLOOR_NM:
                learned, note = False, UNLOADED
            figure = Parameter.normal(name, motor, unit, value, deviation, learned, note)
            found.append(figure.exponential if name == "scatter" else figure)
    return [*found, _tails(fit, robot)]


def spring_remarks(settling: Sequence[Parameter]) -> list[str]:
    """Return a sentence for each motor that seems to rise against gravity."""
    return [
        f"compliance of {p.motor}: {p.value:.2g} {p.unit} ({p.low:.2g} to {p.high:.2g}) is "
        "negative, as if the motor rose against gravity; check its sense, the masses of the URDF "
        "and the payload. The figure is used as it is"
        for p in settling
        if p.name == "compliance" and p.note != UNLOADED and p.value < 0.1 * (p.value - p.high)
    ]


FAR_OFF = 5.0
"""Constant errors beyond so many deviations of what arms of the class have are told."""


def zero_remarks(settling: Sequence[Parameter], robot: Robot) -> list[str]:
    """Return a sentence for each motor that stands further off than arms of its class do.

    It is learned all the same: a calibration need not know whether motor or profile is off.
    """
    far = FAR_OFF * class_of(robot).bias_rad
    told = []
    for p in settling:
        if p.name == "bias" and p.unit == "rad" and min(abs(p.low), abs(p.high)) > far:
            low, value, high = np.rad2deg([p.low, p.value, p.high])
            told.append(
                f"bias of {p.motor}: it stands {value:+.1f} deg off ({low:+.1f} to {high:+.1f}) in "
                "every movement, further than healthy arms of its class: a zero that is off. It "
                "is learned as this robot's; if it is so in these logs alone, correct the logs"
            )
    return told


def _tails(fit: SettlingPosterior, robot: Robot) -> Parameter:
    """Return the degrees of freedom, with an interval that is even about their inverse.

    How well logs tell the inverse hardly depends on what it is. They tell the figure itself the
    better the lower it seems: to judge by that would pick those who are sure by chance.
    """
    dof = float(np.exp(fit.mode[-1]))
    inverse, deviation = 1.0 / dof, float(fit.deviation[-1]) / dof
    low, least = 1.0 / (inverse + Z_95 * deviation), inverse - Z_95 * deviation
    before = INVERSE_DOF_SPREAD / class_of(robot).tail_dof
    learned = deviation < LEARNED * before and dof > 1.05 * HEAVIEST
    note = "" if learned else f"the logs hardly say; it takes {ADVICE['tail_dof']}"
    high = 1.0 / least if least > 0.0 else float("inf")
    return Parameter("tail_dof", "", "-", dof, low, high, learned, note)


def timing_parameters(fit: TimingFit | None) -> list[Parameter]:
    """Return mean delay and shortening over runs, and the lag."""
    if fit is None:
        note = "fewer than three runs show ramps that begin on time at a known place"
        return [Parameter("delay", "", "s", 0.0, *DELAY_BOUNDS, False, note)]
    kinds = (
        ("delay, mean over runs", "s", float(fit.delay.mean()), -np.inf),
        ("ramp shortening, mean over runs", "share", float(fit.shortening.mean()), -np.inf),
        ("lag", "s", fit.lag, 0.0),
    )
    return [
        Parameter(name, "", unit, value, max(value - half, least), value + half)
        for (name, unit, value, least), half in zip(kinds, fit.doubt, strict=True)
    ]


def rate_parameter(name: str, motor: str, rate: Rate) -> Parameter:
    """Return a share estimated from a count; one that was never seen has but an upper bound."""
    low, high = rate.interval
    note = ""
    if not rate.identified:
        note = f"never seen in {rate.trials} cases, so {100.0 * high:.2g} % at most"
        note += "; it takes longer logs"
    return Parameter(name, motor, "share", rate.mean, low, high, rate.identified, note)


def loss_parameters(losses: Sequence[LossRates]) -> list[Parameter]:
    """Return the share of lost commands of each motor, punctual and late apart.

    And of each set of motors that was seen to lose one together.
    """
    found = []
    for loss in losses:
        if len(loss.motors) > 1 and not (loss.punctual.identified or loss.late.identified):
            continue
        motors = "+".join(loss.motors)
        found.append(rate_parameter("lost commands", motors, loss.punctual))
        if loss.late.trials:
            found.append(rate_parameter("lost commands when late", motors, loss.late))
    return found


# What was learned between the plateaus, as values of the digital model and as parameters.

FEWEST = 6
"""Values below which nothing is said of how they spread."""


def timing_of(fit: TimingFit | None, late: FloatArray, gaps: FloatArray) -> Timing:
    """Return how motions run late.

    Without a fit the logs say nothing of delay, shortening and lag.
    """
    timing = Timing()
    if fit is not None:
        timing = replace(
            timing,
            delay_s=spread_of(fit.delay),
            ramp_shortening=spread_of(fit.shortening),
            lag_s=(fit.lag, fit.lag),
        )
    starts = late[late > 0.0]
    if len(starts) < FEWEST:
        return timing
    return replace(
        timing,
        late_rate=late_rate(late).mean,
        late_s=_above_zero(spread_of(starts)),
        gap_start_s=_above_zero(spread_of(gaps)) if len(gaps) else (0.0, 0.0),
    )


def late_rate(late: FloatArray) -> Rate:
    """Return the share of late movements; nothing before the first one of a run can stall."""
    after_first = late[:, 1:]
    known = after_first[np.isfinite(after_first)]
    return Rate(int(np.sum(known > 0.0)), len(known))


def _above_zero(values: Range) -> Range:
    return max(values[0], 0.0), max(values[1], 0.0)


def schedule_of(movements: Movements, late: FloatArray, robot: Robot) -> Schedule:
    """Return the schedule of the logs; runs of another length keep its pace."""
    first = movements.start[:, 0]
    spacing = np.diff(movements.start, axis=1)
    punctual = spacing[np.nan_to_num(late[:, :-1], nan=1.0) == 0.0]
    if len(punctual) == 0:
        return Schedule()
    whole = False
    if robot.profile.servo_units is not None:
        counts = robot.servo_units.to_counts(movements.target[movements.exists])
        whole = bool(np.max(np.abs(counts - np.rint(counts))) < 1e-6)
    return Schedule(
        first_start_s=(float(np.nanmin(first)), float(np.nanmax(first))),
        period_s=(float(punctual.min()), float(punctual.max())),
        whole_counts=whole,
    )


def readings_of(runs: RunSet, robot: Robot, glitches: Sequence[Rate] | None) -> Readings:
    """Return how the sensors sample: their rate, whole counts, spoilt readings."""
    whole = False
    if robot.profile.servo_units is not None and "position" in runs:
        position = runs["position"].values
        counts = robot.servo_units.to_counts(position[np.isfinite(position)])
        whole = bool(np.mean(np.abs(counts - np.rint(counts)) < 1e-3) > 0.95)
    return Readings(
        rate_hz=measured_rate(runs),
        whole_counts=whole,
        glitch_rate=tuple(rate.mean for rate in glitches or ()),
    )


def lateness_parameters(late: FloatArray, gaps: FloatArray) -> list[Parameter]:
    """Return the rate of late starts, how late they are, and when readings stop before them."""
    if np.isnan(late).all():
        note = "commands do not come at a steady pace; send them on a fixed schedule"
        return [Parameter("late starts", "", "share", 0.0, 0.0, 1.0, False, note)]
    found = [rate_parameter("late starts", "", late_rate(late))]
    for name, values in (("late start, median", late[late > 0.0]), ("readings stop, median", gaps)):
        if len(values) >= FEWEST:
            found.append(Parameter(name, "", "s", *median_interval(values)))
    return found
