"""Streams against recorded runs: the same data, the same answer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Plan
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses, state_of
from failuretwin.data_knowledge.generate import simulate
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.digital_model.calibrated_robot import load_calibration

FEW = [0, 3, 6]
"""Some of the nine states."""


def posteriors(diagnoses):
    return np.array([list(diagnosis.posterior.values()) for diagnosis in diagnoses])


def decided(diagnoser, runs):
    """Return the posteriors of the batch."""
    return posteriors(of_named(diagnoser).diagnose(runs))


def of_named(diagnoser):
    """Return a diagnoser that is told what a stream takes for granted: the robot is the named."""
    named = dataclasses.replace(diagnoser.priors.setup, another_rate=0.0)
    priors = dataclasses.replace(diagnoser.priors, setup=named)
    return BayesDiagnoser(
        diagnoser.twin,
        hypotheses=diagnoser.hypotheses,
        priors=priors,
        whole_run=diagnoser.whole_run,
        sensing=diagnoser.sensing,
    )


def play(runs, diagnoser, robots=slice(None), order=None, skip=()):
    """Return a fleet that has seen the runs, in some order of the samples."""
    time, command = runs["time"].values, runs["command"].values[robots]
    measured = runs["measured"].values[robots]
    fleet = StreamingFleet(of_named(diagnoser), len(command), runs.attrs["measured_rate_hz"])
    for i in range(len(time)) if order is None else order:
        if i not in skip:
            fleet.update(time[i], command[:, i], measured[:, i])
    return fleet


@pytest.fixture(scope="module")
def nine_runs(live_runs):
    """One of each state."""
    return live_runs.isel(run=slice(None, None, 2))


@pytest.fixture(scope="module")
def few_runs(nine_runs):
    """Healthy, stuck and with errors."""
    return nine_runs.isel(run=FEW)


@pytest.fixture(scope="module")
def played(nine_runs, live_diagnoser):
    """A fleet that has seen them to their end, and its posteriors before it was told of that."""
    fleet = play(nine_runs, live_diagnoser)
    before = fleet.posterior.copy()
    fleet.conclude()
    return fleet, before


def test_the_end_of_a_stream_is_the_batch(nine_runs, live_diagnoser, played):
    fleet, _ = played
    expected = of_named(live_diagnoser).diagnose(nine_runs)
    np.testing.assert_allclose(fleet.posterior, posteriors(expected), rtol=0.0, atol=1e-9)
    for robot, diagnosis in enumerate(expected):
        said = fleet.diagnosis(robot)
        assert said.diagnosis == diagnosis.diagnosis
        assert said.onset_s == pytest.approx(diagnosis.onset_s, abs=0.2)
        if said.onset_90 is not None:  # ends jump where a lump of probability lies right there
            (low, high), (least, most) = said.onset_90, diagnosis.onset_90
            assert max(low, least) <= min(high, most)
        assert said.magnitude == pytest.approx(diagnosis.magnitude, abs=0.01)
        assert state_of(said.posterior) == state_of(diagnosis.posterior)


def test_robots_do_not_know_each_other(nine_runs, live_diagnoser, played):
    _, together = played
    alone = play(nine_runs, live_diagnoser, slice(5, 6)).posterior
    np.testing.assert_allclose(alone[0], together[5], rtol=0.0, atol=1e-12)


def test_modes_that_show_on_the_way_count_in_streams(live_runs, twin):
    hypotheses = parse_hypotheses(
        ["healthy", "motor_2:lag", "motor_3:slow", "motor_1:stuck"], twin.robot.motor_names
    )
    diagnoser, some = BayesDiagnoser(twin, hypotheses=hypotheses), live_runs.isel(run=[0, 3])
    fleet = play(some, diagnoser)
    fleet.conclude()
    expected = decided(diagnoser, some)
    np.testing.assert_allclose(fleet.posterior, expected, rtol=0.0, atol=1e-9)


def test_samples_may_come_late(few_runs, live_diagnoser, rng):
    """Readings that arrive up to 0.1 s late, out of order, change nothing in the end."""
    count, some = few_runs.sizes["time"], few_runs
    order = np.argsort(np.arange(count) + rng.integers(0, 10, count), kind="stable")
    settled = BayesDiagnoser(live_diagnoser.twin, whole_run=False)
    # What is told late of commands is not taken up, so only readings are late here.
    time, command = some["time"].values, some["command"].values
    measured = some["measured"].values
    fleet = StreamingFleet(of_named(settled), len(FEW), some.attrs["measured_rate_hz"])
    for now, i in enumerate(order):
        fleet.update(time[now], command[:, now], None)
        fleet.update(time[i], None, measured[:, i])
    fleet.conclude()
    np.testing.assert_allclose(fleet.posterior, decided(settled, some), rtol=0.0, atol=1e-9)


def test_missing_samples_are_no_evidence(few_runs, live_diagnoser, rng):
    """Readings that are lost on the way to the stream might as well not have been taken."""
    some = few_runs.copy(deep=True)
    lost = rng.random(some["measured"].shape[:2]) < 0.3
    some["measured"].values[lost] = np.nan
    fleet = play(some, live_diagnoser)
    fleet.conclude()
    expected = decided(live_diagnoser, some)
    np.testing.assert_allclose(fleet.posterior, expected, rtol=0.0, atol=1e-9)


def test_whole_samples_may_be_missing(few_runs, live_diagnoser, played, rng):
    """Commands are known as well from fewer samples: their corners are found between them."""
    whole, _ = played
    kept = rng.random(few_runs.sizes["time"]) < 0.8
    read = np.isfinite(few_runs["measured"].values).all(axis=2).any(axis=0)
    kept[:30] = True
    fewer = play(few_runs, live_diagnoser, skip=set(np.flatnonzero(~kept & ~read).tolist()))
    fewer.conclude()
    np.testing.assert_allclose(fewer.posterior, whole.posterior[FEW], atol=0.02)


def test_silence_is_told(live_runs, live_diagnoser):
    fleet = play(live_runs.isel(run=[0, 1]), live_diagnoser)
    assert not fleet.stale.any()
    fleet.update(fleet.time + 5.1, None, [[0.1, 0.1, 0.1], [np.nan] * 3])
    assert fleet.stale.tolist() == [False, True]


def test_before_the_first_movement_the_prior_stands(live_diagnoser):
    fleet = StreamingFleet(live_diagnoser, 2)
    assert fleet.stale.all()
    fleet.update(0.0, np.zeros((2, 4)), np.full((2, 3), 0.1))
    np.testing.assert_allclose(fleet.posterior, 1.0 / 9.0)
    assert fleet.diagnosis(0) is None
    assert not fleet.judged.any()


@pytest.mark.parametrize(
    ("time", "command", "measured"),
    [(0.0, np.zeros((3, 4)), None), (0.0, None, np.zeros(3)), (np.nan, None, np.zeros((2, 3)))],
)
def test_a_sample_of_another_shape_is_refused(live_diagnoser, time, command, measured):
    with pytest.raises(InputError, match="Expected"):
        StreamingFleet(live_diagnoser, 2).update(time, command, measured)


@pytest.mark.slow
def test_five_hundred_runs_as_streams(armpi, twin, rng):
    imperfect = load_calibration(armpi.name, armpi).imperfections
    plan = Plan(armpi, paper_hypotheses(armpi.motor_names), 56, 11, imperfect)
    runs = simulate(plan).isel(run=slice(0, 500)).copy(deep=True)
    lost = rng.random(runs["measured"].shape[:2]) < 0.1
    runs["measured"].values[lost] = np.nan
    diagnoser = BayesDiagnoser(twin)
    # Readings arrive up to 0.3 s late, out of order.
    time, command, measured = (runs[name].values for name in ("time", "command", "measured"))
    order = np.argsort(np.arange(len(time)) + rng.integers(0, 30, len(time)), kind="stable")
    fleet = StreamingFleet(of_named(diagnoser), 500, runs.attrs["measured_rate_hz"])
    for now, i in enumerate(order):
        fleet.update(time[now], command[:, now], None)
        fleet.update(time[i], None, measured[:, i])
    fleet.conclude()
    off = np.abs(fleet.posterior - decided(diagnoser, runs)).max(axis=1)
    # A tool that stands still while motors should move is dead for a stream, at once; a recorded
    # run is judged by what is left of it.
    assert np.mean(off < 1e-5) > 0.99
