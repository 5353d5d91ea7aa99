"""A robot that wears, by its own short simulation, for the tests of what follows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin import DigitalTwin, Priors
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.digital_model.nonidealities import Imperfections, Readings, Variation
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.set_ups.setup_prior import SetupPrior
from failuretwin.inference.together.life_filter import LifeFilter
from failuretwin.inference.together.wear_limits import WearLimits

COUNT = np.deg2rad(0.24)
MOVEMENTS = 5
NOISE_M = 0.0005
SETTLING = Settling(
    bias=(0.002, -0.004, 0.0, 0.003),
    compliance=(0.0, 0.14, 0.16, 0.2),
    friction=(0.006, 0.005, 0.009, 0.011),
    scatter=(0.006, 0.007, 0.006, 0.004),
    tail_dof=4.0,
    source="made up",
)
DOUBT = Variation(bias=(0.001,) * 4, compliance=(0.05,) * 4, friction=(0.001,) * 4)
READINGS = Readings(rate_hz=10.0, noise_m=NOISE_M)
CALIBRATION = Imperfections("made up", "test", "P0c", SETTLING, readings=READINGS, variation=DOUBT)
KNOWN = Priors(setup=SetupPrior.known(), load_changes=0.0)


def normal(calibration=CALIBRATION):
    """Return the calibration with scatter of a normal distribution."""
    return replace(calibration, settling=replace(calibration.settling, tail_dof=np.inf))


def truth(runs, bias=0.0, compliance=0.0, settling=SETTLING):
    """Return bias, compliance and friction of each run, (run, 3, motor)."""
    wear = np.zeros((runs, 3, 4))
    wear[:, 0] = np.asarray(settling.bias) + bias
    wear[:, 1] = np.asarray(settling.compliance) + compliance
    wear[:, 2] = settling.friction
    return wear


def seen(robot, wear, seed=0, calibration=CALIBRATION, held=None):
    """Return where the tool of a robot with that wear settles, five movements a run.

    Args:
        robot: The robot.
        wear: Of each run, (run, 3, motor).
        seed: Of the draws.
        calibration: Its scatter.
        held: A motor that stays at an angle of its own in each run.
    """
    rng, settling, runs = np.random.default_rng(seed), calibration.settling, len(wear)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    target = rng.uniform(low, high, (runs, MOVEMENTS, 4))
    origin = np.concatenate([np.zeros((runs, 1, 4)), target[:, :-1]], axis=1)
    bias, compliance, friction = np.moveaxis(wear[:, None], 2, 0)
    pose = target
    for _ in range(3):  # gravity acts in the pose that the arm is really in
        torque = robot.sense * robot.loads.torque(pose * robot.sense)
        pose = target + bias + compliance * torque - friction * np.sign(target - origin)
    infinite = np.isinf(settling.tail_dof)
    shape = target.shape
    unit = rng.normal(size=shape) if infinite else rng.standard_t(settling.tail_dof, shape)
    pose = pose + unit * settling.scatter
    if held is not None:
        pose[..., held] = rng.uniform(-0.5, 0.5, (runs, 1))
    start = np.tile(2.0 * np.arange(MOVEMENTS), (runs, 1))
    movements = Movements(np.zeros((runs, 4)), target, np.full(shape, 0.8), start)
    empty = SettledEvidence.empty(run=runs, movement=MOVEMENTS, motor=4, axis=3)
    return replace(
        empty,
        movements=movements,
        point=DigitalTwin(robot).path(pose) + rng.normal(0.0, NOISE_M, (*shape[:2], 3)),
        usable=np.ones(shape[:2], dtype=bool),
        begin=start + 1.5,
        end=start + 2.0,
    )


def life(robot, hypotheses=("healthy",), calibration=CALIBRATION, limits=None):
    """Return what is believed of the robot before any run."""
    model = HealthyModel(DigitalTwin(robot), calibration)
    parsed = [Hypothesis.parse(name) for name in hypotheses]
    return LifeFilter.of(model, parsed, KNOWN, limits or WearLimits())


def follow_all(found, evidence, batch=10):
    """Return offsets (step, 2, 3, motor) and alarms after every few runs."""
    offsets, alarms = [], []
    for first in range(0, len(evidence.usable), batch):
        found.follow(evidence[first : first + batch])
        offsets.append(np.stack(found.offsets))
        alarms.append(found.alarm)
    return np.array(offsets), alarms
