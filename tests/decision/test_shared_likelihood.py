"""What runs say near one theta: score, information and integrals, against whole computations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats
from shared_runs import FAULTS, FRAME, WIDTH, drawn_from_its_model, scene, some_theta, whole

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.digital_model.nonidealities import LostCommand
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.posterior import marginal_likelihood_of
from failuretwin.inference.theta.scatter_score import told_of_scatter
from failuretwin.inference.theta.shared_likelihood import (
    Fit,
    LocalLikelihood,
    Normal,
    has_score,
    local_likelihood,
    search,
)

OWN = {"healthy": [], "2": [8, 12, 16], "3": [9, 13, 17], "4": [10, 14, 18]}
"""Places of the offsets of a faulty motor, of which it says nothing."""
LOSSES = (LostCommand(("motor_1",), 0.05, 0.05), LostCommand(("motor_3",), 0.03, 0.03))


@pytest.fixture(scope="module")
def scenes(twin):
    return {name: scene(twin, name) for name in ("healthy", *FAULTS)}


def known_places(name):
    """Return the places of theta of which runs say something, (place,)."""
    own = OWN["healthy" if name == "healthy" else name[6]]
    return np.setdiff1d(np.arange(19), [*own, 11])  # no load: motor 1 never gives way


# Score and information.


def told_of(response, hypothesis, theta):
    return local_likelihood(response, hypothesis, Priors(), theta)


def scatter_of(response, hypothesis, theta):
    """Return what runs say of scatter and losses near theta."""
    return told_of_scatter(response, hypothesis, Priors(), theta)


def differences(response, hypothesis, at, what, share=0.03):
    """Return the central differences by theta, in units of `WIDTH`, (run, theta, ...)."""
    found = []
    for row in share * np.diag(WIDTH):
        ahead, behind = (told_of(response, hypothesis, at + s * row) for s in (1.0, -1.0))
        found.append((getattr(ahead, what) - getattr(behind, what)) / (2.0 * share))
    return np.stack(found, axis=1)


@pytest.mark.parametrize("name", ["healthy", *FAULTS])
def test_score_is_the_slope_of_the_log_likelihood(scenes, name):
    """Exact of a healthy robot; of a faulty one but for the nodes, which move with theta."""
    one, at = scenes[name], np.tile(some_theta(4, 0.05), (2, 1))
    response = one.response()
    score = told_of(response, one.hypothesis, at).score * WIDTH
    slope = differences(response, one.hypothesis, at, "log_likelihood")
    some = known_places(name)
    top = np.abs(slope).max()
    assert top > 5.0
    close = 1e-6 if name == "healthy" else 0.02
    np.testing.assert_allclose(score[:, some], slope[:, some], rtol=0.0, atol=close * top)


@pytest.mark.parametrize("name", ["healthy", "motor_2:stuck"])
def test_score_with_heavy_tails_and_lost_commands(twin, name):
    one = scene(twin, name, dof=5.0, lost=LOSSES)
    response, at = one.response(), np.tile(some_theta(5, 0.05), (2, 1))
    score = told_of(response, one.hypothesis, at).score * WIDTH
    slope = differences(response, one.hypothesis, at, "log_likelihood")
    some, top = known_places(name), np.abs(slope).max()
    np.testing.assert_allclose(score[:, some], slope[:, some], rtol=0.0, atol=0.06 * top)


@pytest.mark.parametrize("name", ["healthy", *FAULTS])
def test_information_is_how_fast_the_score_falls(scenes, name):
    """A drift shares its lever with no common angle; how sharp it is known makes a tenth."""
    one, at = scenes[name], np.tile(some_theta(6, 0.03), (2, 1))
    response = one.response()
    found = told_of(response, one.hypothesis, at).information * np.outer(WIDTH, WIDTH)
    fall = -differences(response, one.hypothesis, at, "score") * WIDTH
    some = np.ix_(range(2), known_places(name), known_places(name))
    off = np.linalg.norm((found - fall)[some]) / np.linalg.norm(fall[some])
    assert off < {"healthy": 1e-6, "motor_4:drift": 0.13}.get(name, 0.025)


def test_a_faulty_motor_says_nothing_of_its_own_offsets(scenes):
    """A motor that was stuck before the run never settles by itself."""
    one = scenes["motor_3:steady_state_error"]
    found = told_of(one.response(), one.hypothesis, np.zeros((2, 19)))
    information = np.einsum("rtt->rt", found.information) * WIDTH**2
    assert (information[:, OWN["3"]] < 0.02 * information[:, OWN["2"]]).all()
    well = scenes["healthy"]
    healthy = told_of(well.response(), well.hypothesis, np.zeros((2, 19)))
    assert (np.einsum("rtt->rt", healthy.information)[:, [9, 17]] * WIDTH[[9, 17]] ** 2 > 0.5).all()


@pytest.mark.parametrize("dof", [5.0, np.inf])
def test_information_is_the_covariance_of_the_score(twin, dof):
    """Of runs that the model itself draws, with heavy tails or without; scores are 0 on average."""
    one = drawn_from_its_model(scene(twin, "healthy", runs=300, dof=dof))
    found = told_of(one.response(), one.hypothesis, np.zeros((300, 19)))
    some = known_places("healthy")
    score = (found.score * WIDTH)[:, some]
    root = np.linalg.inv(
        np.linalg.cholesky(
            (found.information * np.outer(WIDTH, WIDTH)).mean(axis=0)[np.ix_(some[:7], some[:7])]
        )
    )
    white = score[:, :7] @ root.T
    np.testing.assert_allclose(np.cov(white.T), np.eye(7), atol=0.3)
    assert np.trace(np.cov(white.T)) == pytest.approx(7.0, rel=0.08)
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=0.2)


# What else is told.


def test_squared_distances_and_outcomes_of_runs_that_the_model_draws(twin):
    """Three axes give three."""
    one = drawn_from_its_model(scene(twin, "healthy", runs=300))
    found = told_of(one.response(), one.hypothesis, np.zeros((300, 19)))
    assert found.misfit.mean() == pytest.approx(3.0, rel=0.04)
    told = scatter_of(one.response(), one.hypothesis, np.zeros((300, 19)))
    np.testing.assert_allclose(told.outcomes.sum(axis=2), 1.0, atol=0.02)


@pytest.mark.parametrize("dof", [5.0, np.inf])
def test_scatter_of_runs_that_the_model_draws(twin, dof):
    """The score is 0 on average and as wide as the information; a step from a fifth off is back."""
    one = drawn_from_its_model(scene(twin, "healthy", runs=300, dof=dof))
    zero = np.zeros((300, 19))
    found = scatter_of(one.response(), one.hypothesis, zero)
    some = slice(0, 4 if np.isinf(dof) else 5)
    information = found.information.mean(axis=0)[some, some]
    root = np.linalg.inv(np.linalg.cholesky(information))
    white = found.score[:, some] @ root.T
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=0.2)
    np.testing.assert_allclose(np.cov(white.T), np.eye(len(white.T)), atol=0.35)
    assert np.trace(np.cov(white.T)) == pytest.approx(len(white.T), rel=0.15)
    wider = scatter_of(with_scatter(one, 1.2 * np.ones(4)).response(), one.hypothesis, zero)
    told = wider.information.sum(axis=0)[some, some]
    step = np.linalg.solve(told, wider.score.sum(axis=0)[some])
    np.testing.assert_allclose(step[:3], -np.log(1.2), atol=0.12)


def test_degrees_of_freedom_of_runs_that_the_model_draws(twin):
    """A step from twice as many, the scatter known, is most of the way back."""
    one = drawn_from_its_model(scene(twin, "healthy", runs=300, dof=4.0))
    zero = np.zeros((300, 19))
    lighter = scatter_of(with_scatter(one, np.ones(4), 2.0).response(), one.hypothesis, zero)
    step = lighter.score[:, 4].sum() / lighter.information[:, 4, 4].sum()
    assert -2.5 * np.log(2.0) < step < -0.7 * np.log(2.0)


def with_scatter(one, factor, heavier=1.0):
    """Return a scene judged with some times the scatter of each motor and degrees of freedom."""
    known = one.model.imperfections
    scatter = tuple((np.array(known.settling.scatter) * factor).tolist())
    dof = known.settling.tail_dof * heavier
    known = replace(known, settling=replace(known.settling, scatter=scatter, tail_dof=dof))
    return replace(one, model=replace(one.model, imperfections=known))


def test_scatter_of_a_linear_gaussian(twin):
    """With S the covariance of a movement: tr(S^-1 dS (S^-1 r r^T - 1)) / 2, and its mean fall.

    What a covariance C of theta adds is by how much it widens r, G C G^T.
    """
    one = drawn_from_its_model(scene(twin, "healthy", runs=1, count=3))
    model, evidence = one.model.without_doubt, one.evidence
    target = evidence.movements.target[0]
    before = np.concatenate([evidence.movements.initial, target[:-1]])
    direction = np.sign(target - before)
    pose = model.settle(target, direction, model.none_held)
    path, jacobian = model.twin.path_and_jacobian(pose)
    scatter = np.array([0.004, 0.005, 0.006, 0.007])
    bias, friction = jacobian, -jacobian * direction[:, None]
    score, information = np.zeros(4), np.zeros((4, 4))
    width = np.array([*[0.01] * 4, *[0.004] * 4])
    added = np.zeros(4)
    for J, r, *g in zip(jacobian, evidence.point[0] - path, bias, friction, strict=True):
        S = J @ np.diag(scatter**2) @ J.T + model.path_noise**2 * np.eye(3)
        wide = np.hstack(g) * width
        by = [
            np.linalg.solve(S, 2.0 * scatter[k] ** 2 * np.outer(J[:, k], J[:, k]))
            for k in (0, 1, 2, 3)
        ]
        score += [0.5 * np.trace(d @ (np.linalg.solve(S, np.outer(r, r)) - np.eye(3))) for d in by]
        information += [[0.5 * np.trace(one @ two) for two in by] for one in by]
        added += [0.5 * np.trace(d @ np.linalg.solve(S, wide @ wide.T)) for d in by]
    found = scatter_of(one.response(), one.hypothesis, np.zeros((1, 19)))
    told = found.information[0]
    np.testing.assert_allclose(found.score[0], [*score, 0.0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(told[:4, :4], information, rtol=1e-4, atol=1e-6)
    assert not told[4].any()  # nothing is learned of the tails of a normal distribution
    covariance = np.zeros(19)
    covariance[[7, 8, 9, 10, 15, 16, 17, 18]] = width**2
    slack = np.einsum("ntt,t->n", found.slack[0], covariance)
    np.testing.assert_allclose(slack, added, rtol=0.02)


@pytest.mark.parametrize("dof", [5.0, np.inf])
@pytest.mark.parametrize("name", FAULTS)
def test_scatter_of_the_other_motors_is_a_derivative_when_one_is_faulty(twin, name, dof):
    """Where its angle is known from the other movements, what is off it tells of their scatter."""
    one, step, faulty = scene(twin, name, dof=dof), 1e-3, int(name[6]) - 1
    zero = np.zeros((2, 19))
    here = scatter_of(one.response(), one.hypothesis, zero)
    slopes = []
    for k in range(5):
        by = np.eye(5)[k]
        more, less = (
            told_of(
                with_scatter(one, np.exp(s * by[:4]), np.exp(s * by[4])).response(),
                one.hypothesis,
                zero,
            ).log_likelihood
            for s in (step, -step)
        )
        slopes.append((more - less) / (2.0 * step))
    slope = np.stack(slopes, axis=1)
    others = np.arange(4) != faulty
    close = 0.05 if np.isinf(dof) else 0.55
    assert np.abs(slope[:, :4][:, others]).max() > 1.0
    found = here.score[:, :4][:, others]
    np.testing.assert_allclose(found, slope[:, :4][:, others], rtol=0.0, atol=close)
    np.testing.assert_allclose(here.score[:, 4], slope[:, 4], rtol=0.0, atol=close)
    assert np.linalg.eigvalsh(here.information).min() > -1e-6


def test_a_tool_that_is_nowhere_near_fits_ill(twin):
    one = drawn_from_its_model(scene(twin, "healthy", runs=1, count=4))
    far = replace(one.evidence, point=one.evidence.point + np.eye(4, 3)[None] * 0.3)
    found = told_of(replace(one, evidence=far).response(), one.hypothesis, np.zeros((1, 19)))
    assert found.misfit[0] == pytest.approx(75.0, abs=3.0)  # three of four count as 100


@pytest.mark.parametrize(
    ("name", "scored"),
    [
        ("healthy", True),
        ("motor_1:stuck", True),
        ("motor_1:drift", True),
        ("motor_1:slow", False),
        ("motor_1:intermittent", False),
        ("motor_1:stuck+motor_2:stuck", False),
        ("unknown", False),
    ],
)
def test_which_hypotheses_have_a_score(name, scored):
    assert has_score(Hypothesis.parse(name)) is scored


# Integrals over theta.


def narrow(place, width):
    """Return the belief that all but one part of theta is known, (1, theta) a run."""
    deviation = 1e-6 * WIDTH
    deviation[place] = width
    return Normal(np.diag(deviation**-2.0)[None], np.zeros((1, 19)))


def by_quadrature(one, place, width):
    """Return log of the integral of prior times likelihood over one part of theta, all anew."""
    nodes = np.linspace(-5.0, 5.0, 121) * width
    heights = [
        marginal_likelihood_of(
            whole(one, x * np.eye(19)[place]), one.hypothesis, Priors()
        ).log_evidence[0]
        for x in nodes
    ]
    top = max(heights)
    values = np.exp(np.array(heights) - top) * stats.norm.pdf(nodes, 0.0, width)
    return top + np.log(integrate.trapezoid(values, nodes))


@pytest.mark.parametrize(
    ("name", "place", "width"),
    [
        ("healthy", 2, 0.004),
        ("healthy", 6, 0.01),
        ("healthy", 16, 0.01),
        ("motor_2:stuck", 4, 0.02),
        ("motor_3:steady_state_error", 8, 0.01),
        ("motor_2:encoder_bias", 3, 0.01),
        ("motor_4:drift", 0, 0.003),
    ],
)
def test_laplace_is_the_integral_in_one_direction(twin, name, place, width):
    """To a few hundredths of a nat; places of an origin, a turn, a scale, a bias and a friction."""
    one = drawn(twin, name, np.inf)
    found = laplace(one, narrow(place, width))
    assert found == pytest.approx(by_quadrature(one, place, width), abs=0.06)


@pytest.mark.parametrize(
    ("name", "place", "width"),
    [("healthy", 8, 0.01), ("motor_3:steady_state_error", 1, 0.003), ("motor_2:stuck", 0, 0.003)],
)
def test_with_heavy_tails_it_is_nearly_so(twin, name, place, width):
    """The information is that of a run on average, not of this one."""
    one = drawn(twin, name, 5.0)
    found = laplace(one, narrow(place, width))
    assert found == pytest.approx(by_quadrature(one, place, width), abs=0.25)


def drawn(twin, name, dof):
    one = scene(twin, name, runs=1, dof=dof, seed=0)
    return drawn_from_its_model(one) if name == "healthy" else one


def searched(response, one, prior, start):
    return search(response, [one.hypothesis], np.zeros(1), Priors(), prior, start[:, None])


def laplace(one, prior):
    (best,) = searched(one.response(), one, prior, np.zeros((1, 19)))
    return best.log_evidence[0]


def quadratic(top, slope, curvature, theta):
    """Return the local likelihood of top + slope x - x^T curvature x / 2, about theta."""
    fall = curvature @ theta
    value = top + slope @ theta - 0.5 * theta @ fall
    told = (theta[None], np.array([value]), (slope - fall)[None], curvature[None], np.zeros(1))
    return LocalLikelihood(*told)


def test_of_a_quadratic_laplace_is_exact_from_its_best_place():
    """Integral of N(theta; m, P) exp(L) by completing the square."""
    rng = np.random.default_rng(0)
    root, slope, mean = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=3)
    curvature, precision = root @ root.T + np.eye(3), np.diag([0.5, 1.0, 4.0])
    prior = Normal(precision[None], (precision @ mean)[None])
    both = precision + curvature
    best = np.linalg.solve(both, precision @ mean + slope)
    nowhere = quadratic(-7.0, slope, curvature, np.array([0.3, -0.4, 0.1]))
    np.testing.assert_allclose(prior.times(nowhere).mean, best[None])
    expected = (
        -7.0
        + 0.5 * np.linalg.slogdet(precision)[1]
        - 0.5 * np.linalg.slogdet(both)[1]
        + 0.5 * best @ both @ best
        - 0.5 * mean @ precision @ mean
    )
    near = Fit.of(prior, quadratic(-7.0, slope, curvature, best + 0.01))
    assert 0.0 < near.promised[0] < 0.1
    np.testing.assert_allclose(near.theta, best[None])
    np.testing.assert_allclose(near.log_evidence, [expected])
    density = stats.multivariate_normal(mean, np.linalg.inv(precision)).logpdf(best)
    np.testing.assert_allclose(prior.log_density(best[None]), density + 1.5 * np.log(2.0 * np.pi))


def test_a_search_climbs_to_the_top_and_never_below_its_start(twin):
    """A frame that is off by one deviation, of a healthy run and one that is stuck."""
    for name in ("healthy", "motor_2:stuck"):
        one = scene(twin, name, runs=1, seed=8)
        moved = replace(one.evidence, point=one.evidence.point + np.array([0.003, -0.002, 0.002]))
        one = replace(one, evidence=moved)
        response = one.response(FRAME)
        wide = np.array([0.003] * 3 + [0.01] * 4)
        prior = Normal(np.diag(wide**-2.0)[None], np.zeros((1, 7)))
        start = np.zeros((1, 7))
        (fit,) = searched(response, one, prior, start)
        best = local_likelihood(response, one.hypothesis, Priors(), fit.theta)
        first = local_likelihood(response, one.hypothesis, Priors(), start)

        def height(says, prior=prior):
            return (says.log_likelihood + prior.log_density(says.theta))[0]

        assert height(best) > height(first) + 1.0
        slope = best.score - np.einsum("rtu,ru->rt", prior.precision, best.theta)
        gain = 0.5 * slope @ np.linalg.inv(prior.precision + best.information)[0] @ slope.T
        assert gain[0, 0] < 0.1  # what another step would bring
