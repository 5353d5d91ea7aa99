"""A robot that wears, by its own short simulation, for the tests of the tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin import DigitalTwin
from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.wear import run_evidence
from failuretwin.connection.wear_tracker import Tracker
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.settling import Settling

COUNT = np.deg2rad(0.24)
MOVEMENTS = 5
SETTLING = Settling(
    bias=(0.002, -0.004, 0.0, 0.003),
    compliance=(0.0, 0.14, 0.16, 0.2),
    friction=(0.006, 0.005, 0.009, 0.011),
    scatter=(0.006, 0.007, 0.006, 0.004),
    tail_dof=4.0,
    source="made up",
)
DOUBT = Variation(bias=(0.001,) * 4, compliance=(0.05,) * 4)
CALIBRATION = Imperfections("made up", "test", "P0c", SETTLING, variation=DOUBT)


def normal(calibration):
    """Return the calibration with scatter of a normal distribution."""
    return replace(calibration, settling=replace(calibration.settling, tail_dof=np.inf))


def truth(runs, bias=0.0, compliance=0.0, calibration=CALIBRATION):
    """Return bias and compliance of each run, (run, 2 motor); changes (run or 1, motor)."""
    settling = calibration.settling
    wear = np.zeros((runs, 8))
    wear[:, :4] = np.asarray(settling.bias) + bias
    wear[:, 4:] = np.asarray(settling.compliance) + compliance
    return wear


def observe_wear(robot, wear, rng, readings=False, calibration=CALIBRATION):
    """Return five movements for each run of a robot with that wear, (run, 2 motor)."""
    settling, runs = calibration.settling, len(wear)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    target = rng.uniform(low, high, (runs, MOVEMENTS, 4))
    origin = np.concatenate([np.zeros((runs, 1, 4)), target[:, :-1]], axis=1)
    bias, compliance = wear[:, None, :4], wear[:, None, 4:]
    short = np.asarray(settling.friction) * np.sign(target - origin)
    pose = target
    for _ in range(3):  # gravity acts in the pose that the arm is really in
        torque = robot.sense * robot.loads.torque(pose * robot.sense)
        pose = target + bias + compliance * torque - short
    shape = (runs, MOVEMENTS, 4)
    infinite = np.isinf(settling.tail_dof)
    unit = rng.normal(size=shape) if infinite else rng.standard_t(settling.tail_dof, shape)
    pose = (pose + unit * settling.scatter).reshape(-1, 4)
    return Observations(
        run=np.repeat(np.arange(runs), MOVEMENTS),
        session=np.zeros(runs * MOVEMENTS, dtype=np.int64),
        number=np.tile(np.arange(MOVEMENTS), runs),
        origin=origin.reshape(-1, 4),
        target=target.reshape(-1, 4),
        point=DigitalTwin(robot).path(pose) + rng.normal(0.0, 0.001, (len(pose), 3)),
        position=pose if readings else None,
        sessions=("session",),
        runs=tuple(f"run {i}" for i in range(runs)),
    )


def evidence_of(robot, wear, seed=0, readings=False, calibration=CALIBRATION):
    """Return the evidence of each run, linear at the calibration."""
    seen = observe_wear(robot, wear, np.random.default_rng(seed), readings, calibration)
    return run_evidence(seen, robot, calibration.settling, range(len(wear)))


def follow_all(tracker, evidence, fault_probability=0.1):
    """Return the tracker after many runs, and all steps; one suspicion, or one for each run."""
    steps = []
    for run, chance in zip(
        evidence, np.broadcast_to(fault_probability, len(evidence)), strict=True
    ):
        tracker, step = tracker.follow(run, float(chance))
        steps.append(step)
    return tracker, steps


def fresh(robot, calibration=CALIBRATION, limits=None):
    return Tracker.of(calibration, robot, limits)
