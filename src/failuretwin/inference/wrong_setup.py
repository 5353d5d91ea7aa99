"""Which simple mistake of a set-up explains a log that fits no hypothesis: units, frames, senses.

A mistake is undone on commands or tool positions and the healthy prediction asked again: the first
of the list that brings the tool near is told. Simple ones come first, since a frame turned anyhow
can explain few poses by chance.

Section: docs/registration.md#a-log-that-is-nowhere-near
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.registration import align, offset

NOWHERE = "the tool is nowhere near where it should be"
"""What is said of a run that fits no hypothesis."""
NEAR = 0.12
"""Median distance, in that of the poses from their middle, within which a set-up explains a log:
sag and scatter of a printed arm take up half of it."""
GAIN = 0.25
"""It must also be this much nearer than the set-up as it is, in the distance of that [-]."""
Away = Callable[[FloatArray], float]
"""How far the tool is off, by the angles taken for the commands [m]."""
FEWEST_TO_TURN = 4
"""Poses from which a turn of the frame is told: it has six numbers of its own."""
LENGTHS = {1e3: "millimetres", 1e2: "centimetres", 1e-3: "kilometres"}
"""Length units by the factor that they have against metres."""


@dataclass(frozen=True)
class Setup:
    """A mistake undone.

    Attributes:
        told: What it is and what to do, a clause.
        away: Median distance of the tool from where it then should be, in metres of the arm.
    """

    told: str
    away: float


def nowhere_near(twin: DigitalTwin, target: FloatArray, point: FloatArray) -> str:
    """Return why settled poses may fit no hypothesis, and what to do about it, a clause.

    Args:
        twin: Kinematics as the profile has them.
        target: Commanded angles, (pose, motor) [rad].
        point: Settled tool positions, (pose, 3) [m].
    """
    setup = wrong_setup(twin, target, point)
    if setup is not None:
        return setup.told
    return (
        "in this run alone no unit, axis, frame, sense or exchange of columns explains it; a "
        "spoilt sensor, another robot, or a fault beside a wrong set-up may"
    )


def wrong_setup(twin: DigitalTwin, target: FloatArray, point: FloatArray) -> Setup | None:
    """Return the simplest mistake that explains settled poses; None if none does.

    Args:
        twin: Kinematics as the profile has them.
        target: Commanded angles, (pose, motor) [rad].
        point: Settled tool positions, (pose, 3) [m].
    """
    if len(target) < 2:
        return None
    expected = twin.path(target)
    as_is = float(np.median(np.linalg.norm(point - expected, axis=1)))
    size = extent(expected)
    for setup in _setups(twin, target, point, expected):
        if setup.away < min(NEAR * size, GAIN * as_is):
            return setup
    return None


def extent(point: FloatArray) -> float:
    """Return the median distance of points (pose, 3) from their middle [m]."""
    return float(np.median(np.linalg.norm(point - np.median(point, axis=0), axis=1)))


def _setups(
    twin: DigitalTwin, target: FloatArray, point: FloatArray, expected: FloatArray
) -> Iterator[Setup]:
    def away(angles: FloatArray) -> float:
        return float(np.median(np.linalg.norm(point - twin.path(angles), axis=1)))

    for factor, unit in LENGTHS.items():
        off = float(np.median(np.linalg.norm(point / factor - expected, axis=1)))
        yield Setup(f"tool positions look like {unit}: say so as the unit of the tool", off)
    for factor, unit in ((np.pi / 180.0, "degrees"), (180.0 / np.pi, "radians taken for degrees")):
        yield Setup(
            f"commands look like {unit}: say so as the unit of the commands", away(target * factor)
        )
    yield from _of_motors(twin, target, away)
    yield from _of_axes(point, expected)
    yield from _of_frames(point, expected)


def _of_axes(point: FloatArray, expected: FloatArray) -> Iterator[Setup]:
    for signs in list(product((1.0, -1.0), repeat=3))[1:]:
        axes = " and ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0.0)
        off = float(np.median(np.linalg.norm(point * signs - expected, axis=1)))
        yield Setup(f"{axes} of the tool seem to point the other way: is this the base frame?", off)
    for order in list(permutations(range(3)))[1:]:
        names = ", ".join("xyz"[axis] for axis in order)
        off = float(np.median(np.linalg.norm(point[:, order] - expected, axis=1)))
        yield Setup(f"the tool's columns x, y, z seem to hold {names}: exchange them", off)


def _of_motors(twin: DigitalTwin, target: FloatArray, away: Away) -> Iterator[Setup]:
    names = [spoken(twin, k) for k in range(target.shape[1])]
    for k, name in enumerate(names):
        turned = target.copy()
        turned[:, k] *= -1.0
        yield Setup(
            f"{name} seems to turn the other way: reverse its sense in the profile, or its sign in "
            "the column map",
            away(turned),
        )
    for a, b in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[a, b]] = b, a
        yield Setup(
            f"the commands of {names[a]} and {names[b]} seem to be swapped: exchange their columns",
            away(target[:, order]),
        )


def _of_frames(point: FloatArray, expected: FloatArray) -> Iterator[Setup]:
    shift, away = offset(expected, point)
    x, y, z = (1e3 * shift).tolist()
    yield Setup(
        f"off by the same {1e3 * np.linalg.norm(shift):.0f} mm after every movement "
        f"({x:.0f}, {y:.0f}, {z:.0f} mm): is this the base frame? {FIT}",
        away,
    )
    if len(point) < FEWEST_TO_TURN:
        return
    frame = align(expected, point)
    yield Setup(
        f"in a frame turned by {np.rad2deg(frame.angle):.0f} deg and shifted by "
        f"{1e3 * np.linalg.norm(frame.origin):.0f} mm the tool is where it should be: is this the "
        f"base frame? {FIT}",
        frame.away,
    )


FIT = "`failuretwin robot fit` puts the frame into the profile"


def spoken(twin: DigitalTwin, motor: int) -> str:
    """Return how a motor is spoken of."""
    return twin.robot.motor_names[motor].replace("_", " ")
