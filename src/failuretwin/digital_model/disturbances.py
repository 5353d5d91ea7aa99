"""Random disturbances of a run: everything that imperfections leave to chance.

All random numbers are drawn first, from one generator per run; motions and readings then follow
deterministically, for many runs at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.nonidealities import Imperfections, Readings, vary
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin


@dataclass(frozen=True)
class Disturbances:
    """Robot and random disturbances of one run, or of many along a leading run axis.

    Attributes:
        bias: Constant error of each motor, (motor,) [rad].
        compliance: Its yielding under load, (motor,) [rad/(N m)].
        friction: Distance by which it stops short, (motor,) [rad].
        payload: Mass at the tool point, () [kg].
        lost: Lost commands, (movement, motor).
        scatter: Random settled error, (1 + movement, motor) [rad]; the first row is before the run.
        delay: Dead time, () [s].
        lag: Time constant of a first-order lag, () [s].
        shortening: Share by which ramps end early, ().
        late: Late start, (movement,) [s].
        stalled: Whether the command after the run is late, so that the last movement's readings
            stop too, ().
        gap_start: Time from the start of a movement until readings stop, (movement,) [s].
        reading_time: Times of the readings, (reading,) [s].
        glitch: Raw counts of corrupted readings, NaN where sound, (reading, motor).
        noise: Noise of the tool sensor, (reading, axis) [m].
        flicker: Noise of the motors' own readings, (reading, motor) [their deviation].
    """

    bias: FloatArray
    compliance: FloatArray
    friction: FloatArray
    payload: FloatArray
    lost: BoolArray
    scatter: FloatArray
    delay: FloatArray
    lag: FloatArray
    shortening: FloatArray
    late: FloatArray
    stalled: BoolArray
    gap_start: FloatArray
    reading_time: FloatArray
    glitch: FloatArray
    noise: FloatArray
    flicker: FloatArray


def draw_disturbances(
    imperfections: Imperfections,
    robot: Robot,
    movements: int,
    duration: float,
    rng: np.random.Generator,
) -> Disturbances:
    """Return the disturbances of one run.

    Readings are needed for `duration` [s]; the generator is the run's own.
    """
    imperfections = vary(imperfections, rng)
    timing, motors = imperfections.timing, len(robot.motors)
    settling = imperfections.settling or Settling.ideal(motors)
    is_late = rng.random(movements) < timing.late_rate
    late = np.where(is_late, rng.uniform(*timing.late_s, movements), 0.0)
    late[:1] = 0.0
    times, glitch, noise, flicker = _draw_readings(imperfections.readings, motors, duration, rng)
    return Disturbances(
        bias=np.asarray(settling.bias),
        compliance=np.asarray(settling.compliance),
        friction=np.asarray(settling.friction),
        payload=np.asarray(settling.payload),
        lost=_draw_losses(imperfections, robot, late > 0, rng),
        scatter=_draw_scatter(imperfections.settling, movements + 1, motors, rng),
        delay=np.asarray(rng.uniform(*timing.delay_s)),
        shortening=np.asarray(rng.uniform(*timing.ramp_shortening)),
        lag=np.asarray(rng.uniform(*timing.lag_s)),
        late=late,
        stalled=np.asarray(rng.random() < timing.late_rate),
        gap_start=rng.uniform(*timing.gap_start_s, movements),
        reading_time=times,
        glitch=glitch,
        noise=noise,
        flicker=flicker,
    )


def stack(draws: Sequence[Disturbances]) -> Disturbances:
    """Return the disturbances of many runs along a leading run axis."""
    names = Disturbances.__dataclass_fields__
    return Disturbances(**{name: np.stack([getattr(d, name) for d in draws]) for name in names})


def _draw_losses(
    imperfections: Imperfections, robot: Robot, late: BoolArray, rng: np.random.Generator
) -> BoolArray:
    """Return which motors lose which command, (movement, motor); at most one set per movement."""
    names = robot.motor_names
    lost = np.zeros((len(late), len(names)), dtype=bool)
    chance, below = rng.random(len(late)), np.zeros(len(late))
    for entry in imperfections.lost_commands:
        above = below + np.where(late, entry.rate_when_late, entry.rate)
        hit = (chance >= below) & (chance < above)
        for motor in entry.motors:
            lost[:, names.index(motor)] |= hit
        below = above
    return lost


def _draw_scatter(
    settling: Settling | None, rows: int, motors: int, rng: np.random.Generator
) -> FloatArray:
    shape = (rows, motors)
    if settling is None:
        return np.zeros(shape)
    gaussian = np.isinf(settling.tail_dof)
    unit = rng.standard_normal(shape) if gaussian else rng.standard_t(settling.tail_dof, shape)
    return unit * np.asarray(settling.scatter)


def _draw_readings(
    readings: Readings | None, motors: int, duration: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    if readings is None:
        return np.empty(0), np.empty((0, motors)), np.empty((0, 3)), np.empty((0, motors))
    count = int(np.floor(duration * readings.rate_hz)) + 1
    times = np.arange(count) / readings.rate_hz
    times[1:] += rng.normal(0.0, readings.jitter_s, count - 1) if readings.jitter_s else 0.0
    spoilt = rng.random((count, motors)) < np.asarray(readings.glitch_rate or [0.0] * motors)
    glitch = np.where(spoilt, rng.integers(-32768, 32768, (count, motors)), np.nan)
    noise = np.zeros((count, 3))
    if readings.noise_m:
        noise = rng.normal(0.0, readings.noise_m, (count, 3))
    flicker = rng.spawn(1)[0].standard_normal((count, motors))  # leaves all other chance as it is
    return np.maximum.accumulate(times), glitch, noise, flicker


def delay_commands(movements: Movements, late: FloatArray) -> Movements:
    """Return the commanded movements when each late start also delays all later ones.

    A stalled bus blocks the sender: the command keeps its early stamp, the next one is sent a full
    period after the late start. Late starts are (run, movement) [s].
    """
    before = np.cumsum(late, axis=1) - late
    return replace(movements, start=movements.start + before)


def actual_movements(movements: Movements, chance: Disturbances) -> Movements:
    """Return the actual movements of the motors, without gravity sag.

    Lost commands, bias, friction and scatter change targets; late starts, delay and early ramp ends
    change times. Movements are as commanded, after any fault that changes targets.
    """
    initial = here = movements.initial + chance.bias + chance.scatter[:, 0]
    target, commanded = np.empty_like(movements.target), movements.initial
    for m in range(target.shape[1]):
        wanted = movements.target[:, m]
        short = chance.friction * np.sign(wanted - commanded)
        settled = wanted + chance.bias - short + chance.scatter[:, 1 + m]
        target[:, m] = here = np.where(chance.lost[:, m], here, settled)
        commanded = np.where(chance.lost[:, m], commanded, wanted)
    return Movements(
        initial=initial,
        target=target,
        ramp_duration=movements.ramp_duration * (1.0 - chance.shortening[:, None, None]),
        start=movements.start + chance.late + chance.delay[:, None],
    )


def lagged(reference: FloatArray, time: FloatArray, lag: FloatArray) -> FloatArray:
    """Return references behind a first-order lag, exact for lines between samples.

    References are (run, time, motor) [rad], at rest at their first value; time constants are (run,)
    [s], 0 leaves a run unchanged.
    """
    if not lag.any():
        return reference
    out = reference.copy()
    for run in np.flatnonzero(lag):
        first, step = reference[run, 0], float(time[1] - time[0])
        out[run] = first_order_lag(reference[run].T, first, step, lag[run]).T
    return out


def sense(
    twin: DigitalTwin,
    readings: Readings | None,
    position: FloatArray,
    time: FloatArray,
    movement_start: FloatArray,
    chance: Disturbances,
) -> tuple[FloatArray, FloatArray]:
    """Return tool path (run, time, axis) [m] and angles (run, time, motor) [rad] by the sensors.

    NaN where there is no sample.

    Args:
        twin: Kinematics of the robot.
        readings: The sensor; None: perfect, one sample at every grid time.
        position: True angles, (run, time, motor) [rad].
        time: Uniform grid, (time,) [s].
        movement_start: Starts as commanded, (run, movement) [s]; gaps are relative to them.
        chance: Disturbances of the same runs.
    """
    if readings is None:
        return twin.path(position), position
    read = _at_times(position, time, chance.reading_time)
    if readings.whole_counts:
        units = twin.robot.servo_units
        read = units.to_rad(np.round(units.to_counts(read) + units.noise * chance.flicker))
    missing = _in_gap(chance, movement_start)
    if readings.drawn_out:
        return _draw_out(twin, read, chance, missing, time)
    spoilt = np.isfinite(chance.glitch)
    unseen = missing | spoilt.any(axis=-1)
    points = np.where(unseen[..., None], np.nan, twin.path(read) + chance.noise)
    angles = np.where(missing[..., None] | spoilt, np.nan, read)
    nearest = np.rint(chance.reading_time / (time[1] - time[0])).astype(np.int64)
    inside = nearest < len(time)
    where = np.nonzero(inside)[0], nearest[inside]
    measured, angle = np.full((*position.shape[:2], 3), np.nan), np.full(position.shape, np.nan)
    measured[where], angle[where] = points[inside], angles[inside]
    return measured, angle


def _at_times(position: FloatArray, time: FloatArray, at: FloatArray) -> FloatArray:
    """Return `position` (run, time, motor) linearly interpolated at `at` (run, reading)."""
    place = np.clip(at / (time[1] - time[0]), 0.0, len(time) - 1.0)
    low = np.minimum(place.astype(np.int64), len(time) - 2)
    share = (place - low)[..., None]
    run = np.arange(len(position))[:, None]
    return position[run, low] * (1.0 - share) + position[run, low + 1] * share


def _in_gap(chance: Disturbances, start: FloatArray) -> BoolArray:
    """Return which readings a stalled bus drops, (run, reading)."""
    stalled = np.concatenate([chance.late[:, 1:] > 0.0, chance.stalled[:, None]], axis=1)
    begin = start + chance.gap_start
    end = np.full_like(start, np.inf)
    end[:, :-1] = start[:, 1:] + chance.late[:, 1:]
    at = chance.reading_time[:, :, None]
    inside = (at > begin[:, None]) & (at < end[:, None]) & stalled[:, None]
    return np.asarray(inside.any(axis=-1))


def _draw_out(
    twin: DigitalTwin, read: FloatArray, chance: Disturbances, missing: BoolArray, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return path and angles interpolated on the grid, as published."""
    units = twin.robot.servo_units
    counts = np.where(np.isfinite(chance.glitch), chance.glitch, units.to_counts(read))
    filled = np.empty((len(read), len(time), read.shape[-1]))
    for run, motor in np.ndindex(len(read), read.shape[-1]):
        kept = ~missing[run]
        known = chance.reading_time[run, kept]
        filled[run, :, motor] = np.interp(time, known, counts[run, kept, motor])
    angle = units.to_rad(filled)
    return twin.path(angle), angle
