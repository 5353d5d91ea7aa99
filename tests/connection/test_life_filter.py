"""The filter over the runs of a robot, against closed forms and its own simulation of wear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worn_robot import (
    CALIBRATION,
    COUNT,
    DOUBT,
    MOVEMENTS,
    NOISE_M,
    SETTLING,
    follow_all,
    life,
    normal,
    seen,
    truth,
)

from failuretwin.core.hypothesis import HEALTHY
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.engine.posterior import theta_parts
from failuretwin.inference.engine.scatter import scatter_information
from failuretwin.inference.engine.theta import Components, Layout
from failuretwin.inference.engine.weighing import Weighing
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.belief import Belief, Normal
from failuretwin.inference.together.life_filter import CHANCE, MOST_DOUBT, WINDOW
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

STATIC = WearLimits(rate=0.0, reach=1e3, limit=1e3)
BATCH = 10
SETTLING_VALUES = np.concatenate([SETTLING.bias, SETTLING.compliance, SETTLING.friction])


def motor_2(counts):
    """Return a change of motor 2 alone, in counts, (run or 1, motor) [rad]."""
    change = np.zeros((np.size(counts), 4))
    change[:, 1] = COUNT * np.asarray(counts)
    return change


# What is believed: mixtures of normal distributions, against sums over a grid.


@pytest.fixture
def belief():
    """A usual robot and an odd one, of two numbers."""
    unit = np.array([1.0, 0.5])
    parts = [
        Components.normal_of(np.diag((factor * unit) ** 2), 0.0).weighted(rate)
        for factor, rate in ((1.0, 0.9), (3.0, 0.1))
    ]
    return Belief.of(Components.joined(parts), unit)


def on_grid(belief_density):
    axis = np.linspace(-25.0, 25.0, 1001)
    point = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    weight = belief_density(point)
    mean = np.einsum("xy,xyt->t", weight, point) / weight.sum()
    away = point - mean
    return mean, np.einsum("xy,xyt,xyu->tu", weight, away, away) / weight.sum()


def test_a_mixture_given_a_site_is_bayes_rule(belief):
    precision = np.array([[2.0, 0.3], [0.3, 0.5]])
    shift = np.array([6.0, -1.0])

    def density(x):
        prior = 0.9 * np.exp(-0.5 * (x**2).sum(-1)) + 0.1 / 9 * np.exp(-(x**2).sum(-1) / 18)
        return prior * np.exp(x @ shift - 0.5 * np.einsum("...t,tu,...u", x, precision, x))

    mean, covariance = on_grid(density)
    given = belief.times(Normal(precision[None], shift[None]))
    (found,), (spread,) = given.moments
    np.testing.assert_allclose(found, mean, atol=1e-6)
    np.testing.assert_allclose(spread, covariance, atol=1e-6)
    matched = given.matched()
    np.testing.assert_allclose(matched.mean[0], mean, atol=1e-6)
    assert given.weight[0, 1] > 0.3  # three deviations off: an odd robot


def test_a_random_walk_adds_its_variance(belief):
    step = np.array([0.2, 0.7])
    (mean, covariance), (after, spread) = belief.moments, belief.blurred(step).moments
    np.testing.assert_allclose(after, mean)
    np.testing.assert_allclose(spread[0], covariance[0] + np.diag(step))


# Scatter: the derivative of the likelihood by its logarithm.


def said_of_scatter(robot, evidence, factor=1.0, motor=0):
    """Return what runs say as healthy ones, with the scatter of one motor some times as large.

    Motors 4 and 5, which there are not, stand for the degrees of freedom and the noise.
    """
    figures = np.array([*SETTLING.scatter, SETTLING.tail_dof, 1.0])
    figures[motor] *= factor
    *scatter, dof, noise = figures.tolist()
    settling = replace(SETTLING, scatter=tuple(scatter), tail_dof=dof)
    sharp = replace(CALIBRATION, settling=settling, variation=None)
    model = HealthyModel(DigitalTwin(robot), sharp, noise_factor=noise)
    likelihood, layout = RunLikelihood(evidence, model), Layout(4, geometry=False)
    known = Components.normal_of(np.diag(np.full(layout.size, 1e-12)), model.path_noise)
    place = np.zeros((len(evidence.usable), 7))
    weighing = Weighing(likelihood, [HEALTHY], Priors(load_changes=0.0), layout, known, place)
    (part,) = theta_parts(weighing.evidence)
    order = np.argsort(part.picks.run)
    score = scatter_information(weighing.evidence, part).score[order]
    return weighing.evidence.by_hypothesis[:, 0], score


@pytest.mark.parametrize("motor", [0, 1, 3, 4, 5])
def test_the_score_of_the_scatter_is_a_derivative(armpi, motor):
    evidence, step = seen(armpi, truth(12), 8), 1e-4
    _, score = said_of_scatter(armpi, evidence)
    more, less = (said_of_scatter(armpi, evidence, np.exp(s), motor)[0] for s in (step, -step))
    # Five normals stand for the Student t: their slope differs a little.
    np.testing.assert_allclose(score[:, motor], (more - less) / (2 * step), atol=0.25)


# A robot that stays as it is, and one that wears.


def expected_fit(robot, evidence, calibration, noise_m):
    """Return mean and covariance of bias, compliance, friction by one fit to all runs (12,)."""
    settling, kept = calibration.settling, [k for k in range(12) if k != 4]
    prior = np.concatenate([DOUBT.bias, np.array(DOUBT.compliance) * settling.compliance])
    prior = np.concatenate([prior, DOUBT.friction])
    known = np.concatenate([settling.bias, settling.compliance, settling.friction])
    twin = DigitalTwin(robot)
    target = evidence.movements.target.reshape(-1, 4)
    direction = np.sign(target - evidence.movements.origin().reshape(-1, 4))

    def settled(values):
        bias, compliance, friction = values.reshape(3, 4)
        pose = target
        for _ in range(4):
            torque = robot.sense * robot.loads.torque(pose * robot.sense)
            pose = target + bias + compliance * torque - friction * direction
        return pose

    pose = settled(known)
    step = 1e-6
    jacobian = np.stack(
        [(twin.path(pose + d) - twin.path(pose - d)) / (2 * step) for d in step * np.eye(4)],
        axis=-1,
    )
    columns = [
        (twin.path(settled(known + d)) - twin.path(settled(known - d))) / (2 * step)
        for d in step * np.eye(12)
    ]
    design = np.stack(columns, axis=-1)[..., kept]
    scale = jacobian * np.array(settling.scatter)
    spread = scale @ np.swapaxes(scale, 1, 2) + noise_m**2 * np.eye(3)
    error = evidence.point.reshape(-1, 3) - twin.path(pose)
    weighted = np.linalg.solve(spread, design)
    information = np.einsum("mik,mil->kl", design, weighted) + np.diag(prior[kept] ** -2.0)
    change = np.linalg.solve(information, np.einsum("mik,mi->k", weighted, error))
    return known[kept] + change, np.linalg.inv(information)


def test_a_static_robot_is_learned_as_by_one_fit_to_all_runs(armpi):
    """With a normal scatter, no wear and nothing but healthy: a linear regression, solved once."""
    calibration = normal()
    evidence = seen(armpi, truth(60, motor_2([0.5])), 2, calibration)
    found = life(armpi, calibration=calibration, limits=STATIC)
    follow_all(found, evidence)
    mean, covariance = expected_fit(armpi, evidence, calibration, found.model.path_noise)
    deviation = np.sqrt(np.diag(covariance))
    got, spread = (np.delete(part.ravel(), 4) for part in found.offsets)
    assert (np.abs(got - mean) / deviation).max() < 0.1
    assert (np.abs(np.delete(SETTLING_VALUES, 4) - mean) / deviation).max() > 1.5  # it has moved
    np.testing.assert_allclose(spread, deviation, rtol=0.06)
    assert found.offsets[1][1, 0] < 2e-3  # gravity does not load motor 1


def test_wear_is_followed_and_the_doubt_is_honest(armpi):
    """Two counts of swing in the bias and a quarter more sag, over six hundred runs."""
    runs = 600
    at = np.arange(runs)[:, None]
    swing = COUNT * np.sin(2 * np.pi * at / 1250.0 + np.arange(4))
    wear = truth(runs, swing - swing[0], 0.25 * at / runs * np.array(SETTLING.compliance))
    found = life(armpi)
    offsets, alarms = follow_all(found, seen(armpi, wear, 6))
    off = offsets[:, 0, :2] - wear[BATCH - 1 :: BATCH, :2]
    unit = wear_unit(found.model).reshape(3, 4)
    loaded = unit[1] > 0.0
    counts = off.copy()
    counts[:, 1, loaded] *= unit[0, loaded] / unit[1, loaded]
    counts[:, 1, ~loaded] = 0.0
    counts /= COUNT
    assert np.sqrt(np.mean(counts**2, axis=0)).max() < 0.6
    assert np.abs(counts).max() < 1.6
    share = np.abs(off / np.maximum(offsets[:, 1, :2], 1e-12))[:, :, 1:]
    assert np.mean(share < 3) > 0.97
    assert 0.55 < np.mean(share < 1) < 0.92  # two in three, if they were normal
    assert not any(alarms)
    assert np.ptp(swing, axis=0).max() > 1.5 * COUNT  # it is worth following


@pytest.mark.parametrize("counts", [5.0, pytest.param(-8.0, marks=pytest.mark.slow), 30.0])
def test_a_sudden_fault_that_the_diagnosis_misses_is_not_absorbed(armpi, counts):
    """All runs are taken for healthy; only what they change can tell.

    What does not stand out from wear and chance yet can be absorbed, never more. The tails of the
    scatter let an outlier teach a little, and it stands out the later.
    """
    wear = np.concatenate([truth(100), truth(150, motor_2([counts]))])
    found = life(armpi)
    offsets, alarms = follow_all(found, seen(armpi, wear, 11))
    assert not any(alarms[:10])
    moved = (offsets[-1, 0, 0] - offsets[9, 0, 0]) / COUNT
    outlier = abs(counts) > 10.0
    told = found.limits.reach * SETTLING.scatter[1] + CHANCE * offsets[-1, 1, 0, 1]
    assert np.abs(moved).max() < (told / COUNT if outlier else 1.2)
    assert alarms[-1].endswith("of motor_2 changes faster than by wear")
    assert any(alarms[10 : 17 if outlier else 14])


@pytest.mark.parametrize(
    ("pace", "runs"), [pytest.param(0.05, 400, marks=pytest.mark.slow), (0.5, 100)]
)
def test_a_fault_that_grows_is_not_absorbed(armpi, pace, runs):
    """It is taken for wear until it stands out; then learning stops, however far it goes."""
    wear = np.concatenate([truth(200), truth(runs, motor_2(pace * np.arange(runs)))])
    found = life(armpi)
    offsets, alarms = follow_all(found, seen(armpi, wear, 12))
    moved = (offsets[-1, 0, 0] - offsets[19, 0, 0]) / COUNT
    assert pace * runs >= 18
    assert np.abs(moved).max() < 3.0
    assert any("of motor_2 changes faster than by wear" in alarm for alarm in alarms)


def test_after_the_repair_it_goes_on(armpi):
    wear = np.concatenate([truth(60), truth(40, motor_2([10.0])), truth(60)])
    found = life(armpi)
    _, alarms = follow_all(found, seen(armpi, wear, 9))
    assert any(alarms[6:10])
    assert not alarms[-1]
    assert found.window.counted[-1]


def test_a_faulty_motor_teaches_nothing_of_itself(armpi):
    """Runs in which motor 2 is held narrow what is believed of the others alone."""
    found = life(armpi, ("healthy", "motor_2:stuck"))
    before, doubt = found.offsets
    held = seen(armpi, truth(20, COUNT * np.array([[1.0, 0.0, -1.0, 0.0]])), 4, held=1)
    told = [found.follow(held[k : k + 5]) for k in range(0, 20, 5)]
    assert all(np.exp(t.log_posterior[:, 1]).min() > 0.99 for t in told)
    after, spread = found.offsets
    assert spread[0, 1] > 0.85 * DOUBT.bias[1]  # as it was, of a robot like its calibration
    assert spread[2, 1] > 0.85 * DOUBT.friction[1]
    assert (np.abs(after - before)[:, 1] < 0.2 * doubt[:, 1]).all()
    assert spread[0, 0] < 0.75 * DOUBT.bias[0]
    assert after[0, 0] - before[0, 0] > 0.25 * COUNT


def test_a_wrong_start_is_put_right(armpi):
    """Three runs with a motor that is off and no other name for it than healthy, then others."""
    wide = replace(CALIBRATION, variation=replace(DOUBT, bias=(0.01,) * 4))
    wear = np.concatenate([truth(3, motor_2([12.0])), truth(60)])
    found = life(armpi, calibration=wide)
    offsets, _ = follow_all(found, seen(armpi, wear, 3), batch=3)
    off = (offsets[:, 0, 0, 1] - SETTLING.bias[1]) / COUNT
    assert off[0] > 6.0
    assert abs(off[-1]) < 1.5


def test_memory_does_not_grow_with_the_runs(armpi):
    found = life(armpi)
    evidence = seen(armpi, truth(6 * WINDOW), 1)
    sizes = []
    for k in range(0, 6 * WINDOW, BATCH):
        found.follow(evidence[k : k + BATCH])
        sizes.append(sum(array.nbytes for array in found.to_arrays().values()))
    past = found.limits.horizon // WINDOW * 2 * 12 * 8
    assert sizes[-1] <= sizes[3] + past
    assert found.arrived == 6 * WINDOW
    assert found.movements == 6 * WINDOW * MOVEMENTS


def test_going_on_from_arrays_is_going_on(armpi):
    evidence = seen(armpi, truth(60), 5)
    straight, first = life(armpi), life(armpi)
    follow_all(straight, evidence)
    follow_all(first, evidence[:40])
    again = life(armpi).resumed(first.to_arrays())
    follow_all(again, evidence[40:])
    there, here = straight.to_arrays(), again.to_arrays()
    assert there.keys() == here.keys()
    for name, array in there.items():
        np.testing.assert_array_equal(array, here[name], err_msg=name)


def test_a_run_says_by_itself_what_each_bias_is(armpi):
    """A count of wear, which the belief of before takes for unlikely, comes back from each run.

    Sag and friction of every run are drawn from what is believed of them, odd robots with it, and
    noise that a sensor which nobody has measured is believed to have.
    """
    rng, usual = np.random.default_rng(0), np.sqrt(0.9 + 0.1 * 3.0**2)
    doubt = usual * np.array([np.multiply(DOUBT.compliance, SETTLING.compliance), DOUBT.friction])
    told = []
    for seed in range(12):
        wear = truth(BATCH, motor_2(1.0))
        wear[:, 1:] += doubt * rng.standard_normal((BATCH, 2, 4))
        found = life(armpi, calibration=normal(), limits=STATIC)
        evidence, noise = seen(armpi, wear, seed, normal()), found.model.path_noise
        untold = rng.normal(0.0, np.sqrt(noise**2 - NOISE_M**2), evidence.point.shape)
        found.follow(replace(evidence, point=evidence.point + untold))
        told.append(found.bias_by_run())
    mean, deviation = (np.concatenate(part) for part in zip(*told, strict=True))
    scatter = wear_unit(found.model)[:4]
    assert np.nanmax(deviation / scatter) < MOST_DOUBT
    assert (np.isfinite(mean).mean(axis=0) > [0.95, 0.95, 0.9, 0.3]).all()
    # A run of five movements cannot tell a bias better than their scatter does.
    assert (np.nanmin(deviation, axis=0) > 0.95 * scatter / np.sqrt(MOVEMENTS)).all()
    weight = np.nan_to_num(deviation**-2.0)
    together = np.nansum(weight * mean, axis=0) / weight.sum(axis=0)
    doubt = weight.sum(axis=0) ** -0.5
    assert (np.abs(together - motor_2(1.0)[0]) < 3.0 * doubt).all()
    assert together[1] > 3.0 * doubt[1]  # it is worth telling
    off = (mean - motor_2(1.0)) / deviation
    np.testing.assert_allclose(np.nanstd(off, axis=0), 1.0, atol=0.2)


def test_before_any_run_none_says_something_of_the_biases(armpi):
    mean, deviation = life(armpi).bias_by_run()
    assert mean.shape == deviation.shape == (0, 4)
