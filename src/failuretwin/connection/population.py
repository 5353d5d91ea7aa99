"""What the robots of a fleet are like together: the prior of the next one.

A random-effects model (empirical Bayes). Of one figure of one motor, robot j has x_j, and its
calibration says y_j with the deviation s_j:

    x_j ~ N(mu, tau^2),    y_j ~ N(x_j, s_j^2)

What the class of the arm says, mu_0 and tau_0, counts as one robot of the mean and as three of the
deviation. With a_j = 1 / (tau^2 + s_j^2), A = sum a, sums over the n robots, y_a the mean by a:

    tau_y^2 = max(0, sum a (y - y_a)^2 - sum a s^2 + sum a^2 s^2 / A) / (A - sum a^2 / A)
    tau^2   = (3 tau_0^2 + k tau_y^2) / (3 + k),    k = (1 - 1/n) sum (tau^2 a)^2
    mu      = v (mu_0 / tau_0^2 + sum a y),    1/v = 1/tau_0^2 + A

in rounds from tau_0 on. tau_y is the method of moments (DerSimonian and Laird 1986, with any
weights DerSimonian and Kacker 2007): what the calibrations differ by, less what each doubts of
itself. k is how many degrees of freedom that has, n - 1 where nothing is doubted; robot j has the
information a_j^2 / 2 about tau^2. Two or three robots say little of a deviation. The next robot is
N(mu, tau^2 + v).

Section: docs/self_calibration.md#a-population-of-your-own-robots
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from failuretwin.connection.calibration.result import SETTLING_UNITS, Calibration, Parameter
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.arm_classes import class_of, generic_imperfections
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    RobotLike,
    calibrated,
    check_fit,
)
from failuretwin.digital_model.nonidealities import (
    SETTLING_LISTS,
    Imperfections,
    LostCommand,
    Readings,
    Schedule,
    Timing,
    Variation,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.together.habits import SCATTER_SPREAD

CLASS_ROBOTS = 3.0
"""Robots that the deviation of the class counts for; assumed."""
RATE_SPREAD = 0.7
"""Deviation of the logarithm of loss rates within a class, a factor of two; assumed."""
LEAST_ROBOTS = 2
"""Robots from which there is a population."""
ROUNDS = 50
"""Rounds of the deviation, each half the way in its logarithm; twenty are mostly enough."""
TOLD = 0.7
"""A self-calibrated figure counts where its runs narrow the doubt to this share of the class's."""
MOST_DOF = 50.0
"""Degrees of freedom from which tails count as normal."""
LEAST = 1e-12
"""Deviation that stands for none at all."""


@dataclass(frozen=True)
class Pooled:
    """What robots are like in some figures, see the formulas above.

    Attributes:
        mean: mu, (figure,).
        error: v^1/2, the deviation of that, (figure,).
        between: tau, what robots differ by, (figure,).
        told: Whether any robot says something of it, (figure,).
    """

    mean: FloatArray
    error: FloatArray
    between: FloatArray
    told: BoolArray

    @property
    def deviation(self) -> FloatArray:
        """Deviation of the next robot from the mean, (tau^2 + v)^1/2; the class's if none says."""
        return np.where(self.told, np.hypot(self.between, self.error), self.between)


def pool(value: FloatArray, doubt: FloatArray, usual: FloatArray, spread: FloatArray) -> Pooled:
    """Return the mean and the deviation between robots of some figures.

    Args:
        value: y of each robot, (robot, figure); NaN where it says nothing.
        doubt: s, (robot, figure).
        usual: mu_0, the mean of the class, (figure,).
        spread: tau_0, its deviation, (figure,).
    """
    spread2 = np.maximum(spread, LEAST) ** 2
    known = np.isfinite(value)
    y, s2 = np.where(known, value, 0.0), np.where(known, doubt, 0.0) ** 2
    between2 = spread2
    for _ in range(ROUNDS):
        moment, freedom = _moment(y, s2, known / (between2 + s2), between2)
        new = (CLASS_ROBOTS * spread2 + freedom * moment) / (CLASS_ROBOTS + freedom)
        between2 = np.sqrt(between2 * new)  # half the way: the whole way may swing
    a = known / (between2 + s2)
    precision = 1.0 / spread2 + a.sum(axis=0)
    mean = (usual / spread2 + np.sum(a * y, axis=0)) / precision
    return Pooled(mean, precision**-0.5, np.sqrt(between2), known.sum(axis=0) > 0)


def _moment(
    y: FloatArray, s2: FloatArray, a: FloatArray, between2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return tau_y^2 and k, (figure,) each, by weights a of which those of the unknown are 0."""
    count = np.sum(a > 0.0, axis=0)
    total = np.where(count > 0, a.sum(axis=0), 1.0)
    middle = np.sum(a * y, axis=0) / total
    left = total - np.sum(a**2, axis=0) / total
    stated = np.sum(a * s2, axis=0) - np.sum(a**2 * s2, axis=0) / total
    excess = np.maximum(np.sum(a * (y - middle) ** 2, axis=0) - stated, 0.0)
    moment = np.divide(excess, left, out=np.zeros_like(left), where=count > 1)
    freedom = (1.0 - 1.0 / np.maximum(count, 1)) * np.sum((between2 * a) ** 2, axis=0)
    return moment, freedom


@dataclass(frozen=True)
class Population:
    """What robots of one kind are like, fitted to the calibrations of some of them.

    It is the prior of a robot of which nothing is known: ``SelfCalibratingDiagnoser(robot, it)``
    and ``BayesDiagnoser(robot, it.imperfections)`` use it, and ``save_calibration(it.calibration,
    robot, path)`` keeps it for ``--calibration FILE``.

    Attributes:
        imperfections: Their means, and what robots differ by as variation.
        parameters: Each figure with the interval in which 95 % of such robots lie.
        robots: Names of the calibrations.
    """

    imperfections: Imperfections
    parameters: tuple[Parameter, ...]
    robots: tuple[str, ...]

    @classmethod
    def fit(
        cls,
        calibrations: Sequence[CalibratedRobot | Imperfections | str | Path],
        robot: RobotLike = "armpi_fpv",
    ) -> Population:
        """Return the population that some robots come from.

        Bias, compliance, friction and the logarithm of the scatter are pooled by the formulas of
        this module; the deviation of the bias has that from day to day on top. Rates of lost
        commands are means over the robots, the class as one more; times are medians; degrees of
        freedom of the tails are geometric means. Servo loops stay those of the profile, so the
        timing of a robot with loops of its own does not count.

        Args:
            calibrations: One of each robot, `LEAST_ROBOTS` at least: the robot with it, figures, or
                names or paths as for `load_calibration`.
            robot: What kind they are of.

        Raises:
            InputError: If there are fewer than two, one is given twice, is none of a robot or is of
                another kind.
        """
        model = calibrated(robot, "none").robot
        if isinstance(calibrations, str | Path) or len(calibrations) < LEAST_ROBOTS:
            count = 1 if isinstance(calibrations, str | Path) else len(calibrations)
            raise InputError(
                f"a population of {count} calibrations: expected those of two robots or more. "
                "Calibrate another robot of the kind."
            )
        known = [
            each if isinstance(each, CalibratedRobot) else calibrated(model, each)
            for each in calibrations
        ]
        for index, each in enumerate(known):
            _check(each, calibrations[index], model, known[:index])
        return _fitted(known, model)

    @property
    def calibration(self) -> Calibration:
        """The same as a calibration, to be saved."""
        return Calibration(
            imperfections=self.imperfections,
            parameters=self.parameters,
            sessions=self.robots,
            runs=0,
            movements=0,
            used_readings=False,
            remarks=(
                f"what {len(self.robots)} robots have in common, and differ by: a calibration of "
                "none of them",
            ),
        )


def _check(
    one: CalibratedRobot, given: object, robot: Robot, before: Sequence[CalibratedRobot]
) -> None:
    """Raise an error unless these are the figures of one robot of the kind, and new ones."""
    known = one.imperfections
    told = str(given) if isinstance(given, str | Path) else known.name
    if known.settling is None or known.of_class:
        raise InputError(
            f"{told}: says nothing of where one robot settles. Expected its calibration, as "
            "`failuretwin calibrate` writes it."
        )
    check_fit(known, robot, told)
    if len(known.settling.scatter) == 0 or min(known.settling.scatter) <= 0.0:
        raise InputError(
            f"{told}: settling: scatter is {list(known.settling.scatter)}, expected more than 0 of "
            "each motor. No robot settles exactly; calibrate it."
        )
    if any(other.imperfections == known for other in before):
        raise InputError(f"{told}: is given twice. Give one calibration of each robot.")


def _fitted(known: Sequence[CalibratedRobot], robot: Robot) -> Population:
    each = [one.imperfections for one in known]
    usual = generic_imperfections(robot)
    figures = {name: _figure(name, each, usual) for name in SETTLING_LISTS}
    names = tuple(one.name for one in each)
    name, source = f"population of {len(each)} robots", ", ".join(names)
    settlings = [one.settling or Settling() for one in each]
    dof = [min(settling.tail_dof, MOST_DOF) for settling in settlings]
    settling = Settling(
        bias=_listed(figures["bias"].mean),
        compliance=_listed(figures["compliance"].mean),
        friction=_listed(figures["friction"].mean),
        scatter=_listed(np.exp(figures["scatter"].mean)),
        tail_dof=float(np.exp(np.mean(np.log(dof)))),
        source=source,
        payload=float(np.mean([settling.payload for settling in settlings])),
    )
    profile = [m.imperfections for m in known if m.robot.motors == robot.motors]
    readings = [one.readings for one in each if one.readings is not None]
    bias = np.hypot(figures["bias"].deviation, class_of(robot).session_rad)
    others = figures["compliance"].deviation, figures["friction"].deviation
    scatter = _listed(figures["scatter"].deviation)
    doubt = Variation(scatter=scatter, rates=_rate_deviation(each, usual))
    imperfections = Imperfections(
        name=name,
        source=source,
        settling=settling,
        timing=_timing([one.timing for one in profile]),
        lost_commands=_losses(each, usual),
        schedule=_schedule([one.schedule for one in each]),
        readings=_typical(readings) if readings else None,
        variation=stated_variation(np.concatenate([bias, *others]), settling, doubt),
        of_class=True,
    )
    return Population(imperfections, tuple(_parameters(figures, imperfections, robot)), names)


def _listed(values: FloatArray) -> tuple[float, ...]:
    return tuple(values.tolist())


# What each calibration says of its robot, and what the class says.


def _figure(name: str, each: Sequence[Imperfections], usual: Imperfections) -> Pooled:
    """Return one kind of figure of all motors, pooled; the scatter by its logarithm."""
    mean, spread = _of(usual, name)
    pairs = [_likelihood(one, name, mean, spread) for one in each]
    value, doubt = (np.array(part) for part in zip(*pairs, strict=True))
    return pool(value, doubt, mean, spread)


def _of(one: Imperfections, name: str) -> tuple[FloatArray, FloatArray]:
    """Return a kind of figure and its doubt, (motor,) each: of compliance in its own unit.

    Of a class, which says nothing of how scatters differ, that is assumed.
    """
    settling, doubt = one.settling or Settling(), one.variation or Variation()
    motors = len(settling.scatter)
    value = np.array(getattr(settling, name) or (0.0,) * motors)
    stated = np.array(getattr(doubt, name) or (0.0,) * motors)
    if name == "scatter":
        if one.of_class:
            stated = np.full(motors, SCATTER_SPREAD)
        return np.log(value), stated
    return value, np.abs(value) * stated if name == "compliance" else stated


def _likelihood(
    one: Imperfections, name: str, usual: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the logs of a robot alone say of a kind of figure: y and s, (motor,) each.

    NaN where they say nothing: a compliance whose doubt is no share of it between 0 and 1 is not
    known where others are (calibrations state it so). What was self-calibrated (P1) has been drawn
    to its class by the share s^2 / tau_0^2, which is undone:

        y = mu_0 + (m - mu_0) / (1 - s^2 / tau_0^2),    s_y^2 = s^2 / (1 - s^2 / tau_0^2)
    """
    value, doubt = _of(one, name)
    if name == "compliance" and one.variation is not None and one.variation.compliance:
        share = np.asarray(one.variation.compliance)
        value = np.where((share > 0.0) & (share < 1.0), value, np.nan)
    if one.protocol != "P1" or name == "scatter":
        return value, doubt
    drawn = (doubt / np.maximum(spread, LEAST)) ** 2
    told = drawn < TOLD**2
    rest = np.where(told, 1.0 - drawn, 1.0)
    return np.where(told, usual + (value - usual) / rest, np.nan), doubt / np.sqrt(rest)


def stated_variation(
    deviation: FloatArray, settling: Settling, others: Variation | None = None
) -> Variation:
    """Return deviations as a calibration states them: of compliance as a share, 1 at most.

    `deviation` is of bias, compliance and friction, (3 motor,) or (3, motor), `others` all others.
    """
    bias, compliance, friction = deviation.reshape(3, -1)
    mean = np.abs(np.asarray(settling.compliance))
    share = np.divide(compliance, mean, out=np.zeros_like(mean), where=mean > 1e-9)
    return replace(
        others or Variation(),
        bias=_listed(bias),
        compliance=_listed(np.minimum(share, 1.0)),
        friction=_listed(friction),
    )


def _parameters(
    figures: dict[str, Pooled], found: Imperfections, robot: Robot
) -> Iterator[Parameter]:
    """Yield each figure with the interval of 95 % of robots; that of scatter is log-normal."""
    for name, pooled in figures.items():
        spread = pooled.deviation
        if name == "bias" and found.variation is not None:
            spread = np.asarray(found.variation.bias)
        for motor, mean, deviation, known, between in zip(
            robot.motor_names, pooled.mean, spread, pooled.told, pooled.between, strict=True
        ):
            note = "" if known else _untold(between)
            figure = Parameter.normal(
                name, motor, SETTLING_UNITS[name], float(mean), float(deviation), bool(known), note
            )
            yield figure.exponential if name == "scatter" else figure


def _untold(between: float) -> str:
    if between <= LEAST:
        return "gravity does not load this motor"
    return "no calibration tells it: as arms of its class"


# Rates, times and readings: means and medians.


def _losses(each: Sequence[Imperfections], usual: Imperfections) -> tuple[LostCommand, ...]:
    """Return the rates of lost commands: means over the robots, the class as one more.

    However many movements a calibration has seen, it is but one robot. Motors that it does not
    name together lose nothing together.
    """
    tables = [{frozenset(e.motors): e for e in one.lost_commands} for one in (usual, *each)]
    weight = 1.0 / len(tables)
    motors = {key: entry.motors for table in reversed(tables) for key, entry in table.items()}

    def rate(key: frozenset[str], of: Callable[[LostCommand], float]) -> float:
        return weight * sum(of(table[key]) for table in tables if key in table)

    return tuple(
        LostCommand(names, rate(key, lambda e: e.rate), rate(key, lambda e: e.rate_when_late))
        for key, names in motors.items()
    )


def _rate_deviation(each: Sequence[Imperfections], usual: Imperfections) -> float:
    """Return by how much the logarithm of loss rates differs between robots."""
    totals = [sum(entry.rate for entry in one.lost_commands) for one in (usual, *each)]
    logs = np.array([np.log(total) if total > 0.0 else np.nan for total in totals])
    doubts = np.array([one.variation.rates if one.variation else 0.0 for one in each])
    found = pool(logs[1:, None], doubts[:, None], logs[:1], np.array([RATE_SPREAD]))
    return float(found.deviation[0])


def _timing(each: Sequence[Timing]) -> Timing:
    """Return the timing of robots whose logs tell it, on top of the servo loops of the profile."""
    known = [timing for timing in each if timing != Timing()]
    if not known:
        return Timing()
    late = _typical([timing for timing in known if timing.late_rate > 0.0] or known)
    return replace(_typical(known), late_s=late.late_s, gap_start_s=late.gap_start_s)


def _schedule(each: Sequence[Schedule]) -> Schedule:
    return _typical([schedule for schedule in each if schedule != Schedule()] or [Schedule()])


Table = TypeVar("Table", Timing, Schedule, Readings)


def _typical(tables: Sequence[Table]) -> Table:
    """Return the typical table: means of rates, medians of other numbers, flags that all have."""
    values = {
        field.name: _middle(field.name, [getattr(table, field.name) for table in tables])
        for field in fields(tables[0])
    }
    return replace(tables[0], **values)


def _middle(name: str, values: Sequence[Any]) -> Any:
    if isinstance(values[0], bool):
        return all(values)
    known = [value for value in values if value != ()]
    if not known:
        return ()
    middle = (np.mean if name.endswith("_rate") else np.median)(np.array(known), axis=0)
    return middle.tolist() if middle.ndim == 0 else _listed(middle)
