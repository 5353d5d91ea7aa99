from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.numerics import log_student
from failuretwin.digital_model.nonidealities import (
    Imperfections,
    LostCommand,
    Readings,
    Timing,
    Variation,
)
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.faults.priors import OnsetPrior, priors_of
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.set_ups.setup_prior import SetupPrior

PATH_NOISE_M, OUTLIER_RATE = 0.001, 0.01

COUNT = np.deg2rad(0.24)
MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
TARGETS = np.array([[0.5, -0.4, 0.3, -0.2], [-0.3, 0.6, -0.5, 0.4]])
DIRECTION = np.array([[1, -1, 1, -1], [-1, 1, -1, 1]])
SETTLING = Settling(
    bias=(0.01, -0.02, 0.0, 0.005),
    compliance=(0.0,) * 4,
    friction=(0.004, 0.0, 0.006, 0.002),
    scatter=(0.006, 0.007, 0.006, 0.004),
    tail_dof=4.0,
    source="made up",
)
READINGS = Readings(10.0, noise_m=float(np.sqrt(PATH_NOISE_M**2 - 0.0003**2)))
"""With what belongs to no sensor, 1 mm."""


@given(
    seed=st.integers(0, 1000),
    motors=st.integers(1, 6),
    dof=st.sampled_from([1.0, 2.5, 4.0, 30.0, np.inf]),
    scale=st.sampled_from([0.001, 1.0]),
)
def test_log_student_is_that_of_scipy(seed, motors, dof, scale):
    rng = np.random.default_rng(seed)
    jacobian, error = scale * rng.normal(size=(2, 3, motors)), scale * rng.normal(size=(2, 3))
    got = log_student(error, jacobian, scale**2, dof)
    for i in range(2):
        shape = jacobian[i] @ jacobian[i].T + scale**2 * np.eye(3)
        kind = (
            stats.multivariate_normal(cov=shape)
            if np.isinf(dof)
            else stats.multivariate_t(shape=shape, df=dof)
        )
        assert got[i] == pytest.approx(kind.logpdf(error[i]), rel=1e-9, abs=1e-9)


def slopes(twin, pose):
    """Return how the tool moves with each motor, by finite differences, (axis, motor) [m/rad]."""
    step = 1e-6 * np.eye(len(pose))
    return ((twin.path(pose + step) - twin.path(pose - step)) / 2e-6).T


def density(twin, point, pose):
    """Return the density of a settled point of the robot of `SETTLING` [1/m3]."""
    scaled = slopes(twin, pose) * np.array(SETTLING.scatter)
    shape = scaled @ scaled.T + PATH_NOISE_M**2 * np.eye(3)
    reach = 0.028505 + 0.0361 + 0.10048 + 0.094714 + 0.05071
    sound = stats.multivariate_t(twin.path(pose), shape, 4.0).pdf(point)
    return (1 - OUTLIER_RATE) * sound + OUTLIER_RATE / (4 / 3 * np.pi * reach**3)


def settled_pose(movement):
    return TARGETS[movement] + np.array(SETTLING.bias) - SETTLING.friction * DIRECTION[movement]


@pytest.mark.parametrize("off", [0.0, 0.03, 0.12, 1.0])
@pytest.mark.parametrize("motor", range(4))
def test_posterior_of_an_error_is_that_of_brute_force(twin, run_of, motor, off):
    """Two movements: densities by scipy, offsets integrated by adaptive quadrature."""
    poses = np.array([settled_pose(m) for m in range(2)])
    wrong = poses.copy()
    wrong[:, motor] += [off, -off]
    points = twin.path(wrong)
    runs = run_of(TARGETS, points, MOTORS)
    fault = Hypothesis.parse(f"motor_{motor + 1}:steady_state_error", MOTORS)
    priors = priors_of(twin.robot, (10.0, 50.0), None)
    priors = replace(priors, onset=OnsetPrior(prior_before_run=1.0), setup=SetupPrior.known())
    imperfections = Imperfections("made up", "test", settling=SETTLING, readings=READINGS)

    (diagnosis,) = BayesDiagnoser(twin, imperfections, (Hypothesis(), fault), priors).diagnose(runs)

    def weigh(movement):
        def shifted(offset):
            pose = poses[movement].copy()
            pose[motor] += offset
            return density(twin, points[movement], pose)

        sides = ((-50 * COUNT, -10 * COUNT), (10 * COUNT, 50 * COUNT))
        total = sum(integrate.quad(shifted, *side, limit=200)[0] for side in sides)
        return total / (80 * COUNT)

    healthy = np.prod([density(twin, points[m], poses[m]) for m in range(2)])
    faulty = np.prod([weigh(m) for m in range(2)])
    odds = np.log(diagnosis.posterior["healthy"]) - np.log(diagnosis.posterior[str(fault)])
    # Where neither explains anything (1 rad), both are far tails, and a parabola is a rough one.
    assert odds == pytest.approx(np.log(healthy) - np.log(faulty), abs=0.2 if off < 1.0 else 2.5)


@pytest.fixture
def lossy():
    """Motor 1 misses one command in ten, one in two when the movement starts late."""
    lost = (LostCommand(("motor_1",), 0.1, 0.5),)
    return Imperfections(
        "lossy", "test", settling=SETTLING, timing=Timing(late_rate=0.3), lost_commands=lost
    )


def outcomes(twin, imperfections, starts):
    count = len(starts)
    movements = Movements(
        initial=np.zeros((1, 4)),
        target=np.resize(TARGETS, (1, count, 4)),
        ramp_duration=np.full((1, count, 4), 0.8),
        start=np.array(starts, dtype=float)[None],
    )
    return HealthyModel(twin, imperfections).outcomes(movements)


def test_a_motor_that_loses_its_command_stays(twin, lossy):
    found = outcomes(twin, lossy, [0.0, 2.0])
    arrives, lost = found.base[0, :, 0], found.base[0, :, 1]
    np.testing.assert_array_equal(arrives, TARGETS)
    np.testing.assert_array_equal(lost[:, 0], [0.0, TARGETS[0, 0]])
    np.testing.assert_array_equal(lost[:, 1:], TARGETS[:, 1:])


def test_late_movements_lose_more_commands(twin, lossy):
    """A late start holds up the next command; of the last movement only the rate is known."""
    found = outcomes(twin, lossy, [0.0, 2.0, 5.0])
    weights = np.exp(found.log_weight[0]) / (1 - OUTLIER_RATE)
    rates = np.array([0.1, 0.5, 0.1 + 0.3 * 0.4])
    np.testing.assert_allclose(weights[:, 1:].sum(axis=1), rates)
    # Missing some in a row is as probable as missing each of them.
    np.testing.assert_allclose(weights[:, 2], rates * [0.0, 0.1, 0.5 * 0.9])
    np.testing.assert_allclose(weights[:, 3], rates * [0.0, 0.0, 0.5 * 0.1])
    total = np.exp(found.log_weight).sum(axis=-1)
    np.testing.assert_allclose(total, 1 - OUTLIER_RATE)


def test_a_motor_that_misses_two_commands_stays_where_it_was_before_both(twin, lossy):
    found = outcomes(twin, lossy, [0.0, 2.0, 4.0])
    assert not found.lost[0].any() and found.lost[1:, 0].all()
    # Before the third movement it was told TARGETS[1], before the second TARGETS[0].
    np.testing.assert_array_equal(found.base[0, 1, 2, 0], 0.0)
    np.testing.assert_array_equal(found.base[0, 1, 1, 0], TARGETS[0, 0])


def test_one_lost_command_is_no_fault_where_commands_get_lost(twin, run_of, lossy):
    """Motor 1 stays where it settled first, 0.15 rad from its second target."""
    targets = TARGETS.copy()
    targets[1, 0] = targets[0, 0] + 0.15
    poses = np.array([settled_pose(m) for m in range(2)])
    poses[1, 0] = poses[0, 0]
    runs = run_of(targets, twin.path(poses), MOTORS)
    hypotheses = tuple(
        Hypothesis.parse(h, MOTORS) for h in ("healthy", "motor_1:steady_state_error")
    )
    never = replace(lossy, lost_commands=())

    def healthy(imperfections):
        (diagnosis,) = BayesDiagnoser(twin, imperfections, hypotheses).diagnose(runs)
        return diagnosis.posterior["healthy"]

    assert healthy(lossy) > 5 * healthy(never)


def test_evidence_of_a_run_is_where_it_was_put(twin, run_of):
    points = twin.path(TARGETS)
    np.testing.assert_allclose(settled_evidence(run_of(TARGETS, points, MOTORS)).point[0], points)


def test_doubt_about_the_robot_widens_the_scatter(armpi, twin):
    """A motor of unknown bias scatters by both: the variances add up."""
    doubt = Variation(bias=(0.003, 0.0, 0.0, 0.0), friction=(0.0, 0.004, 0.0, 0.0))
    sure = HealthyModel(
        twin, Imperfections("made up", "test", settling=SETTLING, readings=READINGS)
    )
    unsure = HealthyModel(
        twin, Imperfections("made up", "test", settling=SETTLING, variation=doubt)
    )
    extra = np.array([0.003, 0.004, 0.0, 0.0])
    np.testing.assert_allclose(unsure.scatter, np.hypot(sure.scatter, extra), rtol=1e-12)


@pytest.mark.parametrize("doubt", [0.2, 0.5])
def test_doubt_about_the_scatter_counts_by_its_mean_square(twin, doubt):
    """A scatter known to a factor e^(doubt z), z normal: its square is averaged over z."""
    variation = Variation(scatter=(doubt,) * 4)
    model = HealthyModel(
        twin, Imperfections("made up", "test", settling=SETTLING, variation=variation)
    )
    factor, _ = integrate.quad(
        lambda z: np.exp(doubt * z) ** 2 * stats.norm.pdf(z), -12.0, 12.0, epsabs=1e-12
    )
    expected = np.sqrt(factor) * np.array(SETTLING.scatter)
    np.testing.assert_allclose(model.scatter, expected, rtol=1e-9)


def test_what_whole_counts_round_off_adds_to_the_scatter(twin):
    """Uniform over a count of 0.24 deg: its deviation is the count over the root of twelve."""
    readings = Readings(10.0, noise_m=0.0004, whole_counts=True)
    model = HealthyModel(
        twin, Imperfections("made up", "test", settling=SETTLING, readings=readings)
    )
    np.testing.assert_allclose(
        model.scatter, np.hypot(SETTLING.scatter, COUNT / np.sqrt(12.0)), rtol=1e-9
    )
    assert model.path_noise == pytest.approx(np.hypot(0.0004, 0.0003))
    wide = replace(model, scatter_factor=3.0)
    np.testing.assert_allclose(wide.scatter, 3.0 * model.scatter)
    assert wide.path_noise == pytest.approx(3.0 * model.path_noise)


def test_timing_of_the_healthy_robot_is_that_of_its_means(twin):
    """A loop follows a ramp one over its integral gain late: 0.025 s at 40/s."""
    timing = Timing(delay_s=(0.01, 0.05), lag_s=(0.0, 0.02), ramp_shortening=(0.1, 0.3))
    model = HealthyModel(twin, Imperfections("made up", "test", settling=SETTLING, timing=timing))
    loops = np.mean([1.0 / motor.loop.I for motor in twin.robot.motors])
    assert loops == pytest.approx(0.025, rel=0.05)
    assert model.lag_s == pytest.approx(loops + 0.03 + 0.01)
    assert model.shortening == pytest.approx(0.2)


def test_doubt_about_stiffness_counts_by_the_load(armpi, twin):
    settling = replace(SETTLING, compliance=(0.0, 0.1, 0.1, 0.1), scatter=(0.0,) * 4)
    doubt = Variation(compliance=(0.0, 0.2, 0.2, 0.2))
    model = HealthyModel(twin, Imperfections("made up", "test", settling=settling, variation=doubt))
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    poses = np.random.default_rng(7).uniform(low, high, (20000, 4))
    load = np.sqrt(np.mean(armpi.loads.torque(poses * armpi.sense) ** 2, axis=0))
    np.testing.assert_allclose(model.scatter[1:], 0.1 * 0.2 * load[1:], rtol=0.1)
    assert model.scatter[0] == 0.0
