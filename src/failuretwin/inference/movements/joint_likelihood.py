"""What every movement says of the angle of one motor, whatever becomes of the others.

As one motor moves and the others settle as healthy ones, the tool runs on a circle. Near the
angle that brings it nearest to where it was seen, the squared distance is a parabola: four
numbers say all that a movement can say of this motor, and any fault of it is weighed by them.

    D^2(phi) = D0^2 + P (phi - phi*)^2
    exp L_m(phi) = sum over a of w_a (1 - eps) t_nu(D_a^2(phi)) + eps / V

Where the tool is close to the axis the circle is small, and the nearest angle may be anywhere on
it. If the motor explains the position where it should be too, and the parabola denies that, the
parabola of where it should be counts.

Section: docs/inference.md#likelihood
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.compiled import compiled, laid_out
from failuretwin.core.numerics import log_fall
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import Explanation, HealthyModel, scattered

REFINEMENTS = 2
"""Newton steps from the point of the circle nearest to the tool; more change nothing."""
LONGEST_STEP_RAD = 0.3
"""Bound on such a step: near a singular pose the parabola promises too much."""
FURTHEST_OFF = 1.1
"""Share of its travel within which a motor may stand, on one side of its target."""
NEGLIGIBLE_NATS = 12.0
"""What lies this far below the tool being anywhere is left out."""
LARGEST_OFFSET_RAD = 0.9
"""Furthest from its target that a motor is taken to have settled without being stuck [rad]; the
largest encoder faults that are considered."""
EXPLAINED = 25.0
"""Squared distance by which the nearest angle may explain more than where a motor should be."""
DENIED = 4.0
"""Squared distance from the nearest angle to where a motor should be from which it is looked at."""
OVERSTATED = 1.2
"""So many times that distance, and 1 more, must the parabola of the nearest angle claim to be given
up: on larger circles it always claims a little too much."""
LEAST_PRECISION = 1e-3
"""Precision [1/rad2] below which a movement says nothing of the motor: the tool is on its axis."""


PerOutcome = Annotated[FloatArray, Axes("run", "movement", "outcome")]


@dataclass(frozen=True)
class JointLikelihood(ArrayStruct):
    """Evidence on the settled angle of one motor, (..., outcome) each.

    Leading axes are run and movement, and one more where another motor takes several angles.
    Outcomes that are not possible are zero throughout, their weight aside.

    Attributes:
        mode: Angle that brings the tool nearest to where it was seen [rad].
        precision: Curvature of the squared distance there [1/rad2].
        min_distance2: Squared distance at `mode`, in scales of the others' scatter.
        place: Angle at which the parabola was taken: `mode`, or `expected` [rad].
        log_weight: Log of the outcome's weight times the density's norm.
        expected: Angle at which the motor settles if it is healthy [rad].
        scatter: Scale of its own settled scatter [rad].
        held_scatter: The same if it is held.
        dof: Degrees of freedom of the scatter.
        dims: Dimensions in which what is seen can differ.
        outlier: Log density of the tool being anywhere, times its rate.
        usable: Movements with evidence, (run, movement).
        wraps: Whether angles a full turn apart, which are the same, may both come up.
        map_pose: Angles of all motors that explain the position best, with this motor at `mode` and
            the others scattered, (..., outcome, motor) [rad].
        faulty_baseline: Angle at which the motor settles if a fault takes it off its target, apart
            from what the fault itself adds [rad]: it sags in the pose that it is really in, for
            which `mode` stands.
    """

    mode: PerOutcome
    precision: PerOutcome
    min_distance2: PerOutcome
    place: PerOutcome
    log_weight: PerOutcome
    expected: PerOutcome
    scatter: float
    held_scatter: float
    dof: float
    dims: int
    outlier: float
    usable: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    wraps: bool
    map_pose: Annotated[FloatArray, Axes("run", "movement", "outcome", "motor")]
    faulty_baseline: PerOutcome

    def log_terms(self, angle: FloatArray, held: bool) -> FloatArray:
        """Return log weight times density of each outcome.

        Args:
            angle: Where the motor settles, scatter aside, (..., outcome) [rad].
            held: Whether the gear holds it there.
        """
        precision, log_weight = self._with_scatter(held)
        off = self.turned(angle - self.mode)
        return log_weight + log_fall(self.min_distance2 + precision * off**2, self.dof, self.dims)

    def log_density(self, angle: FloatArray, held: bool) -> FloatArray:
        """Return the log density of each settled position, whatever became of the commands.

        Args:
            angle: Where the motor settles, scatter aside, (..., node, outcome) [rad], or with
                a last axis of 1 if it is the same whatever became of the commands.
            held: Whether the gear holds it there.

        Returns:
            (..., node) [log 1/m3]; 0 for movements that are not usable.
        """
        precision, log_weight = self._with_scatter(held)
        *lead, outcomes = log_weight.shape
        nodes, own = angle.shape[-2:]
        of_items = laid_out(np.broadcast_to(angle, (*lead, nodes, own)))
        found = np.empty((*lead, nodes))
        _write_log_density(
            of_items.reshape(-1, nodes, own),
            self.mode.reshape(-1, outcomes),
            precision.reshape(-1, outcomes),
            self.min_distance2.reshape(-1, outcomes),
            log_weight.reshape(-1, outcomes),
            (self.outlier, self.dof, self.dims, self.wraps),
            found.reshape(-1, nodes),
        )
        usable = self.usable.reshape(self.usable.shape + (1,) * (found.ndim - 2))
        return np.where(usable, found, 0.0)

    def turned(self, off: FloatArray) -> FloatArray:
        """Return differences of angles, the shorter way around."""
        return off - 2.0 * np.pi * np.rint(off / (2.0 * np.pi)) if self.wraps else off

    def inflation(self, held: bool) -> FloatArray:
        """Return 1 + s^2 P, with s the scatter of the motor itself, (..., outcome)."""
        own = self.held_scatter if held else self.scatter
        return np.asarray(1.0 + own**2 * self.precision)

    def _with_scatter(self, held: bool) -> tuple[FloatArray, FloatArray]:
        """Return precision and log weight once the motor's own scatter counts."""
        inflation = self.inflation(held)
        return self.precision / inflation, self.log_weight - 0.5 * np.log(inflation)


@compiled
def _write_log_density(
    angle: FloatArray,
    mode: FloatArray,
    precision: FloatArray,
    min_distance2: FloatArray,
    log_weight: FloatArray,
    constants: tuple[float, float, int, bool],
    found: FloatArray,
) -> None:
    """Write log L of each settled position at each angle, (item, node); see `JointLikelihood`.

    Angles are (item, node, outcome or 1) [rad], what outcomes say (item, outcome). Constants are
    the log density of the tool being anywhere, degrees of freedom, dimensions, and whether angles
    wrap.
    """
    outlier, dof, dims, wraps = constants
    power, turn = -0.5 * (dof + dims), 2.0 * math.pi
    for i in range(found.shape[0]):
        found[i, :] = 1.0
        for k in range(mode.shape[1]):
            log_ratio, own = log_weight[i, k] - outlier, min(k, angle.shape[2] - 1)
            room = log_ratio + NEGLIGIBLE_NATS
            furthest = 2.0 * room if math.isinf(dof) else dof * math.expm1(-room / power)
            if not min_distance2[i, k] < furthest:
                continue
            for n in range(found.shape[1]):
                off = angle[i, n, own] - mode[i, k]
                if wraps:
                    off -= turn * np.rint(off / turn)
                square = min_distance2[i, k] + precision[i, k] * off * off
                if square < furthest:
                    log_fall = (
                        -0.5 * square if math.isinf(dof) else power * math.log1p(square / dof)
                    )
                    found[i, n] += math.exp(log_ratio + log_fall)
        for n in range(found.shape[1]):
            found[i, n] = outlier + math.log(found[i, n])


def joint_likelihoods(
    evidence: SettledEvidence,
    model: HealthyModel,
    outcomes: CommandOutcomes,
    motors: Sequence[int],
    *,
    other: int | None = None,
    other_angle: FloatArray | None = None,
    other_held: bool = False,
) -> list[JointLikelihood]:
    """Return what each movement says of some motors, each by itself.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        outcomes: What may have become of each movement.
        motors: Indices of the motors.
        other: Index of another motor that has a fault of its own, if any.
        other_angle: Where it settles, (run, movement, node, outcome) [rad].
        other_held: Whether the gear holds it there.
    """
    base, kept, direction = outcomes.base, outcomes.kept, outcomes.direction
    log_weight, point = outcomes.log_weight, evidence.point[:, :, None]
    another = model.none_held.copy()
    if other is not None and other_angle is not None:
        base, kept, direction = (part[:, :, None] for part in (base, kept, direction))
        log_weight, point = log_weight[:, :, None], point[:, :, None]
        base = np.repeat(base, other_angle.shape[2], axis=2)
        base[..., other] = other_angle
        another[other] = True
    lead = base.shape[:-1]
    worthwhile = np.isfinite(log_weight)
    worthwhile[..., 0] = True  # where the motor settles if it gets its command is always told
    possible = np.broadcast_to(worthwhile, lead)
    base, direction = base[possible], np.broadcast_to(direction, base.shape)[possible]
    point = np.broadcast_to(point, (*lead, point.shape[-1]))[possible]
    log_weight = np.broadcast_to(log_weight, lead)[possible]
    expected = model.settle(base, direction, another)
    # A leading axis for the motors: own marks each of them among all, (own, 1, motor).
    own = np.eye(len(model.scatter), dtype=bool)[list(motors)][:, None]
    rest = np.where(another & other_held, model.held_scatter, model.scatter)
    scale = np.where(own, 0.0, rest)
    angle = model.sensors.nearest(expected, own, point)
    for _ in range(REFINEMENTS):
        pose = np.where(own, angle[..., None], base)
        settled = model.settle(pose, direction, own | another)
        error, jacobian, spread = model.residual(point, settled, scale)
        lever = np.sum(jacobian * own[..., None, :], axis=-1)
        precision = spread.product(lever, lever)
        slope = spread.product(lever, error)
        step = slope / np.maximum(precision, LEAST_PRECISION)
        taken = np.clip(step, -LONGEST_STEP_RAD, LONGEST_STEP_RAD)
        angle = angle + taken
    square = spread.product(error, error) - taken * (2.0 * slope - precision * taken)
    settled = settled + scattered(spread, jacobian, scale, error - lever * taken[..., None])
    dof = model.settling.tail_dof
    found = _Parabola(angle, angle.copy(), precision, square, spread.log_norm(dof), settled)
    _take_where_they_should_be(found, model, point, expected, scale[:, 0], list(motors))
    settled = np.where(own, found.mode[..., None], found.settled)
    commanded = base - np.broadcast_to(kept, (*lead, kept.shape[-1]))[possible]
    beside = _beside(model, expected, direction, commanded, own, found.mode)
    weighed = log_weight + found.log_norm

    def everywhere(values: FloatArray, elsewhere: float = 0.0) -> FloatArray:
        filled = np.full((*lead, *values.shape[1:]), elsewhere)
        filled[possible] = values
        return filled

    return [
        JointLikelihood(
            mode=everywhere(found.mode[i]),
            precision=everywhere(found.precision[i]),
            min_distance2=everywhere(np.maximum(found.square[i], 0.0)),
            place=everywhere(found.place[i]),
            log_weight=everywhere(weighed[i], -np.inf),
            expected=everywhere(expected[..., motor]),
            scatter=float(model.scatter[motor]),
            held_scatter=float(model.held_scatter[motor]),
            dof=dof,
            dims=model.sensors.dims,
            outlier=model.outlier_log_density,
            usable=evidence.usable,
            wraps=_may_turn_around(model, motor),
            map_pose=everywhere(settled[i]),
            faulty_baseline=everywhere(beside[i]),
        )
        for i, motor in enumerate(motors)
    ]


@dataclass(frozen=True)
class _Parabola:
    """The squared distance by the angle of each motor, (own, ...) each.

    Attributes:
        mode: Angle at which it is least [rad].
        place: Angle at which it was taken [rad].
        precision: Its curvature [1/rad2].
        square: The least.
        log_norm: Log density there.
        settled: Angles of all motors there, scatter included, (own, ..., motor) [rad].
    """

    mode: FloatArray
    place: FloatArray
    precision: FloatArray
    square: FloatArray
    log_norm: FloatArray
    settled: FloatArray


def _take_where_they_should_be(
    found: _Parabola,
    model: HealthyModel,
    point: FloatArray,
    expected: FloatArray,
    scale: FloatArray,
    motors: list[int],
) -> None:
    """Take parabolas anew, in place, where motors explain positions that these deny them.

    Args:
        found: Parabolas at the nearest angles.
        model: The healthy robot.
        point: Settled positions, (..., channel) [m].
        expected: Angles at which motors settle if healthy, (..., motor) [rad].
        scale: Scatter of all motors but each of these, (own, motor) [rad].
        motors: Indices of these motors.
    """
    off = found.mode - expected[..., motors].T
    off -= 2.0 * np.pi * np.rint(off / (2.0 * np.pi))
    own = model.scatter[motors, None] ** 2
    beyond = found.precision / (1.0 + own * found.precision) * off**2
    of, at = np.nonzero(beyond > DENIED)
    if not len(of):
        return
    motor, own = np.array(motors)[of], own[of, 0]
    error, jacobian, spread = model.residual(point[at], expected[at], scale[of])
    lever = np.take_along_axis(jacobian, motor[:, None, None], axis=-1)[..., 0]
    precision, slope = spread.product(lever, lever), spread.product(lever, error)
    step = slope / np.maximum(precision, LEAST_PRECISION)
    square = spread.product(error, error) - step * (2.0 * slope - precision * step)
    exact = square + precision / (1.0 + own * precision) * step**2
    told = found.square[of, at] + beyond[of, at]
    some = (exact < found.square[of, at] + EXPLAINED) & (told > OVERSTATED * (exact + 1.0))
    left = error - lever * step[:, None]
    settled = expected[at] + scattered(spread, jacobian, scale[of], left)
    where = of[some], at[some]
    found.place[where] = expected[at, motor][some]
    found.mode[where] = found.place[where] + step[some]
    found.precision[where], found.square[where] = precision[some], square[some]
    found.log_norm[where] = spread.log_norm(model.settling.tail_dof)[some]
    found.settled[where] = settled[some]


def _beside(
    model: HealthyModel,
    expected: FloatArray,
    direction: FloatArray,
    base: FloatArray,
    own: BoolArray,
    angle: FloatArray,
) -> FloatArray:
    """Return where each motor settles that a fault takes towards some angle, (own, ...) [rad].

    Args:
        model: The healthy robot.
        expected: Angles at which the motors settle if healthy, (..., motor) [rad].
        direction: Sign of their last travel, (..., motor).
        base: Angles that they are commanded to, (..., motor) [rad]: an error is added to these, and
            not to the scatter that a motor keeps.
        own: Which motor is meant, (own, ..., motor).
        angle: Where the fault takes it, (own, ...) [rad].
    """
    far = LARGEST_OFFSET_RAD
    pose = np.where(own, np.clip(angle[..., None], expected - far, expected + far), expected)
    offset = model.settling.offset(model.twin.robot, pose, direction)
    return np.asarray(np.sum((base + offset) * own, axis=-1))


def _may_turn_around(model: HealthyModel, motor: int) -> bool:
    """Return whether a motor may be half a turn or more from where it should be."""
    low, high = model.twin.robot.travel[motor]
    return not model.twin.robot.slides[motor] and FURTHEST_OFF * (high - low) > np.pi


# What every movement says by itself: of a healthy robot, and of each motor alone.


@dataclass(frozen=True)
class MovementLikelihoods(ArrayStruct):
    """What every movement says by itself, whatever fault may have come later.

    Attributes:
        model: The healthy robot.
        outcomes: What may have become of each movement, given the movements before.
        explanation: How well each of them explains its settled position if no motor is faulty.
        profiles: What each movement says of each motor.
    """

    model: HealthyModel
    outcomes: CommandOutcomes
    explanation: Explanation
    profiles: tuple[JointLikelihood, ...]

    @property
    def terms(self) -> FloatArray:
        """Log weight times density of each outcome, (run, movement, outcome)."""
        return self.outcomes.log_weight + self.explanation.density

    @property
    def expected(self) -> FloatArray:
        """Where a healthy arm settles, (run, movement, outcome, motor) [rad]; 0 if impossible."""
        return np.stack([profile.expected for profile in self.profiles], axis=-1)


def movement_likelihoods(evidence: SettledEvidence, model: HealthyModel) -> MovementLikelihoods:
    """Return what every movement says by itself."""
    usual = model.outcomes_as_seen(evidence)
    explanation = model.explain(evidence, usual)
    found = model.filtered_outcomes(evidence, usual, explanation.density)
    profiles = joint_likelihoods(evidence, model, found, range(len(model.scatter)))
    return MovementLikelihoods(model, found, explanation, tuple(profiles))
