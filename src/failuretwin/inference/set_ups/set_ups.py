"""Wrong set-ups of a log, one mistake each: senses, order, units, axes, zeros and frames.

Every mistake is stated by the correction that undoes it, with what to say of it and what to do.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.registration import align, offset

SHARES = {"sense": 0.2, "order": 0.2, "axes": 0.15, "unit": 0.1, "zero": 0.25, "frame": 0.1}
"""What is wrong with a set-up that is wrong in one way: prior by kind; assumed."""
LENGTHS = {1e3: "millimetres", 1e2: "centimetres", 1e-3: "kilometres"}
"""Length units by the factor that they have against metres."""
FEWEST_TO_TURN = 4
"""Poses from which a turn of the frame is told: it has six numbers of its own."""
FIT = "`failuretwin robot fit` puts the frame into the profile"


@dataclass(frozen=True)
class SetUp:
    """A set-up that a log may have been made with.

    Attributes:
        what: What is wrong, a clause; empty: nothing.
        mend: What to do about it, a clause.
        correction: What makes such a log fit the profile.
        log_prior: Log of its probability, for zeros and frames with what they were chosen from.
        kind: One of `SHARES`, or clock; empty: nothing is wrong.
    """

    what: str
    mend: str
    correction: LogCorrection
    log_prior: float = 0.0
    kind: str = ""

    @property
    def told(self) -> str:
        """What is wrong and what to do."""
        return f"{self.what}: {self.mend}"

    def beside(self, first: SetUp) -> SetUp:
        """Return both mistakes at once, `first` undone first."""
        if not first.what:
            return self
        return SetUp(
            f"{first.what}, and {self.what}",
            first.mend if self.mend == first.mend else f"{first.mend}; {self.mend}",
            self.correction.after(first.correction),
            self.log_prior + first.log_prior,
            self.kind,
        )


def spoken(robot: Robot, motor: int) -> str:
    """Return how a motor is spoken of."""
    return robot.motor_names[motor].replace("_", " ")


def mistakes(robot: Robot) -> list[SetUp]:
    """Return the mistakes that have no number of their own, the simplest first."""
    found = [*_units(robot), *_senses(robot), *_orders(robot), *_axes(robot)]
    counts = {kind: sum(one.kind == kind for one in found) for kind in SHARES}
    return [replace(s, log_prior=float(np.log(SHARES[s.kind] / counts[s.kind]))) for s in found]


def _units(robot: Robot) -> list[SetUp]:
    none = LogCorrection.none(len(robot.motors))
    found = [
        SetUp(
            f"tool positions look like {unit}",
            "say so as the unit of the tool",
            replace(none, M=none.M / factor),
            kind="unit",
        )
        for factor, unit in LENGTHS.items()
    ]
    if robot.slides.any():
        return found
    for factor, unit in ((np.pi / 180.0, "degrees"), (180.0 / np.pi, "radians taken for degrees")):
        correction = replace(none, C=none.C * factor)
        mend = "say so as the unit of the commands"
        found.append(SetUp(f"commands look like {unit}", mend, correction, kind="unit"))
    return found


def _senses(robot: Robot) -> list[SetUp]:
    none = LogCorrection.none(len(robot.motors))
    mend = "reverse its sense in the profile, or its sign in the column map"
    found = []
    for k in range(len(robot.motors)):
        correction = replace(none, C=np.diag(np.where(np.arange(len(none.z)) == k, -1.0, 1.0)))
        what = f"{spoken(robot, k)} turns the other way"
        found.append(SetUp(what, mend, correction, kind="sense"))
    return found


def _orders(robot: Robot) -> list[SetUp]:
    none = LogCorrection.none(len(robot.motors))
    found = []
    for a, b in combinations(range(len(robot.motors)), 2):
        order = np.arange(len(none.z))
        order[[a, b]] = b, a
        what = f"the commands of {spoken(robot, a)} and {spoken(robot, b)} are swapped"
        correction = replace(none, C=none.C[order])
        found.append(SetUp(what, "exchange their columns", correction, kind="order"))
    return found


def _axes(robot: Robot) -> list[SetUp]:
    none = LogCorrection.none(len(robot.motors))
    found = []
    for signs in list(product((1.0, -1.0), repeat=3))[1:]:
        names = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0.0]
        what = f"{' and '.join(names)} of the tool point{'s' if len(names) == 1 else ''} the other "
        mend = "is this the base frame?"
        correction = replace(none, M=np.diag(signs))
        found.append(SetUp(f"{what}way", mend, correction, kind="axes"))
    for order in list(permutations(range(3)))[1:]:
        names = ["xyz"[axis] for axis in order]
        what = f"the tool's columns x, y, z hold {', '.join(names)}"
        correction = replace(none, M=none.M[list(order)])
        found.append(SetUp(what, "exchange them", correction, kind="axes"))
    return found


# Mistakes that hide where the tool rests, so that nothing else can be asked before.

UNIT_FACTOR = 8.0
"""Extents that differ by so much are no matter of senses: the unit of lengths is another [-]."""
MOST_RAD = 20.0
"""Commands beyond three turns are no angles in rad."""
LEAST_RAD = 0.05
"""Commands that stay within this of their middle are hardly all in rad."""


def extent(point: FloatArray) -> float:
    """Return the median distance of points (pose, 3) from their middle [m]."""
    return float(np.median(np.linalg.norm(point - np.median(point, axis=0), axis=1)))


def gross_unit(twin: DigitalTwin, command: FloatArray, point: FloatArray) -> SetUp | None:
    """Return the unit that commands or tool positions are in; None: that of the profile.

    Args:
        twin: Kinematics as the profile has them.
        command: Commands, (time, motor) [rad].
        point: Where the tool was seen about then, (time, 3) [m].
    """
    units = {one.what: one for one in mistakes(twin.robot) if one.kind == "unit"}
    lengths = {
        factor: units[f"tool positions look like {unit}"] for factor, unit in LENGTHS.items()
    }
    turns = not twin.robot.slides.any()
    if turns and np.abs(command).max(initial=0.0) > MOST_RAD:
        return units["commands look like degrees"]
    ratio = extent(point) / max(extent(twin.path(command)), 1e-9)
    if 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR or ratio == 0.0:  # zero: it never moves
        return None
    if turns and np.abs(command - np.median(command, axis=0)).max() < LEAST_RAD:
        return units["commands look like radians taken for degrees"]
    factor = min(LENGTHS, key=lambda known: abs(np.log(ratio / known)))
    return lengths[factor] if abs(np.log(ratio / factor)) < np.log(UNIT_FACTOR) / 2.0 else None


def clocks_apart(robot: Robot, late_s: float) -> SetUp:
    """Return the mistake that the tool's clock is late by so much [s]."""
    what = f"the tool's clock is {abs(late_s):.2g} s {'behind' if late_s > 0 else 'ahead of'} the "
    none = LogCorrection.none(len(robot.motors))
    mend = "bring both to one clock"
    return SetUp(f"{what}commands'", mend, replace(none, late_s=late_s), kind="clock")


# Mistakes that have numbers, which poses tell.


def shifted(robot: Robot, expected: FloatArray, point: FloatArray) -> SetUp:
    """Return the shift of the tool that explains settled poses best.

    Args:
        robot: The robot.
        expected: Where the tool should be, (pose, 3) [m].
        point: Where it is seen, (pose, 3) [m].
    """
    shift, _ = offset(expected, point)
    x, y, z = (1e3 * shift).tolist()
    what = (
        f"off by the same {1e3 * np.linalg.norm(shift):.0f} mm after every movement "
        f"({x:.0f}, {y:.0f}, {z:.0f} mm)"
    )
    correction = replace(LogCorrection.none(len(robot.motors)), t=-shift)
    return SetUp(what, f"is this the base frame? {FIT}", correction, _frame(), "frame")


def turned(robot: Robot, expected: FloatArray, point: FloatArray) -> SetUp:
    """Return the turn and shift of the sensor that explain settled poses best; see `shifted`."""
    frame = align(expected, point)
    what = (
        f"in a frame turned by {np.rad2deg(frame.angle):.0f} deg and shifted by "
        f"{1e3 * np.linalg.norm(frame.origin):.0f} mm the tool is where it should be"
    )
    correction = replace(
        LogCorrection.none(len(robot.motors)), M=frame.R.T, t=-frame.R.T @ frame.origin
    )
    return SetUp(what, f"is this the base frame? {FIT}", correction, _frame(), "frame")


def _frame() -> float:
    return float(np.log(SHARES["frame"] / 2.0))


ZERO_RAD = np.deg2rad(10.0)
"""Half of the zeros that are off are so by about this [rad], the rest by anything; assumed."""


FAULT_OF_EVERY_RUN = "a fault that every run has"
"""What no log tells from a zero that is off."""


def zero_off(robot: Robot, motor: int, zero: float) -> SetUp:
    """Return the mistake that the zero of a motor is not where the profile has it.

    Args:
        robot: The robot.
        motor: Index of the motor.
        zero: Where it stands where the log says 0 [rad].
    """
    none = LogCorrection.none(len(robot.motors))
    size, unit = shown(robot, motor)
    near = 0.5 * np.exp(-0.5 * (zero / ZERO_RAD) ** 2) / (ZERO_RAD * np.sqrt(2.0 * np.pi))
    log_prior = np.log(SHARES["zero"] / len(robot.motors)) + np.log(near + 0.25 / np.pi)
    return SetUp(
        f"{spoken(robot, motor)} stands {size * zero:+.3g} {unit} off in every movement",
        f"a zero that is not where the profile has it, or {FAULT_OF_EVERY_RUN}",
        replace(none, z=np.where(np.arange(len(none.z)) == motor, zero, 0.0)),
        float(log_prior),
        "zero",
    )


def simple_set_ups(robot: Robot, expected: FloatArray, point: FloatArray) -> Sequence[SetUp]:
    """Return what may explain settled poses, the simplest first; see `shifted`."""
    found = [*mistakes(robot), shifted(robot, expected, point)]
    if len(point) >= FEWEST_TO_TURN:
        found.append(turned(robot, expected, point))
    return found


FAR_OFF = 3.0
"""Offsets so many deviations off what such robots do are told."""


def shown(robot: Robot, motor: int) -> tuple[float, str]:
    """Return factor and unit in which the zero of a motor is told, as sizes of faults are."""
    return (1e3, "mm") if robot.slides[motor] else (float(np.rad2deg(1.0)), "deg")


def odd_zero(robot: Robot, zero: FloatArray, deviations: FloatArray) -> str:
    """Return which zero is far off what such robots do; empty where none is.

    Args:
        robot: The robot.
        zero: Zeros of the motors, (motor,) [rad].
        deviations: How far off each is at least, in deviations of such robots, (motor,).
    """
    motor = int(np.argmax(deviations))
    if deviations[motor] < FAR_OFF:
        return ""
    size, unit = shown(robot, motor)
    return (
        f"{spoken(robot, motor)} rests {size * zero[motor]:+.2g} {unit} off what such robots "
        f"do (by {deviations[motor]:.1f} deviations at least): a zero that is off, or "
        f"{FAULT_OF_EVERY_RUN}"
    )
