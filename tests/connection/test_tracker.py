from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats
from worn_robot import (
    CALIBRATION,
    COUNT,
    DOUBT,
    SETTLING,
    evidence_of,
    follow_all,
    fresh,
    normal,
    observe_wear,
    truth,
)

from failuretwin.connection.calibration.observations import observe
from failuretwin.connection.wear import (
    RunEvidence,
    WearLimits,
    WearState,
    learn,
    run_evidence,
    sudden_change,
    wear_unit,
    worn_settling,
)
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.read import read_runs
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS

PATH_NOISE_M = 0.001
DELAY = 25
"""Runs that have to follow before one is learned from."""

STATIC = WearLimits(rate=0.0, reach=1e3, limit=1e3)
BY = pytest.mark.parametrize("readings", [False, True], ids=["tool path", "readings"])


def outcomes(steps):
    """Return what became of each run, by number."""
    return {number: outcome for step in steps for number, outcome in step.outcomes}


def motor_2(counts):
    """Return a change of motor 2 alone, in counts, (run or 1, motor) [rad]."""
    change = np.zeros((np.size(counts), 4))
    change[:, 1] = COUNT * np.asarray(counts)
    return change


def test_evidence_is_the_slope_of_the_settled_tool(armpi, twin):
    """Design against finite differences of the pose that a changed robot would settle at."""
    seen = observe_wear(armpi, truth(1), np.random.default_rng(0))
    (evidence,) = run_evidence(seen, armpi, SETTLING, [0])
    wear = truth(1)[0]

    def settled(change):
        worn = worn_settling(SETTLING, WearState(wear + change, np.eye(8)), 0)
        return expected + offset(worn, expected) - offset(SETTLING, expected)

    def offset(settling, pose):
        return settling.offset(armpi, pose, seen.direction)

    expected = seen.target + offset(SETTLING, seen.target)
    step = 1e-6
    for m in range(5):
        move = 1e-6 * np.eye(4)
        slope = ((twin.path(expected[m] + move) - twin.path(expected[m] - move)) / 2e-6).T
        scaled = slope * np.array(SETTLING.scatter)
        root = np.linalg.cholesky(scaled @ scaled.T + PATH_NOISE_M**2 * np.eye(3))
        for k in range(8):
            change = step * np.eye(8)[k]
            moved = twin.path(settled(change)) - twin.path(settled(-change))
            np.testing.assert_allclose(
                root @ evidence.design[m, :, k], moved[m] / (2 * step), rtol=1e-5, atol=1e-7
            )


@BY
def test_evidence_of_the_calibrated_robot_has_unit_scatter(armpi, readings):
    """Errors about the true wear are a standard normal distribution, by Kolmogorov and Smirnov."""
    calibration = normal(CALIBRATION)
    wear = truth(400)
    residual = np.concatenate(
        [
            (run.error - run.design @ wear[0]).ravel()
            for run in evidence_of(armpi, wear, 1, readings, calibration)
        ]
    )
    assert len(residual) == 400 * 5 * (4 if readings else 3)
    assert stats.kstest(residual, "norm").pvalue > 1e-3


@BY
def test_movements_whose_command_got_lost_say_nothing(armpi, twin, readings):
    seen = observe_wear(armpi, truth(1), np.random.default_rng(3), readings)
    pose = seen.target.copy()
    pose[2, 0] = seen.origin[2, 0]
    point = seen.point.copy()
    point[2] = twin.path(pose[2])
    position = None
    if seen.position is not None:
        position = seen.position.copy()
        position[2, 0] = seen.origin[2, 0]
    lossy = replace(seen, point=point, position=position)
    (evidence,) = run_evidence(lossy, armpi, SETTLING, [0])
    assert len(evidence.error) == (19 if readings else 4)
    assert np.abs(evidence.error - evidence.design @ truth(1)[0]).max() < 8


@BY
def test_a_static_robot_is_learned_as_by_one_fit_to_all_runs(armpi, readings):
    """With a normal scatter and no wear: the posterior of all runs together, in closed form."""
    calibration = normal(CALIBRATION)
    evidence = evidence_of(armpi, truth(60, motor_2([1.0])), 2, readings, calibration)
    tracker, _ = follow_all(fresh(armpi, calibration, STATIC), evidence)

    learned = evidence[: 60 - DELAY]
    design = np.concatenate([run.design.reshape(-1, 8) for run in learned])
    error = np.concatenate([run.error.ravel() for run in learned])
    kept = [0, 1, 2, 3, 5, 6, 7]  # gravity does not load motor 1
    prior = np.diag(1.0 / np.diag(tracker.start.covariance)[kept])
    information = design[:, kept].T @ design[:, kept] + prior
    mean = np.linalg.solve(
        information, design[:, kept].T @ error + prior @ tracker.start.mean[kept]
    )
    np.testing.assert_allclose(tracker.state.mean[kept], mean, rtol=1e-8)
    np.testing.assert_allclose(
        tracker.state.covariance[np.ix_(kept, kept)], np.linalg.inv(information), rtol=1e-6, atol=0
    )
    assert tracker.state.mean[4] == 0.0
    assert tracker.state.deviation[4] == 0.0


@pytest.mark.parametrize("dof", [2.5, 4.0, 30.0])
def test_heavy_tails_are_learned_by_the_posterior_mode(dof):
    """Against a general optimiser of the log posterior, with an outlier among the data."""
    rng = np.random.default_rng(4)
    design = rng.normal(size=(5, 3, 2))
    error = design @ [0.4, -0.3] + rng.normal(size=(5, 3))
    error[1] += 15.0
    root = rng.normal(size=(2, 2))
    prior = WearState(np.array([0.1, 0.0]), root @ root.T)

    def cost(wear):
        far = np.sum((error - design @ wear) ** 2, axis=1)
        off = wear - prior.mean
        quadratic = 0.5 * off @ np.linalg.solve(prior.covariance, off)
        return quadratic + 0.5 * (dof + 3) * np.sum(np.log1p(far / dof))

    best = optimize.minimize(cost, prior.mean, method="Nelder-Mead", options={"xatol": 1e-8})
    got = learn(prior, RunEvidence("run", "", error, design), dof)
    np.testing.assert_allclose(got.mean, best.x, atol=5e-3)  # a hundredth of the prior's width
    assert np.all(np.linalg.eigvalsh(got.covariance) > 0)


def test_a_random_walk_is_the_kalman_filter(armpi):
    """One motor read directly: gain and variance by the scalar recursion."""
    limits = WearLimits(rate=0.3, reach=1e3, limit=1e3)
    calibration = normal(CALIBRATION)
    design = np.zeros((1, 1, 8))
    design[0, 0, 0] = 1 / SETTLING.scatter[0]
    rng = np.random.default_rng(5)
    errors = rng.normal(size=40)
    runs = [RunEvidence(f"{i}", f"{i}", np.array([[e]]), design) for i, e in enumerate(errors)]
    tracker, _ = follow_all(fresh(armpi, calibration, limits), runs)

    mean, variance, scatter = SETTLING.bias[0], 0.001**2, SETTLING.scatter[0]
    for error in errors[: 40 - DELAY]:
        variance += (0.3 * scatter) ** 2
        gain = variance / (variance + scatter**2)
        mean, variance = mean + gain * (error * scatter - mean), (1 - gain) * variance
    assert tracker.state.mean[0] == pytest.approx(mean, rel=1e-9)
    assert tracker.state.covariance[0, 0] == pytest.approx(variance, rel=1e-9)


@BY
def test_wear_is_followed_and_the_doubt_is_honest(armpi, readings):
    """Two counts of swing in the bias and a quarter more sag, over two thousand runs."""
    runs = 2000
    at = np.arange(runs)[:, None]
    swing = COUNT * np.sin(2 * np.pi * at / 2500.0 + np.arange(4))
    wear = truth(runs, swing - swing[0], 0.25 * at / runs * np.array(SETTLING.compliance))
    tracker = fresh(armpi)
    tracker, steps = follow_all(tracker, evidence_of(armpi, wear, 6, readings))
    off = np.array(
        [tracker.in_angle(step.state.mean - w) for step, w in zip(steps, wear, strict=True)]
    )
    doubt = np.array([tracker.in_angle(step.state.deviation) for step in steps])
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 0.5 * COUNT
    assert np.abs(off).max() < 1.3 * COUNT
    loaded = [0, 1, 2, 3, 5, 6, 7]
    share = np.abs(off[DELAY:, loaded]) / doubt[DELAY:, loaded]
    assert np.mean(share < 3) > 0.97
    assert 0.6 < np.mean(share < 1) < 0.92  # two in three, if they were normal
    assert not any(step.alarm for step in steps)


def test_untracked_wear_would_be_a_count_and_more():
    """The wear of the test above is worth following."""
    swing = COUNT * np.sin(2 * np.pi * np.arange(2000)[:, None] / 2500.0 + np.arange(4))
    assert np.ptp(swing, axis=0).min() > 1.5 * COUNT


def test_while_a_fault_is_suspected_nothing_is_learned(armpi):
    """Bit for bit, mean and covariance, however long it takes."""
    evidence = evidence_of(armpi, truth(160), 7)
    before, _ = follow_all(fresh(armpi), evidence[:60])
    assert before.learned_at == 60 - DELAY
    after, steps = follow_all(before, evidence[60:], 0.999)
    assert all(step.alarm for step in steps)
    np.testing.assert_array_equal(after.state.mean, before.state.mean)
    np.testing.assert_array_equal(after.state.covariance, before.state.covariance)
    assert after.imperfections.settling == before.imperfections.settling
    assert after.imperfections.variation.bias[0] > before.imperfections.variation.bias[0]


def test_what_came_before_a_declared_fault_is_discarded(armpi):
    """Five faulty runs that nobody noticed, then a fault that is declared: none is learned."""
    evidence = evidence_of(armpi, truth(60), 8)
    chance = np.array([0.1] * 40 + [0.2] * 5 + [0.999] * 15)
    tracker, steps = follow_all(fresh(armpi), evidence, chance)
    told = outcomes(steps)
    learned = {number for number, outcome in told.items() if outcome == "learned"}
    assert max(learned) <= 45 - DELAY
    assert {told[number] for number in range(46 - DELAY, 46)} <= {"frozen", "discarded"}
    assert tracker.cusum == 9.0 + 2.0
    assert tracker.alarm == "runs look faulty one after another"


def test_after_the_repair_it_goes_on(armpi):
    evidence = evidence_of(armpi, truth(150), 9)
    chance = np.array([0.1] * 40 + [0.999] * 20 + [0.05] * 90)
    tracker, steps = follow_all(fresh(armpi), evidence, chance)
    told = outcomes(steps)
    assert not tracker.alarm
    assert tracker.learned_at == 150 - DELAY
    assert all(told[number] == "discarded" for number in range(41, 61))


@pytest.mark.parametrize("chance", [0.6, 0.999, np.nan])
def test_one_doubtful_run_is_left_out_and_no_more(armpi, chance):
    evidence = evidence_of(armpi, truth(100), 10)
    fault_probability = np.full(100, 0.1)
    fault_probability[40] = chance
    _, steps = follow_all(fresh(armpi), evidence, fault_probability)
    told = outcomes(steps)
    assert told[41] == "discarded"
    assert Counter(told.values())["learned"] >= 73
    assert not any("one after another" in step.alarm for step in steps)


def test_a_run_without_settled_movements_changes_nothing(armpi):
    empty = RunEvidence("empty", "empty", np.zeros((0, 3)), np.zeros((0, 3, 8)))
    tracker, steps = follow_all(fresh(armpi), [empty] * 40)
    assert set(outcomes(steps).values()) == {"discarded"}
    np.testing.assert_array_equal(tracker.state.mean, tracker.start.mean)


@BY
@pytest.mark.parametrize("counts", [5.0, -8.0, 30.0])
def test_a_sudden_fault_that_the_diagnosis_misses_is_not_absorbed(armpi, readings, counts):
    """All runs are called healthy; only the tracker itself can tell."""
    wear = np.concatenate([truth(200), truth(400, motor_2([counts]))])
    tracker, steps = follow_all(fresh(armpi), evidence_of(armpi, wear, 11, readings))
    before = steps[199].state
    moved = tracker.in_angle(tracker.state.mean - before.mean) / COUNT
    assert np.abs(moved[:4]).max() < 0.7
    assert tracker.alarm.endswith("of motor_2 changes faster than by wear")
    first = next(step.number for step in steps if step.alarm)
    assert 200 < first <= 200 + DELAY


@BY
@pytest.mark.parametrize("pace", [0.03, 0.1, 0.5], ids=lambda pace: f"{pace} counts a run")
def test_a_fault_that_grows_is_not_absorbed(armpi, readings, pace):
    """It is taken for wear until it stands out; then learning stops, however far it goes."""
    runs = 600
    wear = np.concatenate([truth(300), truth(runs, motor_2(pace * np.arange(runs)))])
    tracker, steps = follow_all(fresh(armpi), evidence_of(armpi, wear, 12, readings))
    moved = tracker.in_angle(tracker.state.mean - steps[299].state.mean) / COUNT
    assert pace * runs >= 18
    assert np.abs(moved).max() < 3.0
    assert "faster than by wear" in tracker.alarm


def test_wear_is_not_followed_beyond_what_is_normal(armpi):
    """So slow that it passes for wear, but there is an end to wear."""
    limits = WearLimits(limit=2.0)
    runs = 3000
    wear = truth(runs, motor_2(12.0 * np.arange(runs) / runs))
    tracker, steps = follow_all(fresh(armpi, limits=limits), evidence_of(armpi, wear, 13, True))
    first = next(step.alarm for step in steps if step.alarm)
    assert first == "bias of motor_2 is worn beyond what is normal"
    assert (tracker.state.mean - tracker.start.mean)[1] < 2.0 * SETTLING.scatter[1] + 1.5 * COUNT


def test_a_sudden_change_is_measured(armpi):
    """Twenty-five runs tell a change of bias and of compliance, with their deviations."""
    change = np.zeros(8)
    change[2], change[5] = 0.03, 0.08
    evidence = evidence_of(armpi, truth(25) + change, 14, True)
    tracker = fresh(armpi)
    found = sudden_change(tracker.state, evidence, tracker.unit, SETTLING.tail_dof)
    loaded = [0, 1, 2, 3, 5, 6, 7]
    score = (found.mean - change)[loaded] / found.deviation[loaded]
    assert np.abs(score).max() < 3.5
    assert found.deviation[2] < 0.002
    assert found.mean[4] == 0.0


def test_tracked_figures_replace_those_of_the_calibration(armpi):
    tracker, _ = follow_all(fresh(armpi), evidence_of(armpi, truth(80, motor_2([1.0])), 15))
    got = tracker.imperfections
    assert got.settling.bias == tuple(tracker.state.mean[:4])
    assert got.settling.compliance == tuple(tracker.state.mean[4:])
    assert (got.settling.friction, got.settling.scatter) == (SETTLING.friction, SETTLING.scatter)
    assert got.protocol == "P1"
    assert len(got.variation.compliance) == 4
    assert fresh(armpi).imperfections == CALIBRATION


def test_wear_counts_by_the_scatter_at_the_largest_load(armpi):
    unit = wear_unit(armpi, SETTLING)
    np.testing.assert_array_equal(unit[:4], SETTLING.scatter)
    assert unit[4] == 0.0
    assert np.all(unit[5:] > 0)
    angle = fresh(armpi).in_angle(unit)
    np.testing.assert_allclose(angle, [*SETTLING.scatter, 0.0, *SETTLING.scatter[1:]])


def test_without_settling_there_is_nothing_to_track(armpi):
    with pytest.raises(InputError, match="nothing to track"):
        fresh(armpi, NO_IMPERFECTIONS)


@BY
def test_healthy_sessions_of_a_real_arm_raise_no_alarm(armpi, data, readings):
    """Fifty runs of one day: the arm stays what its calibration says, within a count."""
    folders = [data / "real_robot_b_20241003" / f"label_{k}" for k in range(5)]
    seen = observe(read_runs(folders, armpi), use_readings=readings)
    known = load_calibration("armpi_fpv", armpi).imperfections
    tracker = fresh(armpi, replace(known, variation=DOUBT))
    evidence = run_evidence(seen, armpi, tracker.settling, range(len(seen.runs)))
    tracker, steps = follow_all(tracker, evidence)
    assert len(steps) == 50
    assert tracker.learned_at == 50 - DELAY
    assert not any(step.alarm for step in steps)
    assert np.abs(tracker.in_angle(tracker.state.mean - tracker.start.mean)).max() < COUNT
