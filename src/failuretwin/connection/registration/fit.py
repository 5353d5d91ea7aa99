"""From healthy logs to a profile that knows its frames: search, fit, see what poses cannot tell.

Section: docs/another_arm.md#fit-the-frame-and-the-geometry
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from failuretwin.connection.calibration.result import Parameter
from failuretwin.connection.registration.arm import Arm, Fitted, Poses, Posterior, fit
from failuretwin.connection.registration.search import search
from failuretwin.core.errors import InputError
from failuretwin.core.runs import RunSet, check_motors, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.digital_model.profile import Profile
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.settings import InferenceSettings
from failuretwin.inference.set_ups.registration import align
from failuretwin.inference.set_ups.set_ups import SetUp, extent, gross_unit, mistakes
from failuretwin.inference.set_ups.wrong_setup import NEAR, wrong_setup

FEWEST = 8
"""Settled poses below which no frame is fitted: with six numbers of the frame and three of the tool
that leaves one or two poses to tell a bad one by."""
LEARNED = 0.5
"""A number is identified if poses bring its deviation below this share of the prior's."""
NOT_TOLD = 0.7
"""A direction is not told by the poses where its deviation stays above this share of before."""
MAIN_PART = 0.35
"""Share of a direction from which a number is named as part of it."""
SWAPPED = 0.25
"""Columns are swapped if the tool is nearer than this share of its distance as it is [-]."""
FOLDS = 5
"""Every fifth pose is predicted by a fit to the others."""


@dataclass(frozen=True)
class Registration:
    """What settled poses say of frames, senses, zeros and geometry.

    Attributes:
        profile: The profile with all of it.
        parameters: Every number with its 95 % interval.
        poses: Number of settled poses.
        before_mm: How far the tool was from where the profile had put it, median over poses [mm].
        frames_mm: The same with frame, tool point, senses and zeros fitted alone.
        after_mm: The same with the geometry fitted too, of poses that the fit had not seen.
        noise_m: Standard deviation that is left on each axis [m].
        not_told: What the poses cannot tell, in sentences.
        remarks: What else the user should know, in sentences.
    """

    profile: Profile
    parameters: tuple[Parameter, ...]
    poses: int
    before_mm: float
    frames_mm: float
    after_mm: float
    noise_m: float
    not_told: tuple[str, ...]
    remarks: tuple[str, ...]


def fit_registration(
    runs: RunsLike, robot: Robot | str | Path, source: str = "", date: str = ""
) -> Registration:
    """Fit frames, tool point, senses, zeros and geometry to healthy logs.

    Args:
        runs: The logs as a run set, or where they are.
        robot: The robot, its name or its profile.
        source: Which logs these are.
        date: When it is done, as the profile will say.

    Raises:
        InputError: If there are too few poses, or no frame, sense or zero explains them; it says
            which simple mistake does.
    """
    robot = load_robot(robot)
    runs = as_runs(runs, robot)
    check_motors(runs, robot.name, robot.motor_names)
    poses = settled_poses(runs, robot)
    return register(poses, robot, source, date)


def register(poses: Poses, robot: Robot, source: str = "", date: str = "") -> Registration:
    """Fit frames, tool point, senses, zeros and geometry to settled poses.

    Raises:
        InputError: As `fit_registration`.
    """
    arm = Arm(robot)
    setup = gross_unit(DigitalTwin(robot), poses.target, poses.point)
    if setup is not None:
        raise InputError(f"{setup.told} in the column map.")
    best, others = search(arm, poses)
    _refuse_misfit(best, poses, robot)
    whole = _with_details(arm, best, poses)
    when = f" on {date}" if date else ""
    told = f"failuretwin robot fit{when}: {len(poses)} settled poses"
    told += f" of {source}" if source else ""
    return Registration(
        profile=_profile(robot, whole, told),
        parameters=_parameters(whole),
        poses=len(poses),
        before_mm=_middle_mm(poses.point - DigitalTwin(robot).path(poses.target)),
        frames_mm=_middle_mm(_error(best, poses)),
        after_mm=_unseen_mm(arm, whole, poses),
        noise_m=whole.told.noise,
        not_told=tuple(_not_told(whole)),
        remarks=tuple(_remarks(robot, others, whole, poses)),
    )


def settled_poses(runs: RunSet, robot: Robot) -> Poses:
    """Return the settled poses of healthy runs; runs that are labelled faulty are left out.

    Nothing but commands and tool positions is read.

    Raises:
        InputError: If there are too few.
    """
    truth = truth_of(runs)
    if truth is not None:
        runs = runs.isel(run=[i for i, fault in enumerate(truth) if fault == "healthy"])
    count = 0
    if runs.sizes["run"]:
        settled = Evidence(runs, InferenceSettings.of(robot)).sound.settled
        usable = settled.usable
        count = int(usable.sum())
    if count < FEWEST:
        unknowns = 4 * len(robot.motors) + 3
        raise InputError(
            f"the logs hold {count} poses in which a healthy arm rests, expected {FEWEST} at least "
            f"for frame and tool point, and {2 * unknowns} or more for the geometry of "
            f"{len(robot.motors)} joints. Let the arm rest in more poses, all over its range."
        )
    return Poses(settled.movements.target[usable], settled.point[usable])


def _with_details(arm: Arm, found: Posterior, poses: Poses) -> Posterior:
    unknowns = arm.details()
    begin = np.zeros(len(unknowns))
    begin[: len(found.values)] = found.values
    return fit(arm, found.start, unknowns, poses, begin)


def _error(found: Posterior, poses: Poses) -> FloatArray:
    torque = found.arm.torque(poses.target, found.start)
    return poses.point - found.expected(poses.target, torque)


def _unseen_mm(arm: Arm, whole: Posterior, poses: Poses) -> float:
    """Return the error of every fifth pose by a fit to the others, which begins at `whole` [mm]."""
    fold = np.arange(len(poses)) % FOLDS == FOLDS - 1
    others = fit(arm, whole.start, whole.unknowns, poses[np.flatnonzero(~fold)], whole.values)
    return _middle_mm(_error(others, poses[np.flatnonzero(fold)]))


def _middle_mm(error: FloatArray) -> float:
    """Return the median distance; poses that lost a command would make the rms [mm]."""
    return 1e3 * float(np.median(np.linalg.norm(error, axis=1)))


# Set-ups that no frame can mend.


def _refuse_misfit(found: Posterior, poses: Poses, robot: Robot) -> None:
    away = 1e-3 * _middle_mm(_error(found, poses))
    if away <= NEAR * extent(poses.point):
        return
    setup = wrong_setup(DigitalTwin(robot), poses.target, poses.point)
    setup = setup or _swapped(robot, poses, away)
    raise InputError(
        f"with the best frame, senses and zeros the tool is still {1e3 * away:.0f} mm off at "
        f"the median, so nothing is written. "
        + (
            f"Perhaps {setup.told}."
            if setup is not None
            else "Check that the logs are of this robot, and the units of the column map."
        )
    )


def _swapped(robot: Robot, poses: Poses, away: float) -> SetUp | None:
    """Return which two columns of commands are swapped in some frame; None if none are."""
    twin, swaps = DigitalTwin(robot), [one for one in mistakes(robot) if one.kind == "order"]
    expected = [twin.path(swap.correction.command(poses.target)) for swap in swaps]
    distance = [align(path, poses.point).away for path in expected]
    if not swaps or min(distance) > SWAPPED * away:
        return None
    return swaps[int(np.argmin(distance))]


# What was found, as a profile and in words.


def _profile(robot: Robot, fitted: Posterior, source: str) -> Profile:
    """Return the profile with what was fitted; the pose that is seen changes with senses alone."""
    profile, sense = robot.profile, fitted.start.sense
    if not np.array_equal(sense, robot.sensor_sense):
        motors = tuple(
            replace(m, sense=float(s)) for m, s in zip(profile.motors, sense, strict=True)
        )
        profile = replace(profile, motors=motors, sensor_pose="physical")
    return replace(
        profile,
        tool_xyz=fitted.tool_xyz,
        base_xyz_rpy=fitted.base_xyz_rpy,
        geometry=fitted.geometry(fitted.told.noise, source),
        imperfections=None,
    )


AXIS_NUMBERS = (
    ("axis shift x", "m"),
    ("axis shift y", "m"),
    ("axis tilt x", "rad"),
    ("axis tilt y", "rad"),
)
STEP = 1e-5
"""Step of the derivatives of the stated numbers, in prior standard deviations."""


def _parameters(found: Posterior) -> tuple[Parameter, ...]:
    """Return the stated numbers with their intervals (delta method)."""
    slopes = _slopes(found)
    deviations = np.sqrt(np.einsum("nu,uv,nv->n", slopes, found.told.covariance, slopes))
    priors = np.linalg.norm(slopes, axis=1)
    rows = []
    for one, deviation, prior in zip(_stated(found), deviations, priors, strict=True):
        if prior < 1e-9:  # fixed: no unknown moves it
            continue
        learned = bool(deviation < LEARNED * prior)
        note = "" if learned else "the poses do not say; it stays where the URDF puts it"
        known = one.name, one.motor, one.unit, one.value
        rows.append(Parameter.normal(*known, float(deviation), learned, note))
    return tuple(rows)


def _stated(fitted: Fitted) -> list[Parameter]:
    """Return the numbers of an arm as people read them, without their intervals.

    Places rather than changes; then shift and tilt of each axis in its own frame.
    """
    places, names = iter((*fitted.base_xyz_rpy, *fitted.tool_xyz)), fitted.arm.robot.motor_names
    numbers = []
    for unknown, value in zip(fitted.unknowns, fitted.values.tolist(), strict=True):
        if unknown.name.startswith("axis "):
            continue
        stated = next(places, value)
        if unknown.name == "zero" and unknown.motor is not None:
            stated = fitted.zero(unknown.motor)
        elif unknown.name == "sensor scale":
            stated = fitted.scale
        motor = "" if unknown.motor is None else names[unknown.motor]
        numbers.append(Parameter.normal(unknown.name, motor, unknown.unit, stated, 0.0))
    for j, motor in enumerate(names):
        axis = zip(AXIS_NUMBERS, fitted.moved(j).tolist(), strict=True)
        numbers += [Parameter.normal(name, motor, unit, value, 0.0) for (name, unit), value in axis]
    return numbers


def _slopes(fitted: Fitted) -> FloatArray:
    """Return the derivatives of the stated numbers by the unknowns, (number, unknown).

    Unknowns are in their prior standard deviations. Angles differ by less than half a turn.
    """
    angular = np.array([number.unit == "rad" for number in _stated(fitted)])
    columns = []
    for step in np.diag(STEP * fitted.unknowns.spread):
        ahead, behind = (
            np.array([n.value for n in _stated(replace(fitted, values=fitted.values + move))])
            for move in (step, -step)
        )
        change = ahead - behind
        change[angular] = (change[angular] + np.pi) % (2.0 * np.pi) - np.pi
        columns.append(change / (2.0 * STEP))
    return np.stack(columns, axis=1)


def _not_told(found: Posterior) -> list[str]:
    """Return the directions whose posterior is as wide as the prior, widest first."""
    size, ways = np.linalg.eigh(found.told.covariance)
    sentences = []
    for deviation, way in sorted(zip(np.sqrt(size), ways.T, strict=True), key=lambda p: -p[0]):
        if deviation < NOT_TOLD:
            break
        parts = np.flatnonzero(np.abs(way) > MAIN_PART)
        names = dict.fromkeys(_spoken(found, int(i)) for i in parts)
        sentences.append(" against ".join(names) if len(names) > 1 else "".join(names))
    return sentences


def _spoken(fitted: Fitted, index: int) -> str:
    unknown = fitted.unknowns[index]
    if unknown.motor is None:
        return unknown.name
    what = "place of the axis" if unknown.name.startswith("axis ") else unknown.name
    return f"{what} of {fitted.arm.robot.motors[unknown.motor].joint}"


def _remarks(
    robot: Robot, others: Sequence[Posterior], whole: Posterior, poses: Poses
) -> list[str]:
    names, sense = robot.motor_names, whole.start.sense
    turned = [n for n, now, was in zip(names, sense, robot.sensor_sense, strict=True) if now != was]
    remarks = [f"{name} turns the other way than the profile said" for name in turned]
    remarks += [_either(names, sense, other) for other in others]
    unknowns = len(whole.unknowns)
    if 3 * len(poses) < 6 * unknowns:
        remarks.append(
            f"{len(poses)} poses for {unknowns} unknowns: {2 * unknowns} poses all over the range "
            "would make the geometry sure"
        )
    if robot.profile.imperfections is not None:
        remarks.append(
            f"{robot.profile.imperfections} was learned with the geometry as it was before, so the "
            "new profile does not name it; run `failuretwin calibrate` with the new profile"
        )
    return remarks


def _either(names: list[str], sense: FloatArray, other: Posterior) -> str:
    """Return a sentence on another way to see the arm, and on what decides."""
    differ = [n for n, a, b in zip(names, sense, other.start.sense, strict=True) if a != b]
    up = "up" if other.turn[2, 2] > 0.0 else "down"
    return (
        f"either as fitted, or with {', '.join(differ)} turning the other way and the base's z "
        f"pointing {up} for the sensor: the poses cannot tell. Move {differ[0]} by hand or alone "
        "and see whether it turns as the URDF says; tool positions are the same either way"
    )
