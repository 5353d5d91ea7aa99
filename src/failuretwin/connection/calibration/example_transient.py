"""One movement of the logs as an example: command, twin before and after calibration, readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.observations import observe
from failuretwin.connection.calibration.result import Calibration
from failuretwin.connection.calibration.settling import fit_settled_part
from failuretwin.connection.calibration.timing import (
    AFTER_RAMP_S,
    Transients,
    lateness,
    motion,
    movements_of,
    transients,
)
from failuretwin.connection.calibration.validation import settling_of, trusted_runs
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.nonidealities import Range, Timing
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

BEFORE_S, AFTER_S = 0.2, 0.5
"""What is shown before a movement and after its ramp [s]."""


@dataclass(frozen=True)
class ExampleRamp:
    """One movement; a channel is a motor [rad] or an axis of the tool [m].

    Attributes:
        run: Name of the run.
        movement: Its number in the run, from 1.
        time: Time since the command, (time,) [s].
        command: What is asked for, (time, channel).
        plain: What the uncalibrated twin does, (time, channel).
        calibrated: What the calibrated twin does, (time, channel).
        reading: What was read, (time, channel); NaN where nothing was.
        of_motors: Whether channels are motors.
    """

    run: str
    movement: int
    time: FloatArray
    command: FloatArray
    plain: FloatArray
    calibrated: FloatArray
    reading: FloatArray
    of_motors: bool


def example_ramp(found: Calibration, runs: xr.Dataset, robot: Robot) -> ExampleRamp | None:
    """Return the movement that the calibrated twin fits neither well nor badly, but typically.

    It is taken from the longer half of the movements that began on time at a known place; None if
    there are none.

    Args:
        found: The calibration.
        runs: The runs it was learned from or judged on.
        robot: The robot.
    """
    runs = trusted_runs(found, runs)
    settling = settling_of(found, robot)
    seen = observe(runs, use_readings=found.used_readings)
    part = fit_settled_part(seen, robot, settling.payload)
    movements = movements_of(runs)
    # What is shown is the calibration, which may have seen fewer sessions than this fit.
    ramps = transients(runs, movements, lateness(movements), part, settling, robot)
    twin = DigitalTwin(robot)
    told = _motion(ramps, twin, found.imperfections.timing)
    if not ramps.of_motors:
        told = twin.path(told)
    chosen = _typical(ramps, told)
    if chosen is None:
        return None
    run, movement = chosen
    begin = float(ramps.movements.start[run, movement])
    end = begin + float(np.nanmax(ramps.movements.ramp_duration[run, movement]))
    shown = (ramps.time >= begin - BEFORE_S) & (ramps.time <= end + AFTER_S)
    command = as_floats(runs["command"].values[run])
    plain = twin.respond(command, ramps.time)
    if not ramps.of_motors:
        command, plain = twin.path(command), twin.path(plain)
    return ExampleRamp(
        run=str(runs["run"].values[run]),
        movement=movement + 1,
        time=ramps.time[shown] - begin,
        command=command[shown],
        plain=plain[shown],
        calibrated=told[run][shown],
        reading=ramps.reading[run][shown],
        of_motors=ramps.of_motors,
    )


def _motion(ramps: Transients, twin: DigitalTwin, timing: Timing) -> FloatArray:
    """Return how the typical calibrated robot makes the movements, (run, time, motor) [rad]."""
    ones = np.ones(len(ramps.movements.start))
    free = motion(
        ramps.movements,
        ramps.time,
        twin,
        _middle(timing.delay_s) * ones,
        _middle(timing.ramp_shortening) * ones,
        _middle(timing.lag_s),
    )
    return free + ramps.yielding


def _middle(values: Range) -> float:
    return 0.5 * (values[0] + values[1])


def _typical(ramps: Transients, told: FloatArray) -> tuple[int, int] | None:
    movements = ramps.movements
    travel = np.abs(movements.target - movements.origin()).min(axis=-1)
    found = []
    for run, movement in np.argwhere(movements.exists):
        begin = movements.start[run, movement]
        end = begin + np.nanmax(movements.ramp_duration[run, movement]) + AFTER_RAMP_S
        inside = ramps.used[run] & (ramps.time >= begin) & (ramps.time < end)
        if inside.any():
            off = (told[run] - ramps.reading[run])[inside]
            misfit = float(np.sqrt(np.mean(off**2)))
            found.append((float(travel[run, movement]), misfit, int(run), int(movement)))
    if not found:
        return None
    longer = sorted(found)[len(found) // 2 :]
    _, _, run, movement = sorted(longer, key=lambda entry: entry[1])[len(longer) // 2]
    return run, movement
