from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats
from small_arms import SCARA, small_twin

from failuretwin.digital_model.nonidealities import (
    NO_IMPERFECTIONS,
    Imperfections,
    LostCommand,
    Readings,
)
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

PATH_NOISE_M, OUTLIER_RATE = 0.001, 0.01

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
SCATTER = np.array([0.005, 0.006, 0.005, 0.004])
DOF = 5.0
SETTLING = Settling(
    bias=(0.002, 0.005, 0.0, 0.003),
    compliance=(0.0, 0.14, 0.17, 0.19),
    friction=(0.007, 0.005, 0.011, 0.011),
    scatter=tuple(SCATTER),
    tail_dof=DOF,
    source="made up",
)
LOSSES = (LostCommand(("motor_1",), 0.1, 0.1), LostCommand(("motor_2", "motor_3"), 0.05, 0.05))
READINGS = Readings(10.0, noise_m=float(np.sqrt(PATH_NOISE_M**2 - 0.0003**2)))
IMPERFECT = Imperfections(
    "made up", "test", settling=SETTLING, readings=READINGS, lost_commands=LOSSES
)
REACH_M = 0.028505 + 0.0361 + 0.10048 + 0.094714 + 0.05071
ANYWHERE = OUTLIER_RATE / (4 / 3 * np.pi * REACH_M**3)


@pytest.fixture(scope="module")
def scene_of(twin, run_of):
    """Make a scene of random movements at whose ends the arm is off by `off` [rad]."""

    def make(seed, off):
        rng = np.random.default_rng(seed)
        targets = rng.uniform(-0.8, 0.8, (2, 4))
        points = twin.path(targets + off + 0.003 * rng.normal(size=(2, 4)))
        runs = run_of(targets, points, MOTORS)
        return RunLikelihood(settled_evidence(runs), HealthyModel(twin, IMPERFECT))

    return make


class BruteForce:
    """The density of a settled position over the angle of one motor, by scipy."""

    def __init__(self, likelihood, movement, motor):
        self.twin, self.model, self.motor = likelihood.model.twin, likelihood.model, motor
        self.point = likelihood.evidence.point[0, movement]
        outcomes = likelihood.outcomes
        self.base = outcomes.base[0, movement]
        self.direction = outcomes.direction[0, movement]
        self.weight = np.exp(outcomes.log_weight[0, movement])

    def pose(self, angle, alternative):
        """Where the arm settles if the motor ends at `angle`: gravity and friction on the rest."""
        base = self.base[alternative].copy()
        base[self.motor] = angle
        free = np.arange(4) != self.motor
        near = base
        for _ in range(5):
            offset = SETTLING.offset(self.twin.robot, near, self.direction[alternative])
            near = base + free * offset
        return near

    def shape(self, pose, held):
        """Covariance scale of the position, derivatives by finite differences."""
        step = 1e-6 * np.eye(4)
        slopes = ((self.twin.path(pose + step) - self.twin.path(pose - step)) / 2e-6).T
        scale = np.where((np.arange(4) == self.motor) & held, 0.0, SCATTER)
        return (slopes * scale) @ (slopes * scale).T + PATH_NOISE_M**2 * np.eye(3)

    def density(self, angle, held):
        total = ANYWHERE
        for alternative, weight in enumerate(self.weight):
            pose = self.pose(angle, alternative)
            shape = self.shape(pose, held)
            kind = stats.multivariate_t(self.twin.path(pose), shape, DOF)
            total += weight * kind.pdf(self.point)
        return total

    def square(self, angle, alternative=0):
        """Squared distance in scales of the others' scatter."""
        pose = self.pose(angle, alternative)
        error = self.point - self.twin.path(pose)
        return error @ np.linalg.solve(self.shape(pose, True), error)


@pytest.mark.parametrize("off", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("motor", range(4))
def test_best_angle_is_where_the_squared_distance_is_least(scene_of, motor, off):
    """Found by bounded minimisation around it, within a fifth of its own deviation."""
    likelihood = scene_of(motor, off * np.eye(4)[motor])
    profile = likelihood.profile(motor)
    for movement in range(2):
        force = BruteForce(likelihood, movement, motor)
        best, precision = (x[0, movement, 0] for x in (profile.mode, profile.precision))
        width = 1.0 / np.sqrt(precision)
        found = optimize.minimize_scalar(
            force.square,
            bounds=(best - 5 * width, best + 5 * width),
            method="bounded",
            options={"xatol": 0.02 * width},
        )
        assert found.x == pytest.approx(best, abs=0.2 * width)
        assert found.fun == pytest.approx(profile.min_distance2[0, movement, 0], abs=0.02, rel=0.02)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("off", [0.0, 0.1])
@pytest.mark.parametrize("motor", range(4))
def test_densities_are_those_of_brute_force(scene_of, motor, off, held):
    """Of all alternatives together, at angles around the best one.

    A parabola stands for a circle: the further away, the larger the error [nats for each rad].
    """
    likelihood = scene_of(10 + motor, off * np.eye(4)[motor])
    profile = likelihood.profile(motor)
    for movement in range(2):
        force = BruteForce(likelihood, movement, motor)
        best, precision = (x[0, movement, 0] for x in (profile.mode, profile.precision))
        width = np.sqrt(1.0 / precision + (0.0 if held else SCATTER[motor] ** 2))
        steps = width * np.array([-3.0, -1.0, 0.0, 0.5, 2.0])
        angles = np.broadcast_to(best + steps[:, None], (1, 2, 5, 1))
        got = profile.log_density(angles, held)[0, movement]
        expected = np.log([force.density(angle, held) for angle in best + steps])
        assert (np.abs(got - expected) < 0.02 + 5.0 * np.abs(steps)).all()


@pytest.mark.parametrize("motor", range(4))
def test_a_healthy_motor_is_the_healthy_robot(scene_of, motor):
    """A motor that settles where healthy ones do, scatter and all, is no fault."""
    likelihood = scene_of(5, np.zeros(4))
    profile = likelihood.profile(motor)
    found = profile.log_density(profile.expected[:, :, None], False)[..., 0]
    np.testing.assert_allclose(found, likelihood.log_healthy, rtol=0, atol=0.05)


def test_near_its_axis_a_motor_is_where_it_should_be_if_that_explains_the_tool(twin, run_of):
    """The tool is 2 to 6 mm beside the axis of motor 1, so the nearest angle may be anywhere.

    Small errors of the motor have the densities of brute force, none that of a healthy robot.
    """
    rng = np.random.default_rng(3)
    poses = rng.uniform(-1.5, 1.5, (20_000, 4))
    model = HealthyModel(twin, IMPERFECT)
    beside = np.linalg.norm(model.sensors.expected(poses)[1][..., 0], axis=1)
    targets = poses[(beside > 0.002) & (beside < 0.006)][:100]
    points = twin.path(targets + SCATTER * rng.standard_normal(targets.shape))
    likelihood = RunLikelihood(settled_evidence(run_of(targets, points, MOTORS)), model)
    profile = likelihood.profile(0)
    at_expected = profile.log_density(profile.expected[:, :, None], False)[0, :, 0]
    assert np.mean(np.abs(at_expected - likelihood.log_healthy[0]) < 1.0) > 0.96
    anew = np.flatnonzero(profile.place[0, :, 0] != profile.mode[0, :, 0])
    assert len(anew) >= 5
    off = np.array([-0.01, 0.0, 0.01])
    for movement in anew[:6]:
        force = BruteForce(likelihood, movement, 0)
        angles = profile.expected[0, movement, 0] + off
        shape = (1, len(targets), len(off), 1)
        got = profile.log_density(np.broadcast_to(angles[:, None], shape), False)[0, movement]
        expected = np.log([force.density(angle, False) for angle in angles])
        np.testing.assert_allclose(got, expected, rtol=0, atol=0.4)


@pytest.mark.parametrize("turned", [3.5, 4.5, 2.0 * np.pi, 7.0])
def test_a_full_turn_makes_no_difference_where_a_motor_may_turn_around(tmp_path, run_of, turned):
    twin = small_twin(tmp_path, "scara", SCARA, tool="0.2 0 0")
    targets = np.array([[0.1, 2.0, 0.5], [0.2, -1.5, -0.7]])
    model = HealthyModel(twin, NO_IMPERFECTIONS)
    runs = run_of(targets, twin.path(targets), ("motor_1", "motor_2", "motor_3"))
    profile = RunLikelihood(settled_evidence(runs), model).profile(1)
    assert profile.wraps
    found = [profile.log_terms(profile.mode + off, True) for off in (turned, turned - 2.0 * np.pi)]
    np.testing.assert_allclose(*found, rtol=1e-9)


def test_far_angles_are_left_to_the_outliers(scene_of):
    likelihood = scene_of(1, np.zeros(4))
    profile = likelihood.profile(0)
    far = np.broadcast_to(profile.mode[:, :, None] + 2.0, (1, 2, 1, profile.mode.shape[-1]))
    np.testing.assert_allclose(profile.log_density(far, True), np.log(ANYWHERE), atol=0.2)
    assert np.exp(profile.outlier) == pytest.approx(ANYWHERE, rel=1e-6)
