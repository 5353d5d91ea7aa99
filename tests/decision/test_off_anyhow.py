"""One motor or two that are off anyhow: densities against quadrature, sampling and regression."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats
from small_arms import GANTRY, small_twin

from failuretwin.core.movements import Movements
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections, Readings
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.faults.unknown import unmodelled_offsets_likelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.movements.two_joint_likelihood import (
    GaussianBelief,
    two_joint_likelihood,
)
from failuretwin.inference.observation.evidence import SettledEvidence, settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
SCATTER = np.array([0.005, 0.006, 0.005, 0.004])
DOF = 6.0
SETTLING = Settling((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, tuple(SCATTER), DOF, "made up")
READINGS = Readings(10.0, noise_m=float(np.sqrt(0.001**2 - 0.0003**2)))
"""With what belongs to no sensor, 1 mm."""
PLAIN = Imperfections("made up", "test", settling=SETTLING, readings=READINGS)
PAIRS = [(0, 1), (0, 3), (1, 2), (2, 3)]
POSE = dict(zip(PAIRS, [2, 4, 4, 2], strict=True))
"""Seeds of poses that are not near singular ones."""


@pytest.fixture(scope="module")
def scene_of(twin, run_of):
    """Make a scene of random targets at whose ends the arm is off by `off` [rad]."""

    def make(seed, off, count=1):
        targets = np.random.default_rng(seed).uniform(-0.6, 0.6, (count, 4))
        runs = run_of(targets, twin.path(targets + off), MOTORS)
        return RunLikelihood(settled_evidence(runs), HealthyModel(twin, PLAIN))

    return make


def found_angles(likelihood, pair):
    return two_joint_likelihood(likelihood.evidence, likelihood.model, likelihood.outcomes, pair)


@pytest.mark.parametrize("pair", PAIRS)
def test_two_motors_are_found_where_they_stand(scene_of, pair):
    off = np.zeros(4)
    off[list(pair)] = 0.5, -0.4
    likelihood = scene_of(2, off)
    truth = likelihood.evidence.movements.target[0, 0] + off
    found = found_angles(likelihood, pair)
    ways = np.isfinite(found.log_weight[0, 0])
    error = found.angle[0, 0, ways] - truth[list(pair)]
    deviation = np.sqrt(np.diagonal(found.covariance[0, 0, ways], axis1=1, axis2=2))
    assert (np.abs(error) / deviation).max(axis=1).min() < 0.1


@pytest.mark.parametrize("pair", PAIRS)
def test_any_two_angles_are_as_probable_as_quadrature_says(scene_of, twin, pair):
    """The density of a place if two motors may be anywhere, against a sum over a fine grid."""
    off = np.zeros(4)
    off[list(pair)] = 0.3, 0.35
    off[[k for k in range(4) if k not in pair]] = 0.006, -0.005
    likelihood = scene_of(POSE[pair], off)
    found = found_angles(likelihood, pair)
    told = np.exp(found.log_weight[0, 0]).sum()
    others = SCATTER.copy()
    others[list(pair)] = 0.0

    def density(angle):
        pose = np.broadcast_to(
            likelihood.evidence.movements.target[0, 0], (*angle.shape[:-1], 4)
        ).copy()
        pose[..., list(pair)] = angle
        place, jacobian = twin.path_and_jacobian(pose)
        root = jacobian * others
        spread = root @ np.swapaxes(root, -1, -2) + likelihood.model.path_noise**2 * np.eye(3)
        error = likelihood.evidence.point[0, 0] - place
        square = np.einsum("...i,...i", error, np.linalg.solve(spread, error[..., None])[..., 0])
        norm = stats.multivariate_t.pdf(np.zeros(3), np.zeros(3), np.eye(3), DOF)
        fall = (1.0 + square / DOF) ** (-0.5 * (DOF + 3.0))
        return norm * fall / np.sqrt(np.linalg.det(spread))

    ways = np.isfinite(found.log_weight[0, 0])
    around = 8.0 * np.sqrt(np.diagonal(found.covariance[0, 0, ways], axis1=1, axis2=2))
    low = (found.angle[0, 0, ways] - around).min(axis=0)
    high = (found.angle[0, 0, ways] + around).max(axis=0)
    axes = [np.linspace(*ends, 501) for ends in zip(low, high, strict=True)]
    values = density(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    total = integrate.trapezoid(integrate.trapezoid(values, axes[1]), axes[0])
    # 0.99: the rest are outliers. Motors 3 and 4 are near a straight elbow in all of these poses.
    assert told == pytest.approx(0.99 * total, rel=0.3 if pair == (2, 3) else 0.02)


def test_a_belief_learns_as_regression_does():
    """Movement by movement, errors are as probable as all of them are together."""
    rng = np.random.default_rng(3)
    slope = rng.normal(size=(4, 2))
    roots = rng.normal(size=(4, 2, 2))
    noise = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(2)
    variance = np.array([0.5, 2.0])
    error = rng.normal(size=(4, 2))
    belief = GaussianBelief(np.zeros((1, 1, 2)), np.diag(variance)[None, None])
    total = 0.0
    for m in range(4):
        x = slope[m][None, None]
        covariance = belief.predict(x[:, :, None])[:, :, 0] + noise[m]
        off = error[m] - slope[m] * belief.mean
        total += stats.multivariate_normal.logpdf(off[0, 0], cov=covariance[0, 0])
        belief = belief.update(x, off, covariance)
    stacked = np.concatenate([np.diag(x) for x in slope])
    whole = stacked @ np.diag(variance) @ stacked.T
    for m in range(4):
        whole[2 * m : 2 * m + 2, 2 * m : 2 * m + 2] += noise[m]
    assert total == pytest.approx(stats.multivariate_normal.logpdf(error.ravel(), cov=whole))
    gain = np.diag(variance) @ stacked.T @ np.linalg.inv(whole)
    np.testing.assert_allclose(belief.mean[0, 0], gain @ error.ravel(), atol=1e-9)


def of_points(likelihood, points):
    """Return a scene of as many runs of one movement, that settle at the points."""
    m, count = likelihood.evidence.movements, len(points)
    one = np.ones((count, 1))
    evidence = SettledEvidence(
        Movements(*(np.repeat(v, count, axis=0) for v in vars(m).values())),
        points[:, None],
        one > 0,
        one < 0,
        one * likelihood.evidence.begin,
        one * likelihood.evidence.end,
        one * likelihood.evidence.first_reading_delay,
        np.repeat(likelihood.evidence.arrived, count, axis=0),
        np.zeros(count, dtype=bool),
    )
    return RunLikelihood(evidence, likelihood.model)


def test_densities_integrate_to_no_more_than_one(scene_of):
    """Over all places that the arm reaches, and with scatter so wide that few points will do."""
    likelihood = scene_of(4, np.zeros(4))
    likelihood = replace(likelihood, model=replace(likelihood.model, scatter_factor=25.0))
    rng = np.random.default_rng(4)
    reach, count = likelihood.model.twin.robot.reach + 0.1, 4000
    points = rng.normal(size=(count, 3))
    radius = reach * rng.uniform(size=(count, 1)) ** (1 / 3)
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    density = np.exp(unmodelled_offsets_likelihood(of_points(likelihood, points)).log_evidence)
    whole = 4 / 3 * np.pi * reach**3 * density.mean()
    error = 4 / 3 * np.pi * reach**3 * density.std() / np.sqrt(count)
    assert error < 0.15
    assert 0.3 < whole < 1.0 + 2.0 * error


def test_two_slides_that_are_off_are_a_closed_form(tmp_path, run_of):
    """Two slides of three, off by a constant: places are normal about their targets."""
    twin = small_twin(tmp_path, "gantry", GANTRY)
    targets = np.random.default_rng(5).uniform([-0.2, -0.1, 0.1], [0.2, 0.3, 0.4], (4, 3))
    names = tuple(motor.name for motor in twin.robot.motors)
    model = HealthyModel(twin, NO_IMPERFECTIONS)
    for off in ([0.1, 0.15, 0.0], [0.0, -0.1, 0.1]):
        runs = run_of(targets, twin.path(targets + off), names)
        likelihood = RunLikelihood(settled_evidence(runs), model)
        healthy = likelihood.log_healthy.sum()
        found = unmodelled_offsets_likelihood(likelihood).log_evidence[0]
        # Four places to 1 mm each, but for two amounts of 0.3 m: what they cost is told by Occam.
        sharp = 4 * np.log((2 * np.pi * model.path_noise**2) ** -1.5)
        occam = 2 * np.log(model.path_noise / 2 / 0.3) - 0.5 * (np.sum(np.square(off)) / 0.3**2)
        chance = 4 * np.log(0.8) - np.log(2 * 16 * 3)
        assert found == pytest.approx(sharp + occam + chance, abs=1.0)
        assert found > healthy + 20.0


@pytest.mark.parametrize(("stands", "found"), [(0.28, True), (0.63, True), (0.66, False)])
def test_two_motors_stand_a_fifth_beyond_their_range_at_most(tmp_path, run_of, stands, found):
    """Limits of -0.46 m and 0.46 m: no further than 0.644 m."""
    twin = small_twin(tmp_path, "gantry", GANTRY)
    names = tuple(motor.name for motor in twin.robot.motors)
    runs = run_of([[0.1, 0.1, 0.2]], twin.path(np.array([[stands, 0.0, 0.2]])), names)
    likelihood = RunLikelihood(settled_evidence(runs), HealthyModel(twin, NO_IMPERFECTIONS))
    assert np.isfinite(found_angles(likelihood, (0, 1)).log_weight).any() == found


def test_an_arm_of_one_motor_has_no_pair(tmp_path, run_of):
    twin = small_twin(tmp_path, "slide", GANTRY[:1])
    runs = run_of([[0.1], [0.2]], twin.path(np.array([[0.1], [0.2]])), ("motor_1",))
    assert (
        unmodelled_offsets_likelihood(
            RunLikelihood(settled_evidence(runs), HealthyModel(twin, NO_IMPERFECTIONS))
        )
        is None
    )
