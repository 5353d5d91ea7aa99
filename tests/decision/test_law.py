from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from failuretwin.inference.faults.marginal import ChangePointPosterior, change_points, leave_one_out


def problem(seed, movements, cells, ways):
    """Return densities of one run, healthy and with a fault, and a normalised prior."""
    rng = np.random.default_rng(seed)
    healthy = rng.normal(0.0, 3.0, (1, movements))
    density = rng.normal(0.0, 3.0, (1, movements, cells))
    prior = rng.dirichlet(np.ones(movements * cells)).reshape(1, movements, cells)
    prior[rng.random(prior.shape) < 0.2] = 0.0
    prior[0, 0, 0] += 1e-3
    prior /= prior.sum()
    way = rng.normal(size=(1, movements)), rng.normal(size=(1, movements, ways))
    with np.errstate(divide="ignore"):
        return healthy, density, np.log(prior), way


def change_point_posterior(healthy, density, prior, way):
    """Return the posterior if settled positions and the ways to them say this and that."""
    return ChangePointPosterior.of(change_points(healthy + way[0], density + way[1], prior))


def joint_of(healthy, density, prior, unlisted=()):
    """Return the log joint density of all movements but some, case by case, (first, cell)."""
    movements, cells = density.shape[1:]
    joint = np.full((movements, cells), -np.inf)
    for first in range(movements):
        for cell in range(cells):
            terms = [
                density[0, m, cell] if m >= first else healthy[0, m]
                for m in range(movements)
                if m not in unlisted
            ]
            joint[first, cell] = sum(terms) + prior[0, first, cell]
    return joint


@given(
    seed=st.integers(0, 10**6),
    movements=st.integers(1, 6),
    cells=st.integers(1, 5),
    same_way=st.booleans(),
)
def test_posterior_is_that_of_enumeration(seed, movements, cells, same_way):
    ways = 1 if same_way else cells
    healthy, density, prior, (way, way_with) = problem(seed, movements, cells, ways)
    found = change_point_posterior(healthy, density, prior, (way, way_with))
    whole, whole_with = healthy + way, density + way_with
    joint = joint_of(whole, whole_with, prior)
    total = logsumexp(joint)
    assert found.log_evidence[0] == pytest.approx(total, abs=1e-9)
    np.testing.assert_allclose(
        np.exp(found.log_responsibility[0]), np.exp(joint - total), atol=1e-12
    )
    for m in range(movements):
        others = logsumexp(joint_of(whole, whole_with, prior, unlisted=(m,)))
        alone = leave_one_out(whole[0], whole_with[0], found.log_responsibility[0])[m]
        assert alone == pytest.approx(total - others, abs=1e-6)


@given(seed=st.integers(0, 10**6), movements=st.integers(1, 6), cells=st.integers(1, 5))
def test_settled_part_is_judged_in_the_light_of_all_evidence(seed, movements, cells):
    """One over the posterior mean of one over the density, case by case."""
    healthy, density, prior, way = problem(seed, movements, cells, 1)
    found = change_point_posterior(healthy, density, prior, way)
    share = np.exp(found.log_responsibility[0])
    for m in range(movements):
        inverse = sum(
            share[first, cell] / np.exp(density[0, m, cell] if m >= first else healthy[0, m])
            for first in range(movements)
            for cell in range(cells)
        )
        settled = leave_one_out(healthy[0], density[0], found.log_responsibility[0])[m]
        assert settled == pytest.approx(-np.log(inverse), abs=1e-6)


def test_without_evidence_the_prior_stands():
    healthy, density, prior, _ = problem(0, 4, 3, 1)
    none = np.zeros((1, 4)), np.zeros((1, 4, 1))
    found = change_point_posterior(0.0 * healthy, 0.0 * density, prior, none)
    assert found.log_evidence[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(np.exp(found.log_responsibility), np.exp(prior), atol=1e-12)
    alone = leave_one_out(np.zeros(4), np.zeros((4, 1)), found.log_responsibility[0])
    np.testing.assert_allclose(alone, 0.0, atol=1e-9)
