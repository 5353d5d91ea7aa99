"""Lives of robots seen at rest alone: hours of movements in seconds.

What `EmulatedArm` does to a robot, without the way between plateaus: offsets of its own, scatter,
lost commands, late starts, gaps in which a movement is not seen, whole counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.streaming.tracking import REST_S
from failuretwin.digital_model.disturbances import (
    Disturbances,
    actual_movements,
    delay_commands,
    draw_disturbances,
    stack,
)
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.digital_model.settling import sag
from failuretwin.digital_model.twin import SAG_ROUNDS, DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.observation.evidence import JUST_AFTER_S, SETTLING_S, SettledEvidence
from failuretwin.inference.observation.sensors import SensorStack
from failuretwin.inference.observation.settings import InferenceSettings

READ_S = 0.05
"""Time from a command to the first reading after it [s], if the bus does not stall."""
WARM_S = 1200.0
"""Time constant with which motors warm up [s], assumed."""
ERROR_RAD = (np.deg2rad(2.4), np.deg2rad(12.0))
"""The paper's steady-state errors, 10 to 50 counts [rad]."""


@dataclass(frozen=True)
class Lives:
    """Some lives of equally many movements.

    Attributes:
        evidence: What was seen.
        hours: Length of each, (life,) [h].
        truth: What is the case from its onset on, (life,), such as ``motor_1:stuck``.
        onset: First movement that a fault spoils, (life,); past the last of healthy ones.
        at_rest: Whether a motor got stuck on a plateau, (life,).
        held: Angle of a stuck motor, (life,) [rad]; NaN of others.
        off: Steady-state error of each movement, (life, movement) [rad]; 0 without.
        late: Movements that start late, (life, movement).
        onset_s: When the fault begins, (life,) [s]: at any time of the cycle that spoils that
            movement; 0 of healthy ones.
        told_s: When each movement can be judged, (life, movement) [s].
    """

    evidence: SettledEvidence
    hours: FloatArray
    truth: Sequence[str]
    onset: IntArray
    at_rest: BoolArray
    held: FloatArray
    off: FloatArray
    late: BoolArray
    onset_s: FloatArray
    told_s: FloatArray


def live(
    twin: DigitalTwin,
    imperfections: Imperfections,
    faults: Sequence[str],
    movements: int,
    onset: tuple[int, int],
    seed: int,
    gaps: bool = True,
    sensors: SensorStack | None = None,
    drift: float = 0.0,
) -> Lives:
    """Return lives, each of a robot drawn anew from what the imperfections say of robots.

    Args:
        twin: Kinematics.
        imperfections: What such robots are like.
        faults: ``healthy``, ``motor_k:stuck`` or ``motor_k:steady_state_error`` of each life.
        movements: Movements of each life.
        onset: First and last movement that a fault may spoil first.
        seed: Seed of all chance.
        gaps: Whether a bus that stalls swallows the readings before a late start.
        sensors: What is seen; None: the tool alone.
        drift: By how much zeros drift as motors warm up, in scatters.
    """
    rng, robot = np.random.default_rng(seed), twin.robot
    own = [vary(imperfections, rng) for _ in faults]
    drawn = RandomMovements(count=movements)
    told = stack_movements([drawn.draw(robot, imperfections.schedule, rng) for _ in faults])
    chance = stack([draw_disturbances(one, robot, movements, 0.0, rng) for one in own])
    told = delay_commands(told, chance.late)
    first = rng.integers(onset[0], onset[1] + 1, len(faults))
    first[[fault == "healthy" for fault in faults]] = movements
    motor = np.array([_motor(fault, robot.motor_names) for fault in faults])
    spoilt = np.arange(movements) >= first[:, None]
    errs = np.array([fault.endswith("error") for fault in faults])
    off = rng.uniform(*ERROR_RAD, spoilt.shape) * rng.choice([-1.0, 1.0], spoilt.shape)
    off = np.where(spoilt & errs[:, None], off, 0.0)
    target = told.target.copy()
    target[np.arange(len(faults)), :, motor] += off
    base = actual_movements(replace(told, target=target), chance).target
    angle, place, held = _settled(twin, told, chance, faults, motor, spoilt, rng, base)
    angle = angle + drift * _warm(told, imperfections, seed)
    readings = imperfections.readings
    if readings is not None and readings.whole_counts:
        units = robot.servo_units
        angle = units.to_rad(np.round(units.to_counts(angle)))
    noise_m = InferenceSettings.of(robot, imperfections).least_noise_m
    point = twin.path(angle) + rng.normal(0.0, noise_m, (*angle.shape[:2], 3))
    if sensors is not None:
        point = sensors.reading(point, angle)
    arrived = np.full(base.shape, np.nan)
    if sensors is not None and sensors.goals:
        arrived = sensors.has_arrived(_received(told, chance), told.target)
    usable = np.ones(point.shape[:2], dtype=bool)
    late = chance.late > 0.0
    if gaps:
        usable[:, :-1] = ~late[:, 1:]
        arrived[~usable] = np.nan  # a bus that stalls says nothing of goals either
    begin = told.start + chance.late + told.ramp_duration.max(axis=-1) + SETTLING_S
    evidence = SettledEvidence(
        movements=told,
        point=np.where(usable[..., None], point, 0.0),
        usable=usable,
        moving=np.zeros_like(usable),
        begin=begin,
        end=begin + JUST_AFTER_S,
        first_reading_delay=chance.late + READ_S,
        arrived=arrived,
        too_seldom=np.zeros(len(usable), dtype=bool),
    )
    hours = (told.start[:, -1] - told.start[:, 0]) / 3600.0
    period = np.median(np.diff(told.start, axis=1), axis=1)
    waits = np.random.default_rng([seed, 1]).random(len(faults)) * period
    begins = np.take_along_axis(told.start + chance.late, spoilt.argmax(axis=1)[:, None], axis=1)
    onset_s = np.where(spoilt.any(axis=1), begins[:, 0] + np.where(errs, -waits, place), 0.0)
    told_s = begin + REST_S
    return Lives(evidence, hours, faults, first, place < 0.0, held, off, late, onset_s, told_s)


def _warm(told: Movements, imperfections: Imperfections, seed: int) -> FloatArray:
    """Return the drift of each motor for one scatter of it, (life, movement, motor) [rad]."""
    lives, _, motors = told.target.shape
    since = told.start - told.start[:, :1]
    end = np.random.default_rng([seed, 2]).standard_normal((lives, motors))
    assert imperfections.settling is not None
    end = end * np.asarray(imperfections.settling.scatter)
    return np.asarray(end[:, None] * (1.0 - np.exp(-since / WARM_S))[..., None])


def _received(told: Movements, chance: Disturbances) -> FloatArray:
    """Return the goal that each motor has received by each movement's end, (..., motor) [rad]."""
    goal, before = np.empty_like(told.target), told.initial
    for m in range(goal.shape[1]):
        goal[:, m] = before = np.where(chance.lost[:, m], before, told.target[:, m])
    return goal


def _motor(fault: str, names: Sequence[str]) -> int:
    return 0 if fault == "healthy" else list(names).index(fault.partition(":")[0])


def _settled(
    twin: DigitalTwin,
    told: Movements,
    chance: Disturbances,
    faults: Sequence[str],
    motor: IntArray,
    spoilt: BoolArray,
    rng: np.random.Generator,
    base: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where motors settle (life, movement, motor) [rad], and how stuck ones are held.

    That is: when, from the beginning of a ramp on (life,) [s], and where (life,) [rad].
    """
    compliance = chance.compliance[:, None]

    def sagged(base: FloatArray, stays: BoolArray) -> FloatArray:
        angle = base
        for _ in range(SAG_ROUNDS):
            angle = np.where(stays, base, base + sag(twin.robot, angle, compliance, 0.0))
        return angle

    angle = sagged(base, np.zeros_like(base, dtype=bool))
    stuck = np.array([fault.endswith("stuck") for fault in faults])
    places, held = np.zeros(len(faults)), np.full(len(faults), np.nan)
    stays = np.zeros_like(base, dtype=bool)
    for i in np.flatnonzero(stuck):
        m, k = int(np.argmax(spoilt[i])), motor[i]
        ramp = told.ramp_duration[i, m, k]
        period = float(np.median(np.diff(told.start[i])))
        place = rng.random() * period - (period - ramp)
        places[i] = place
        before, after = angle[i, m - 1, k], angle[i, m, k]
        held[i] = before + (after - before) * max(place, 0.0) / ramp
        stays[i, m:, k] = True
        base[i, m:, k] = held[i]
    return sagged(base, stays), places, held
