"""Runs out of exact desired paths: targets in whole servo units, ramps of published durations.

Settled poses come from a search over whole units, then start and durations from what leaves no
residual. Movements are solved from the last to the first: a motor 1 that a tool on its axis
hides is given away by the ramp that leaves the pose, not by the one that reaches it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.recovery.inverse_kinematics import EXACT_M, MOTORS, PlaneArm
from failuretwin.data_knowledge.recovery.ramp_fit import PathPart, Ramps
from failuretwin.data_knowledge.recovery.whole_unit_ramp import SeenRamp
from failuretwin.digital_model.twin import DigitalTwin

STILL_M = 1e-10
"""A tool that moves less from one sample to the next [m] rests."""
LEAST_REST = 5
"""Samples that a rest has at least; fewer are the turning point of a movement."""


class NoWholeUnitsError(Exception):
    """A path that no movements of whole units make; the text says where."""


@dataclass(frozen=True)
class Stretch:
    """A movement seen in a path.

    Attributes:
        first: Last sample before it moves; 0 also where the record begins within it.
        last: First sample after it; the last one also where the record ends within it.
    """

    first: int
    last: int


def find_stretches(path: FloatArray) -> list[Stretch]:
    """Return where an exact `path` (time, axis) [m] moves, in order."""
    moving = np.linalg.norm(np.diff(path, axis=0), axis=1) > STILL_M
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
    stretches: list[Stretch] = []
    for first, last in edges.reshape(-1, 2).tolist():
        if stretches and first - stretches[-1].last < LEAST_REST:
            first = stretches.pop().first
        stretches.append(Stretch(first, last))
    return stretches


def solve_run(path: PathPart, arm: PlaneArm) -> Movements:
    """Return the movements of one run, with a leading run axis of 1.

    A motor that stays has a duration of 0. Where a ramp is cut off by the end of the record and
    several targets and durations make what is seen of it, they are one of these; where next to
    nothing is seen, targets may be no whole units.

    Raises:
        NoWholeUnitsError: If no movements make this path.
    """
    stretches = find_stretches(path.point)
    if not stretches:
        return _one_run(_resting_pose(path, arm), [])
    ramps: list[Ramps] = []
    for stretch in reversed(stretches):
        ramps.append(_solve_stretch(path, stretch, arm, ramps[-1].origin if ramps else None))
    ramps.reverse()
    movements = _one_run(ramps[0].origin[0], ramps)
    off = DigitalTwin(arm.robot).path(movements.reference(path.time)[0]) - path.point
    if np.abs(off).max() > EXACT_M:
        at = path.time[np.abs(off).max(axis=1).argmax()]
        raise NoWholeUnitsError(f"at {at:.2f} s the tool does not rest where it should")
    return movements


def _one_run(initial: FloatArray, ramps: list[Ramps]) -> Movements:
    none = np.empty((0, MOTORS))
    target = np.concatenate([none, *(ramp.target for ramp in ramps)])
    origin = np.concatenate([none, *(ramp.origin for ramp in ramps)])
    duration = np.concatenate([none, *(ramp.duration for ramp in ramps)])
    return Movements(
        initial=initial[None],
        target=target[None],
        ramp_duration=np.where(target == origin, 0.0, duration)[None],
        start=np.concatenate([np.empty(0), *(ramp.start for ramp in ramps)])[None],
    )


def _resting_pose(path: PathPart, arm: PlaneArm) -> FloatArray:
    poses = arm.whole_poses(path.point[0])
    if not len(poses):
        raise NoWholeUnitsError("no pose in whole servo units puts the tool where it rests")
    return arm.units.to_rad(np.where(np.isnan(poses[0]), arm.units.to_counts(0.0), poses[0]))


def _solve_stretch(
    path: PathPart, stretch: Stretch, arm: PlaneArm, following: FloatArray | None
) -> Ramps:
    """Return one ramp.

    Args:
        path: The path of the run.
        stretch: Where the movement is.
        arm: The arm.
        following: Origin of the next movement, (1, motor) [rad]; None for the last one.
    """
    seen = path.take(slice(stretch.first, stretch.last + 1))
    begun = f"the movement at {seen.time[0]:.2f} s"
    origins = arm.units.to_rad(arm.whole_poses(seen.point[0]))
    targets = following
    if targets is None:
        targets = arm.units.to_rad(arm.whole_poses(seen.point[-1]))
    cut_off = following is None and stretch.last == len(path.time) - 1
    if not len(origins) and stretch.first > 0:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} begins")
    if not len(targets) and not cut_off:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} ends")
    if not len(origins) and not len(targets):
        raise NoWholeUnitsError("the record holds no settled pose")
    ramp = SeenRamp(seen, arm)
    pairs = product(origins, targets)
    if not len(origins):
        solved = _first(ramp.begun_before(target) for target in targets)
    else:
        solved = _first(ramp.between(origin, target) for origin, target in pairs)
    if solved is None and cut_off:
        solved = _first(ramp.cut_off(origin) for origin in origins)
    if solved is None:
        raise NoWholeUnitsError(f"no start and durations of the published kind make {begun}")
    return solved


def _first(ramps: Iterable[Ramps | None]) -> Ramps | None:
    return next((ramp for ramp in ramps if ramp is not None), None)
