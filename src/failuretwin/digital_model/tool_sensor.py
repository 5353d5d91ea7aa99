"""The sensors: from the true angles of many runs to readings of motors and of the tool's path."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.disturbances import Disturbances
from failuretwin.digital_model.imperfections import Readings
from failuretwin.digital_model.twin import DigitalTwin


def sense(
    twin: DigitalTwin,
    readings: Readings | None,
    position: FloatArray,
    time: FloatArray,
    movement_start: FloatArray,
    chance: Disturbances,
) -> tuple[FloatArray, FloatArray]:
    """Return the tool path and the motors' angles as the sensors report them.

    Args:
        twin: Kinematics of the robot.
        readings: The sensor; None: perfect, one sample at every grid time.
        position: True angles, (run, time, motor) [rad].
        time: Uniform grid, (time,) [s].
        movement_start: Starts as commanded, (run, movement) [s]; gaps hang on them.
        chance: Disturbances of the same runs.

    Returns:
        Tool path (run, time, axis) [m] and angles (run, time, motor) [rad], NaN where there is no
        sample.
    """
    if readings is None:
        return twin.path(position), position
    read = _at_times(position, time, chance.reading_time)
    if readings.whole_counts:
        units = twin.robot.servo_units
        read = units.to_rad(np.round(units.to_counts(read)))
    missing = _in_gap(chance, movement_start)
    if readings.drawn_out:
        return _draw_out(twin, read, chance, missing, time)
    spoilt = np.isfinite(chance.glitch)
    unseen = missing | spoilt.any(axis=-1)
    points = np.where(unseen[..., None], np.nan, twin.path(read) + chance.noise)
    angles = np.where(missing[..., None] | spoilt, np.nan, read)
    nearest = np.rint(chance.reading_time / (time[1] - time[0])).astype(np.int64)
    inside = nearest < len(time)
    run = np.broadcast_to(np.arange(len(position))[:, None], nearest.shape)
    measured = np.full((*position.shape[:2], 3), np.nan)
    measured[run[inside], nearest[inside]] = points[inside]
    angle = np.full(position.shape, np.nan)
    angle[run[inside], nearest[inside]] = angles[inside]
    return measured, angle


def _at_times(position: FloatArray, time: FloatArray, at: FloatArray) -> FloatArray:
    """Return `position` (run, time, motor) linearly interpolated at `at` (run, reading)."""
    place = np.clip(at / (time[1] - time[0]), 0.0, len(time) - 1.0)
    low = np.minimum(place.astype(np.int64), len(time) - 2)
    share = (place - low)[..., None]
    run = np.arange(len(position))[:, None]
    return position[run, low] * (1.0 - share) + position[run, low + 1] * share


def _in_gap(chance: Disturbances, start: FloatArray) -> BoolArray:
    """Return which readings the stalled bus swallows, (run, reading)."""
    stalled = np.concatenate([chance.late[:, 1:] > 0.0, chance.stalled[:, None]], axis=1)
    begin = start + chance.gap_start
    end = np.full_like(start, np.inf)
    end[:, :-1] = start[:, 1:] + chance.late[:, 1:]
    at = chance.reading_time[:, :, None]
    inside = (at > begin[:, None]) & (at < end[:, None]) & stalled[:, None]
    return np.asarray(inside.any(axis=-1))


def _draw_out(
    twin: DigitalTwin,
    read: FloatArray,
    chance: Disturbances,
    missing: BoolArray,
    time: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return path and angles drawn out to the grid by straight lines, as published."""
    units = twin.robot.servo_units
    counts = np.where(np.isfinite(chance.glitch), chance.glitch, units.to_counts(read))
    filled = np.empty((len(read), len(time), read.shape[-1]))
    for run in range(len(read)):
        kept = ~missing[run]
        for motor in range(read.shape[-1]):
            filled[run, :, motor] = np.interp(
                time, chance.reading_time[run, kept], counts[run, kept, motor]
            )
    angle = units.to_rad(filled)
    return twin.path(angle), angle
