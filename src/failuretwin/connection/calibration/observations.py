"""What healthy logs say of the motors: where each movement settled, by readings or by the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.settled_evidence import SettledEvidence, settled_evidence
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

STAYED_RAD = 0.035
"""A motor nearer than this to where it was [rad], about eight counts, may have lost its command."""
TRAVEL_RAD = 0.105
"""Travel below which a lost command cannot be told from a bad one [rad], 25 counts."""

FAR_OFF_M = 0.015
"""A tool nearer than this to where it is expected [m] gives no reason to think of lost commands."""


@dataclass(frozen=True)
class Observations:
    """Settled movements of many runs in a row, padding left out.

    Attributes:
        run: Index of the run, (movement,).
        session: Index of the session, (movement,).
        number: Number of the movement within its run, from 0, (movement,).
        origin: Angles that the motors were last told to go to, and went, (movement, motor) [rad].
        target: Commanded angles, (movement, motor) [rad].
        point: Settled tool position, (movement, axis) [m].
        position: Settled angles by the motors' readings, (movement, motor) [rad]; None where the
            log has none.
        sessions: Names of the sessions.
        runs: Names of the runs.
    """

    run: IntArray
    session: IntArray
    number: IntArray
    origin: FloatArray
    target: FloatArray
    point: FloatArray
    position: FloatArray | None
    sessions: tuple[str, ...]
    runs: tuple[str, ...]

    def __getitem__(self, kept: BoolArray | IntArray) -> Observations:
        """Return some of the movements."""
        return Observations(
            self.run[kept],
            self.session[kept],
            self.number[kept],
            self.origin[kept],
            self.target[kept],
            self.point[kept],
            None if self.position is None else self.position[kept],
            self.sessions,
            self.runs,
        )

    def __len__(self) -> int:
        """Return the number of movements."""
        return len(self.run)

    @property
    def direction(self) -> FloatArray:
        """Sign of the commanded travel, (movement, motor)."""
        return np.sign(self.target - self.origin)


def session_names(runs: xr.Dataset) -> list[str]:
    """Return the session of each run: its name without the last part, or its own name."""
    names = [str(name) for name in runs["run"].values]
    return [name.rpartition("/")[0] or name for name in names]


def observe(runs: xr.Dataset, *, use_readings: bool = True) -> Observations:
    """Return where the movements of a run set settled.

    Args:
        runs: Healthy runs.
        use_readings: Whether to look at the motors' own readings, where the runs have them.
    """
    evidence = settled_evidence(runs)
    movements = evidence.movements
    names = session_names(runs)
    sessions = tuple(dict.fromkeys(names))
    run, number = np.nonzero(evidence.usable)
    position = None
    if use_readings and "position" in runs:
        position = _settled_position(runs, evidence, run, number)
    found = Observations(
        run=run,
        session=np.array([sessions.index(name) for name in names])[run],
        number=number,
        origin=movements.origin()[run, number],
        target=movements.target[run, number],
        point=evidence.point[run, number],
        position=position,
        sessions=sessions,
        runs=tuple(str(name) for name in runs["run"].values),
    )
    if position is None:
        return found
    return found[np.asarray(np.isfinite(position).all(axis=1))]


def _settled_position(
    runs: xr.Dataset, evidence: SettledEvidence, run: IntArray, number: IntArray
) -> FloatArray:
    """Return the median of the readings over the same windows, (movement, motor) [rad]."""
    time = as_floats(runs["time"].values)
    position = as_floats(runs["position"].values)
    begin, end = evidence.begin[run, number], evidence.end[run, number]
    first, stop = np.searchsorted(time, begin), np.searchsorted(time, end - 1e-9)
    settled = np.full((len(run), position.shape[2]), np.nan)
    for i, at in enumerate(run):
        window = position[at, first[i] : stop[i]]
        seen = np.isfinite(window).any(axis=0)
        settled[i, seen] = np.nanmedian(window[:, seen], axis=0)
    return settled


def follows_seen(observations: Observations) -> BoolArray:
    """Return which movements follow one that was seen, or begin a run, (movement,).

    After an unseen movement it is not known where a motor came from.
    """
    run, number = observations.run, observations.number
    seen = number == 0
    seen[1:] |= (run[1:] == run[:-1]) & (number[1:] == number[:-1] + 1)
    return np.asarray(seen)


def obeyed(observations: Observations, lost: BoolArray) -> Observations:
    """Return the observations with the origins of motors that had missed the command before.

    Args:
        observations: Settled movements with the commanded origins, in order.
        lost: Motors that did not get their command, (movement, motor).
    """
    origin = observations.origin.copy()
    for i in range(1, len(origin)):
        follows = observations.run[i] == observations.run[i - 1]
        if follows and observations.number[i] == observations.number[i - 1] + 1:
            origin[i] = np.where(lost[i - 1], origin[i - 1], origin[i])
    return replace(observations, origin=origin)


def stayed(observations: Observations, robot: Robot, expected: FloatArray) -> BoolArray:
    """Return which motors stayed where they were although told to move, (movement, motor).

    With readings each motor is looked at by itself; with the tool path alone, a set of motors
    stayed if the tool is nearer to where it would then be than to anything else.

    Args:
        observations: Settled movements.
        robot: The robot.
        expected: Angles at which motors settle if their commands arrive, (movement, motor) [rad].
    """
    travel = np.abs(observations.target - observations.origin) > TRAVEL_RAD
    if observations.position is not None:
        near = np.abs(observations.position - observations.origin) < STAYED_RAD
        return near & travel
    twin, motors = DigitalTwin(robot), expected.shape[1]
    sets = [np.zeros(motors, dtype=bool)]
    sets += [np.arange(motors) == motor for motor in range(motors)]
    sets += [np.arange(motors) < count for count in range(2, motors + 1)]
    away = np.stack(
        [
            np.linalg.norm(
                twin.path(np.where(held, observations.origin, expected)) - observations.point,
                axis=-1,
            )
            for held in sets
        ]
    )
    best = np.argmin(away, axis=0)
    clear = (away[0] > FAR_OFF_M) & (away.min(axis=0) < 0.5 * away[0])
    return np.stack(sets)[np.where(clear, best, 0)] & travel
