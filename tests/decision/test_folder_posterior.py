"""What the runs of a folder say together, against one posterior of all runs at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize
from scipy.linalg import block_diag
from shared_runs import (
    DOUBT,
    SETTLING,
    WIDTH,
    drawn_from_its_model,
    scene,
    whole,
)

from failuretwin import SetupPrior
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.nonidealities import Imperfections, LostCommand
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.engine import theta as engine_theta
from failuretwin.inference.engine.registration import robot_evidence
from failuretwin.inference.engine.theta import offsets_of
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together import folder_posterior as folder
from failuretwin.inference.together import habits, runs_together
from failuretwin.inference.together.belief import mixed as moments_of
from failuretwin.inference.together.belief import positive
from failuretwin.inference.together.folder_posterior import folder_posterior

SURE = Priors(load_changes=0.0, setup=SetupPrior.known())
USUAL = Priors()
KNOWN = Imperfections("made up", "test", settling=replace(SETTLING, tail_dof=5.0))
HEALTHY = [Hypothesis.parse("healthy")]
OFF = {"bias": (0.018, -0.03, 0.038, -0.004), "friction": (0.002, 0.009, 0.008, 0.006)}
"""A robot about a deviation off what it is taken to be."""


def runs_of(robot, truths, each=1, seed=2, known=KNOWN, **off):
    imperfections = replace(known, settling=replace(known.settling, **off))
    return simulate(Plan(robot, truths, each, seed, imperfections, RandomMovements(count=6)))


def judged(twin, runs, hypotheses=None, priors=USUAL, known=KNOWN):
    """Return the folder posterior of runs, and the log posterior of each, (run, hypothesis)."""
    model = HealthyModel(twin, replace(known, variation=DOUBT))
    likelihood = RunLikelihood(Evidence(runs, model.settings).settled, model)
    names = paper_hypotheses(twin.robot.motor_names) if hypotheses is None else hypotheses
    found = folder_posterior(likelihood, names, priors)
    return found, np.concatenate([part.log_posterior for part in found.posteriors]), names


def verdicts(log_posterior, names):
    return [str(names[i]) for i in log_posterior.argmax(axis=1)]


TRUTHS = ["healthy", "motor_2:stuck", "motor_3:steady_state_error", "motor_4:stuck"]
FEW = [Hypothesis.parse(name) for name in TRUTHS]


@pytest.fixture(scope="module")
def mixed(armpi):
    return runs_of(armpi, TRUTHS, 2, **OFF)


@pytest.fixture(scope="module")
def found(twin, mixed):
    return judged(twin, mixed)


def test_each_run_is_judged_with_what_the_others_teach(found, mixed):
    """The truth is one of four in turn, and what is off is found."""
    theta, log_posterior, names = found
    assert verdicts(log_posterior, names) == [name for name in TRUTHS for _ in range(2)]
    settling = theta.model.settling
    np.testing.assert_allclose(settling.bias, OFF["bias"], atol=0.009)
    np.testing.assert_allclose(settling.friction, OFF["friction"], atol=0.004)
    assert settling.bias[1] == pytest.approx(-0.02 + theta.mean[8])
    assert theta.place[7:].tolist() == [0.0] * 12


def test_order_does_not_matter(twin, mixed, found):
    order = np.random.default_rng(0).permutation(8)
    theta, log_posterior, _ = judged(twin, mixed.isel(run=order))
    known, expected, _ = found
    np.testing.assert_allclose(np.exp(log_posterior), np.exp(expected[order]), atol=1e-3)
    np.testing.assert_allclose(theta.mean / WIDTH, known.mean / WIDTH, atol=3e-3)
    np.testing.assert_allclose(theta.taught, known.taught[order], atol=3e-3)


def test_nor_does_how_many_are_weighed_at_a_time(twin, mixed, monkeypatch):
    some = mixed.isel(run=slice(0, 5))
    monkeypatch.setattr(runs_together, "CHUNK_RUNS", 2)
    theta, log_posterior, _ = judged(twin, some, FEW, SURE)
    monkeypatch.undo()
    whole_set, expected, _ = judged(twin, some, FEW, SURE)
    assert len(theta.posteriors) == 3
    np.testing.assert_allclose(np.exp(log_posterior), np.exp(expected), atol=1e-3)
    np.testing.assert_allclose(theta.mean / WIDTH, whole_set.mean / WIDTH, atol=3e-3)


def test_later_passes_change_nothing_that_matters(twin, mixed, found, monkeypatch):
    _, log_posterior, _ = found
    monkeypatch.setattr(folder, "PASSES", 8)
    monkeypatch.setattr(folder, "MOST_PASSES", 8)
    _, later, _ = judged(twin, mixed)
    np.testing.assert_allclose(np.exp(log_posterior), np.exp(later), atol=0.02)


def test_early_ones_do(twin, mixed, monkeypatch):
    """Normal are wide until it is known which motor is faulty; a second look narrows them."""
    found, some = {}, mixed.isel(run=slice(None, None, 2))
    for passes in (3, 6, 12):
        monkeypatch.setattr(folder, "PASSES", passes)
        monkeypatch.setattr(folder, "MOST_PASSES", passes)
        found[passes], *_ = judged(twin, some, FEW, SURE)
    off = {n: np.abs((found[n].mean - found[12].mean) / found[12].deviation)[7:] for n in (3, 6)}
    assert off[6].max() < 0.4
    assert off[3].max() > off[6].max()


def test_one_run_alone_is_judged_with_the_prior(twin, mixed, monkeypatch):
    """What it says itself of the robot does not count for its own hypothesis a second time."""
    monkeypatch.setattr(habits, "SCATTER_SPREAD", 1e-6)
    monkeypatch.setattr(habits, "TAIL_SPREAD", 1e-6)
    for run in (0, 2, 4):
        alone = mixed.isel(run=[run])
        theta, log_posterior, names = judged(twin, alone, FEW, SURE)
        seen = theta.posteriors[0].likelihood
        model = HealthyModel(twin, replace(KNOWN, variation=DOUBT))
        seen = replace(seen, model=model, remembered=None)
        (evidence,) = robot_evidence(seen, names, SURE)
        best = int(log_posterior[0].argmax())
        told = theta.posteriors[0].weights[best].log_evidence[0]
        assert told == pytest.approx(evidence[best], abs=1.0)
        height = evidence + log_prior(names, SURE)
        expected = height - np.logaddexp.reduce(height)
        near = expected > -6.0
        np.testing.assert_allclose(log_posterior[0][near], expected[near], atol=0.5)


def test_a_run_of_several_hypotheses_is_as_wide_as_their_mixture():
    """Three normals of two unknowns, in units of 2 and 5, against draws of them."""
    rng = np.random.default_rng(0)
    share, unit = np.array([0.5, 0.3, 0.2]), np.array([2.0, 5.0])
    theta, here = rng.normal(size=(1, 3, 2)) * unit, np.array([1.0, -1.0])
    root = rng.normal(size=(1, 3, 2, 2))
    information = root @ np.swapaxes(root, -1, -2) / np.outer(unit, unit)
    spreads = np.linalg.inv(information[0] + np.diag([0.4, 0.8] / unit**2))
    mean, covariance = moments_of(
        share[None], (theta + here) / unit, (spreads / np.outer(unit, unit))[None]
    )
    drawn = []
    for h, part in enumerate(share):
        some = rng.multivariate_normal(theta[0, h] + here, spreads[h], round(300_000 * part))
        drawn.append(some / unit)
    every = np.concatenate(drawn)
    np.testing.assert_allclose(mean[0], every.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(covariance[0], np.cov(every.T), atol=0.02)


def test_no_healthy_run_is_needed(twin, armpi):
    truths = ["motor_2:stuck", "motor_3:steady_state_error", "motor_1:steady_state_error"]
    runs = runs_of(armpi, truths, 3, **OFF)
    theta, log_posterior, names = judged(twin, runs)
    assert verdicts(log_posterior, names) == [name for name in truths for _ in range(3)]
    np.testing.assert_allclose(theta.model.settling.bias, OFF["bias"], atol=0.01)


def test_a_run_that_is_faulty_teaches_less(twin, armpi):
    """Its motor says nothing; the motor that is stuck in all of them keeps its prior."""
    few = [*FEW, Hypothesis.parse("motor_3:stuck")]
    theta, *_ = judged(twin, runs_of(armpi, ["healthy", "motor_2:stuck"], 4, **OFF), few, SURE)
    assert theta.taught[:4].mean() > theta.taught[4:].mean() > 0.1
    theta, *_ = judged(twin, runs_of(armpi, ["motor_3:stuck"], 4, **OFF), few, SURE)
    narrowed = theta.deviation / theta.prior_deviation
    assert narrowed[[7, 8]].max() < 0.6
    assert narrowed[9] > 0.7


# Against one posterior of all runs at once.


@pytest.fixture(scope="module")
def gaussian(twin):
    """Healthy runs of normal scatter, and what they say together.

    Scatter is not learned, and odd robots are as the usual ones.
    """
    one = drawn_from_its_model(scene(twin, "healthy", runs=5, seed=4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(habits, "SCATTER_SPREAD", 1e-6)
        patch.setattr(engine_theta, "ODD_FACTOR", 1.0)
        found = folder_posterior(RunLikelihood(one.evidence, one.model), HEALTHY, SURE)
    return one, found


def height(one, theta):
    """Return log of likelihood times prior of all runs at once, but for a constant."""
    prior = np.array([*[0.01] * 4, *[0.0, 0.03, 0.045, 0.06], *[0.004] * 4])
    some = prior > 0.0
    square = np.sum((theta[7:][some] / prior[some]) ** 2)
    return whole(one, theta).log_healthy.sum() - 0.5 * square


def directions():
    """Return changes of theta within what is in doubt: of the offsets, the frame is known."""
    rng = np.random.default_rng(1)
    step = np.zeros((12, 19))
    step[:, 7:] = rng.normal(size=(12, 12)) * WIDTH[7:] * 0.05
    step[:, 11] = 0.0
    return step


def test_of_healthy_runs_the_mean_is_the_top_of_the_joint_posterior(gaussian):
    one, found = gaussian
    for step in directions():
        slope = height(one, found.mean + step) - height(one, found.mean - step)
        unit = step @ np.linalg.inv(found.covariance) @ step
        assert abs(slope) / 2.0 < 0.06 * np.sqrt(unit)  # some hundredths of a deviation


def test_and_the_covariance_is_its_width(gaussian):
    one, found = gaussian
    top = height(one, found.mean)
    for step in directions():
        bend = height(one, found.mean + step) + height(one, found.mean - step) - 2.0 * top
        assert -bend == pytest.approx(step @ np.linalg.inv(found.covariance) @ step, rel=0.08)


def test_what_a_run_has_taught_is_by_how_much_it_narrows_theta(twin):
    """Of one run alone: 1/2 log det (I + Lambda V), Lambda all that is not of the prior."""
    one = scene(twin, "healthy", runs=1)
    found = folder_posterior(RunLikelihood(one.evidence, one.model), HEALTHY, SURE)
    said = np.linalg.inv(found.covariance) - np.diag(found.prior_deviation**-2.0)
    expected = 0.5 * np.linalg.slogdet(np.eye(19) + said @ found.covariance)[1]
    assert found.taught[0] == pytest.approx(expected, rel=0.01)
    assert expected > 0.5


# Scatter and losses.


def test_scatter_is_where_its_posterior_is_highest(twin, monkeypatch):
    """Against all movements of all runs at once, linear and normal, theta integrated out."""
    one = drawn_from_its_model(scene(twin, "healthy", runs=6, seed=4))
    wide = replace(one.evidence, point=one.evidence.point + 0.002 * np.eye(6, 3)[:, None])
    one = replace(one, evidence=wide)
    monkeypatch.setattr(folder, "PASSES", 12)
    monkeypatch.setattr(engine_theta, "ODD_FACTOR", 1.0)
    found = folder_posterior(RunLikelihood(one.evidence, one.model), HEALTHY, SURE)
    best = optimize.minimize(scatter_height(one, found.mean), np.zeros(4), method="BFGS").x
    learned = np.log(np.array(found.model.settling.scatter) / SETTLING.scatter)
    np.testing.assert_allclose(learned, best, atol=0.02)
    assert (np.abs(best) > 0.05).any()


def scatter_height(one, theta):
    """Return minus the log posterior of the log scatter beside that given, as a function of it."""
    evidence, model = one.evidence, one.model.without_doubt
    target = evidence.movements.target
    direction = np.sign(target - evidence.movements.origin()).reshape(-1, 4)
    target = target.reshape(-1, 4)

    def settled(offsets):
        settling = offsets_of(np.concatenate([np.zeros(7), offsets]), SETTLING)
        there = replace(model, imperfections=replace(model.imperfections, settling=settling))
        return there.settle(target, direction, there.none_held)

    centre, step = theta[7:], 1e-6
    twin = model.twin
    path, jacobian = twin.path_and_jacobian(settled(centre))
    design = [
        (twin.path(settled(centre + d)) - twin.path(settled(centre - d))).ravel() / (2.0 * step)
        for d in step * np.eye(12)
    ]
    design = np.stack(design, axis=1)
    off = (evidence.point.reshape(-1, 3) - path).ravel() + design @ centre
    prior = np.array([*[0.01] * 4, *[0.0, 0.03, 0.045, 0.06], *[0.004] * 4])
    common = design * prior @ (design * prior).T

    def height(change):
        lever = jacobian * np.array(SETTLING.scatter) * np.exp(change)
        own = lever @ np.swapaxes(lever, 1, 2) + model.path_noise**2 * np.eye(3)
        covariance = common + block_diag(*own)
        square = off @ np.linalg.solve(covariance, off)
        return 0.5 * (square + np.linalg.slogdet(covariance)[1] + np.sum((change / 0.3) ** 2))

    return height


def test_faulty_runs_say_of_scatter_what_healthy_ones_do(twin, armpi):
    """Of the motors that work; a motor that is held says nothing of the others."""
    known = replace(KNOWN, settling=SETTLING)
    wide = tuple(1.6 * np.array(SETTLING.scatter))
    errors = [f"motor_{k}:steady_state_error" for k in (2, 3, 4)]
    learned = []
    for truths, each in ((["healthy"], 24), (errors, 16), (TRUTHS[1::2], 12)):
        runs = runs_of(armpi, truths, each, known=known, scatter=wide)
        among = [*HEALTHY, *map(Hypothesis.parse, TRUTHS[1::2] if "stuck" in truths[0] else errors)]
        theta, *_ = judged(twin, runs, among, priors=SURE, known=known)
        learned.append(np.array(theta.model.settling.scatter) / wide)
    healthy, faulty, held = learned
    np.testing.assert_allclose(faulty[:3], healthy[:3], rtol=0.25)
    np.testing.assert_allclose(1.6 * held, 1.0, rtol=0.05)


def test_runs_that_scatter_more_say_so(twin, armpi):
    wide = tuple(2.5 * np.array(SETTLING.scatter))
    known = replace(KNOWN, settling=replace(SETTLING, tail_dof=np.inf))
    runs = runs_of(armpi, ["healthy"], 8, known=known, scatter=wide)
    theta, *_ = judged(twin, runs, HEALTHY, SURE, known)
    ratio = np.array(theta.model.settling.scatter) / wide
    assert (ratio[:3] > 0.6).all()
    assert (ratio < 1.1).all()


def test_a_rate_of_losses_is_learned_with_thirty_movements_of_prior(twin, armpi):
    """Of motor 1, that stays where it was in about a third; nothing is known of late movements."""
    often, seldom = LostCommand(("motor_1",), 0.35, 0.35), LostCommand(("motor_1",), 0.03, 0.06)
    runs = runs_of(armpi, ["healthy"], 8, known=replace(KNOWN, lost_commands=(often,)))
    known = replace(KNOWN, lost_commands=(seldom,))
    names = [Hypothesis.parse(name) for name in ("healthy", "motor_3:stuck")]
    theta, *_ = judged(twin, runs, names, SURE, known)
    (entry,) = theta.model.imperfections.lost_commands
    settled = runs["position"].values[:, 190::200, 0][:, :6]
    told = runs["command"].values[:, 190::200, 0][:, :6]
    lost = (np.abs(settled - told) > 0.08).sum()
    assert lost >= 8
    assert entry.rate == pytest.approx((30 * 0.03 + lost) / (30 + 48), rel=0.12)
    assert entry.rate_when_late == pytest.approx(0.06)


def test_eigenvalues_below_the_least_are_raised():
    root, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    matrix = root @ np.diag([-2.0, 0.5, 3.0]) @ root.T
    found = positive(matrix[None], 0.1)[0]
    np.testing.assert_allclose(found, root @ np.diag([0.1, 0.5, 3.0]) @ root.T, atol=1e-12)


def test_a_run_moves_nothing_that_it_leaves_open(twin, armpi):
    """Where a run makes the belief wider its site has no precision, so it may have no shift."""
    odd = tuple(np.add(KNOWN.settling.bias, (0.0, 0.0, 8.0 * WIDTH[9], 0.0)).tolist())
    found, *_ = judged(twin, runs_of(armpi, ["motor_2:stuck"], 1, bias=odd), priors=SURE)
    (precision,), (shift,) = found.sites.precision, found.sites.shift
    values, vectors = np.linalg.eigh(precision)
    none = values < 1e-9 * values.max()
    assert none.any()
    assert np.abs(shift).max() > 1.0
    assert np.abs(vectors[:, none].T @ shift).max() < 1e-3
