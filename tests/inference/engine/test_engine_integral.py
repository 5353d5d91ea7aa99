"""The integral of one moment, judged by numerical integration."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from failuretwin.inference.engine.integral import (
    FURTHEST,
    Moment,
    Noise,
    invert,
    moment_integral,
    scale_mixture,
)

COUNT = 400_000


@pytest.mark.parametrize("dims", [1, 3, 6])
@pytest.mark.parametrize("dof", [2.5, 4.0, 9.6, 30.0])
def test_five_normals_are_a_student_t(dof, dims):
    factors, log_omega = scale_mixture(dof, dims)
    square = np.r_[0.0, np.geomspace(0.01, FURTHEST, 500)]
    points = np.zeros((len(square), dims))
    points[:, 0] = np.sqrt(square)
    exact = stats.multivariate_t(np.zeros(dims), np.eye(dims), dof).logpdf(points)
    normal = [stats.multivariate_normal(np.zeros(dims), np.eye(dims) / f) for f in factors]
    found = logsumexp(
        [w + n.logpdf(points) for w, n in zip(log_omega, normal, strict=True)], axis=0
    )
    assert np.abs(found - exact).max() < 0.13
    assert np.abs(found - exact).mean() < 0.06


def moment(rng, outcomes=4, spread=1.0):
    """One row: outcomes near each other, and f with a covariance of its own."""
    root = rng.normal(size=(outcomes, 3, 3)) * 1e-3
    scale = root @ np.swapaxes(root, -1, -2) + (0.5e-3) ** 2 * np.eye(3)
    residual = rng.normal(scale=4e-3, size=(outcomes, 3))
    weight = np.log(rng.dirichlet(np.ones(outcomes)))
    root = rng.normal(size=(3, 3)) * 2e-3 * spread
    return residual, scale, weight, root @ root.T


def says(residual, scale, log_weight, mean, covariance, noise):
    """What the moment says."""
    outcomes, channels = residual.shape
    share, alpha = np.zeros(outcomes), np.zeros(channels)
    curvature = np.zeros((channels, channels))
    written = share, alpha, curvature
    total = moment_integral(Moment(residual, scale, log_weight, mean, covariance), noise, *written)
    return SimpleNamespace(log_evidence=total, share=share, alpha=alpha, curvature=curvature)


@pytest.mark.parametrize("seed", range(8))
def test_evidence_mean_and_covariance_are_those_of_many_draws(seed):
    rng = np.random.default_rng(seed)
    *parts, covariance = moment(rng, spread=[0.2, 1.0, 4.0][seed % 3])
    mean = rng.normal(scale=1e-3, size=3)
    noise = Noise.of(dof=5.0, dims=3, log_outlier=-2.5)
    found = says(*parts, mean, covariance, noise)
    f = rng.multivariate_normal(mean, covariance, size=COUNT)
    terms = [
        w + stats.multivariate_t(r, S, noise.dof).logpdf(f) for r, S, w in zip(*parts, strict=True)
    ]
    weight = logsumexp([*terms, np.full(COUNT, noise.log_outlier)], axis=0)
    share = np.exp(weight - logsumexp(weight))
    effective = 1.0 / np.sum(share**2)
    assert found.log_evidence == pytest.approx(logsumexp(weight) - np.log(COUNT), abs=0.06)
    centre = share @ f
    spread = (f - centre).T @ ((f - centre) * share[:, None])
    told = mean + covariance @ found.alpha
    deviation = np.sqrt(np.diag(spread))
    assert np.abs(told - centre).max() < (0.1 + 4.0 / np.sqrt(effective)) * deviation.max()
    after = covariance - covariance @ found.curvature @ covariance
    assert np.sqrt(np.diag(after)) == pytest.approx(deviation, rel=0.15)


def test_without_doubt_the_evidence_is_the_density_of_the_mixture():
    rng = np.random.default_rng(1)
    *parts, _ = moment(rng, outcomes=20)
    noise = Noise.of(dof=4.0, dims=3, log_outlier=-2.5)
    found = says(*parts, np.zeros(3), np.zeros((3, 3)), noise)
    terms = [
        w + stats.multivariate_t(np.zeros(3), S, noise.dof).logpdf(r)
        for r, S, w in zip(*parts, strict=True)
    ]
    exact = logsumexp([*terms, noise.log_outlier])
    assert found.log_evidence == pytest.approx(exact, abs=0.06)
    shares = np.exp(np.array(terms) - exact)
    assert found.share == pytest.approx(shares, abs=0.02)


def test_a_tool_anywhere_says_nothing():
    residual, scale = np.full((1, 3), 5.0), 1e-6 * np.eye(3)[None]
    noise = Noise.of(dof=5.0, dims=3, log_outlier=-2.5)
    found = says(residual, scale, np.zeros(1), np.zeros(3), 1e-4 * np.eye(3), noise)
    assert found.log_evidence == pytest.approx(-2.5, abs=1e-6)
    assert np.abs(found.alpha * 1e-2).max() < 1e-4
    assert found.share[0] < 1e-6


@pytest.mark.parametrize("size", [1, 3, 5])
def test_inverse_of_positive_matrices(size):
    root = np.random.default_rng(size).normal(size=(size, size))
    matrix = root @ root.T + 0.1 * np.eye(size)
    found = matrix.copy()
    assert invert(found) == pytest.approx(np.linalg.det(matrix))
    assert found == pytest.approx(np.linalg.inv(matrix))


def test_an_outcome_whose_scale_no_double_holds_is_left_out():
    """Its determinant is negative by rounding: the others, and the outlier, share the moment."""
    residual, scale, weight, covariance = moment(np.random.default_rng(3))
    noise = Noise.of(dof=5.0, dims=3, log_outlier=-2.5)
    scale[1] = -covariance - 1e-6 * np.eye(3)
    found = says(residual, scale, weight, np.zeros(3), covariance, noise)
    kept = [0, 2, 3]
    others = says(residual[kept], scale[kept], weight[kept], np.zeros(3), covariance, noise)
    assert found.log_evidence == pytest.approx(others.log_evidence)
    np.testing.assert_allclose(found.share, np.insert(others.share, 1, 0.0))
    np.testing.assert_allclose(found.alpha, others.alpha)
