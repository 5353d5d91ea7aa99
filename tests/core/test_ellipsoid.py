from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from failuretwin.core.numerics import Covariance, Ellipsoid, log_fall, log_norm

DOFS = [1.0, 2.5, 4.0, 30.0, np.inf]


def student(shape, dof):
    """Return scipy's distribution with this scale matrix."""
    if np.isinf(dof):
        return stats.multivariate_normal(cov=shape)
    return stats.multivariate_t(shape=shape, df=dof)


def drawn(seed, columns, size, noise):
    """Return roots (2, 5, 3, column), their covariances, and two sets of vectors (2, 5, 3)."""
    rng = np.random.default_rng(seed)
    root = size * rng.normal(size=(2, 5, 3, columns))
    shape = root @ np.swapaxes(root, -1, -2) + noise * np.eye(3)
    return root, shape, rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5, 3))


@given(
    seed=st.integers(0, 1000),
    columns=st.integers(1, 7),
    size=st.sampled_from([0.0, 1e-3, 0.05]),
    noise=st.sampled_from([1e-6, 1.0]),
)
def test_solutions_are_those_of_linear_algebra(seed, columns, size, noise):
    """Scales of a robot and worse: one direction may be a hundred times wider than another."""
    root, shape, a, b = drawn(seed, columns, size, noise)
    spread = Ellipsoid.of(root, noise)
    solved = np.linalg.solve(shape, b[..., None])[..., 0]
    np.testing.assert_allclose(spread.determinant, np.linalg.det(shape), rtol=1e-6)
    top = np.abs(solved).max()
    np.testing.assert_allclose(spread.solve(b), solved, rtol=1e-6, atol=1e-6 * top)
    np.testing.assert_allclose(spread.product(a, b), np.sum(a * solved, -1), atol=1e-5 * top)


@pytest.mark.parametrize("dof", DOFS)
def test_norm_is_the_density_at_the_centre(dof):
    root, shape, *_ = drawn(3, 4, 0.01, 1e-6)
    found = Ellipsoid.of(root, 1e-6).log_norm(dof)
    for at in np.ndindex(2, 5):
        assert found[at] == pytest.approx(student(shape[at], dof).logpdf(np.zeros(3)), abs=1e-9)


@pytest.mark.parametrize("dof", DOFS)
def test_fall_is_that_of_the_standard_density(dof):
    standard = student(np.eye(3), dof)
    along = np.array([0.0, 0.3, 1.0, 4.0, 50.0])
    points = np.outer(along, [0.6, -0.8, 0.0])
    np.testing.assert_allclose(
        log_norm(dof) + log_fall(along**2, dof), standard.logpdf(points), rtol=1e-12
    )


@pytest.mark.parametrize("dof", DOFS)
@pytest.mark.parametrize("dims", [1, 2])
def test_in_fewer_dimensions_it_is_the_margin(dof, dims):
    """What is left of the 3-variate density once the other directions are integrated over."""
    margin = student(np.eye(3)[:dims, :dims], dof)
    along = np.array([0.0, 0.3, 1.0, 4.0, 50.0])
    points = np.outer(along, [0.6, -0.8][:dims])
    square = np.sum(points**2, axis=-1)
    np.testing.assert_allclose(
        log_norm(dof, dims) + log_fall(square, dof, dims), margin.logpdf(points), rtol=1e-12
    )


def test_many_degrees_of_freedom_are_normal():
    square = np.linspace(0.0, 30.0, 7)
    np.testing.assert_allclose(log_fall(square, 1e9), log_fall(square, np.inf), rtol=1e-6)
    assert log_norm(1e9) == pytest.approx(log_norm(np.inf), abs=1e-6)


@given(
    seed=st.integers(0, 1000),
    columns=st.integers(1, 7),
    size=st.sampled_from([0.0, 1e-3, 0.05]),
)
def test_the_inverse_root_is_the_cholesky_factor_of_the_inverse(seed, columns, size):
    """A with A^T A = S^-1 is unique once it is upper triangular with a positive diagonal."""
    root, shape, a, _ = drawn(seed, columns, size, 1e-3)
    spread = Ellipsoid.of(root, 1e-3)
    found, lower = spread.inverse_root, np.linalg.cholesky(np.linalg.inv(shape))
    top = np.abs(lower).max()
    np.testing.assert_allclose(found, np.swapaxes(lower, -1, -2), rtol=1e-6, atol=1e-6 * top)
    white = np.matmul(found, a[..., None])[..., 0]
    np.testing.assert_allclose(np.sum(white**2, axis=-1), spread.product(a, a), rtol=1e-6)


def test_the_inverse_root_by_hand():
    """S = diag(1, 1/4, 1/9) turned by nothing, and one with a single pair that belongs together."""
    root = np.diag([1.0, 0.5, 1.0 / 3.0])
    np.testing.assert_allclose(Ellipsoid.of(root, 0.0).inverse_root, np.diag([1.0, 2.0, 3.0]))
    # S^-1 = [[4, 2, 0], [2, 5, 4], [0, 4, 13]] = A^T A with A = [[2, 1, 0], [0, 2, 2], [0, 0, 3]].
    factor = np.array([[2.0, 1.0, 0.0], [0.0, 2.0, 2.0], [0.0, 0.0, 3.0]])
    found = Ellipsoid.of(np.linalg.inv(factor), 0.0).inverse_root
    np.testing.assert_allclose(found, factor, atol=1e-9)


@pytest.mark.parametrize("dims", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("dof", [2.5, np.inf])
def test_densities_in_any_number_of_dimensions_are_those_of_scipy(dims, dof):
    rng = np.random.default_rng(dims)
    root, error = rng.normal(size=(4, dims, 3)), rng.normal(size=(4, dims))
    spread = Covariance.of(root, 0.3)
    for at in range(4):
        shape = root[at] @ root[at].T + 0.3 * np.eye(dims)
        expected = student(shape, dof).logpdf(error[at])
        assert spread.log_student(error, dof)[at] == pytest.approx(expected, abs=1e-9)
        whitened = spread.inverse_root[at] @ error[at]
        assert whitened @ whitened == pytest.approx(spread.product(error, error)[at])
        np.testing.assert_allclose(np.tril(spread.inverse_root[at], -1), 0.0, atol=1e-12)


def test_on_a_surface_the_density_is_that_of_fewer_dimensions():
    """Deviations along two of five axes: but for a constant, a Student t of two."""
    root = np.zeros((5, 2))
    root[0, 0], root[1, 1] = 2.0, 0.5
    spread, plane = Covariance.of(root, 0.1, dims=2), root[:2] @ root[:2].T + 0.1 * np.eye(2)
    points = np.random.default_rng(0).normal(size=(6, 2))
    found = [spread.log_student(np.array([*p, 0.0, 0.0, 0.0]), 4.0) for p in points]
    constant = -0.5 * 3 * np.log(0.1)
    np.testing.assert_allclose(found, student(plane, 4.0).logpdf(points) + constant)
