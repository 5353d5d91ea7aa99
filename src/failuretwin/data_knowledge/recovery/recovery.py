"""Motor commands recovered from desired tool paths, for published runs that hold no commands.

A desired path is what the kinematics make of the reference of the motors. Where that reference
ramps between whole servo units, as the published ones do, movements come back exactly; others can
be fitted by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.runs import STEP_S
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.recovery import ramp_fit
from failuretwin.data_knowledge.recovery.ramp_fit import PathPart
from failuretwin.data_knowledge.recovery.run_fit import NoWholeUnitsError, nearest_run, whole_run
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin


def recover_movements(
    desired: FloatArray,
    robot: Robot,
    *,
    names: Sequence[str],
    time: FloatArray | None = None,
    approximate: bool = False,
) -> tuple[FloatArray, Movements]:
    """Return the time grid (time,) [s] and the movements whose reference makes the desired paths.

    Targets are whole servo units, ramps of the published durations; motors that stay have a
    duration of 0, movements without any travel do not appear. The last ramp of a record that ends
    within it is one of those that make what is seen of it, and a movement that begins after the
    record does not appear. What comes back makes the desired path to 1e-9 m.

    Args:
        desired: Desired tool paths in the base frame, (run, time, axis) [m].
        robot: The robot.
        names: Name of each run, for messages.
        time: Uniform time grid, (time,) [s]; None: the published one that fits.
        approximate: Fit the runs that have no such movements by least squares, with targets
            and durations of any value. A tool position leaves the pose of an arm with more than
            three motors open; the fit takes the pose nearest to the one before it among those
            that also fit the ramps.

    Raises:
        InputError: If the arrays do not fit, or a run has no such movements and `approximate`
            is False, or nothing of a run's path can be fitted.
    """
    desired = as_floats(desired)
    grids = published_time_bases(np.shape(desired)[1]) if time is None else [as_floats(time)]
    _check(desired, grids[0], names)
    grid = _fitting_grid(grids, desired, robot)
    parts = [
        _recover_run(PathPart(grid, path), robot, approximate, name)
        for path, name in zip(desired, names, strict=True)
    ]
    return grid, stack_movements(parts)


def path_error(
    movements: Movements, desired: FloatArray, time: FloatArray, robot: Robot
) -> FloatArray:
    """Return how far the path of `movements` is off `desired` at most, (run,) [m].

    Args:
        movements: Movements of every run.
        desired: Desired tool paths in the base frame, (run, time, axis) [m].
        time: Time grid, (time,) [s].
        robot: The robot.
    """
    error = ramp_fit.path_error(movements, PathPart(time, desired), DigitalTwin(robot))
    return error.max(axis=1, initial=0.0)


def published_time_bases(samples: int) -> list[FloatArray]:
    """Return the grids that published runs come on, (time,) [s].

    For 1000 samples these are 0.01 to 10.00, and 1000 points from 0 to 10.
    """
    end = samples * STEP_S
    return [as_floats(np.arange(1, samples + 1) * STEP_S), np.linspace(0.0, end, samples)]


def _fitting_grid(grids: Sequence[FloatArray], desired: FloatArray, robot: Robot) -> FloatArray:
    """Return the grid on which movements of published durations make the desired paths.

    The grids differ in their step, which whole movements reveal; an offset of the whole run in
    time could not be seen. Runs whose movements are all cut off fit both. Where no run decides,
    because none is exact, it is the first.
    """
    if len(grids) == 1:
        return grids[0]
    for path in desired:
        fitting = [grid for grid in grids if _is_exact(PathPart(grid, path), robot)]
        if len(fitting) == 1:
            return fitting[0]
    return grids[0]


def _is_exact(path: PathPart, robot: Robot) -> bool:
    try:
        whole_run(path, robot)
    except NoWholeUnitsError:
        return False
    return True


def _recover_run(path: PathPart, robot: Robot, approximate: bool, name: str) -> Movements:
    try:
        return whole_run(path, robot)
    except NoWholeUnitsError as reason:
        if approximate:
            return nearest_run(path, robot, name)
        raise InputError(
            f"run {name!r}: no movements of robot {robot.name!r} between whole servo units make "
            f"its desired path exactly: {reason}. If the path is of another robot, give that one "
            "with --robot; if its targets are no whole units or it holds noise, use --approximate."
        ) from None


def _check(desired: FloatArray, time: FloatArray, names: Sequence[str]) -> None:
    if desired.ndim != 3 or desired.shape[1:] != (len(time), 3) or len(time) < 2:
        raise InputError(
            f"`desired` has shape {desired.shape}, expected (run, {len(time)} times, 3 axes) with "
            "two samples at least."
        )
    if len(names) != len(desired):
        raise InputError(f"{len(names)} names for {len(desired)} runs. Give one for each run.")
    for name, path in zip(names, desired, strict=True):
        if not np.all(np.isfinite(path)):
            raise InputError(
                f"run {name!r}: its desired path holds values that are not finite. Expected a "
                "position [m] at every sample."
            )
