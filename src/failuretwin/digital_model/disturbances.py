"""The robot of one run and its bad luck: all that imperfections leave to chance.

Chance and computation are apart: everything is drawn here, from one generator for each run;
what follows from it is deterministic and works on many runs at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import Imperfections, Readings
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.variation import vary


@dataclass(frozen=True)
class Disturbances:
    """The robot of a run and what chance does to it, or of many along a leading run axis.

    Attributes:
        bias: Constant error of each motor, (motor,) [rad].
        compliance: Its yielding under load, (motor,) [rad/(N m)].
        friction: How far it stops short, (motor,) [rad].
        payload: Mass at the tool point, () [kg].
        lost: Commands that do not arrive, (movement, motor).
        scatter: Settled scatter, (1 + movement, motor) [rad]; the first row is before the run.
        delay: Dead time, () [s].
        lag: Time constant of a first-order lag, () [s].
        shortening: Share by which ramps end early, ().
        late: Late start, (movement,) [s].
        stalled: Whether the command after the run is late, so that the last movement's readings
            stop too, ().
        gap_start: Readings stop this long after a movement before a late one, (movement,) [s].
        reading_time: Times of the readings, (reading,) [s].
        glitch: Raw counts of spoilt readings, NaN where sound, (reading, motor).
        noise: Noise of the tool sensor, (reading, axis) [m].
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


def draw_disturbances(
    imperfections: Imperfections,
    robot: Robot,
    movements: int,
    duration: float,
    rng: np.random.Generator,
) -> Disturbances:
    """Draw the disturbances of one run.

    Args:
        imperfections: What the robot is like.
        robot: The robot.
        movements: Number of movements in the run.
        duration: Longest time that readings are needed for [s].
        rng: The run's own generator.
    """
    imperfections = vary(imperfections, rng)
    timing, motors = imperfections.timing, len(robot.motors)
    settling = imperfections.settling or Settling.ideal(motors)
    late = np.where(
        rng.random(movements) < timing.late_rate, rng.uniform(*timing.late_s, movements), 0.0
    )
    late[:1] = 0.0
    times, glitch, noise = _draw_readings(imperfections.readings, motors, duration, rng)
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
    )


def stack(draws: Sequence[Disturbances]) -> Disturbances:
    """Return the disturbances of many runs along a leading run axis."""
    names = Disturbances.__dataclass_fields__
    return Disturbances(**{name: np.stack([getattr(d, name) for d in draws]) for name in names})


def _draw_losses(
    imperfections: Imperfections, robot: Robot, late: BoolArray, rng: np.random.Generator
) -> BoolArray:
    """Return which motors lose which command, (movement, motor); at most one set a movement."""
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
    if settling is None:
        return np.zeros((rows, motors))
    if np.isinf(settling.tail_dof):
        unit = rng.standard_normal((rows, motors))
    else:
        unit = rng.standard_t(settling.tail_dof, (rows, motors))
    return unit * np.asarray(settling.scatter)


def _draw_readings(
    readings: Readings | None, motors: int, duration: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    if readings is None:
        return np.empty(0), np.empty((0, motors)), np.empty((0, 3))
    count = int(np.floor(duration * readings.rate_hz)) + 1
    times = np.arange(count) / readings.rate_hz
    times[1:] += rng.normal(0.0, readings.jitter_s, count - 1) if readings.jitter_s else 0.0
    spoilt = rng.random((count, motors)) < np.asarray(readings.glitch_rate or [0.0] * motors)
    glitch = np.where(spoilt, rng.integers(-32768, 32768, (count, motors)), np.nan)
    noise = (
        rng.normal(0.0, readings.noise_m, (count, 3)) if readings.noise_m else np.zeros((count, 3))
    )
    return np.maximum.accumulate(times), glitch, noise
