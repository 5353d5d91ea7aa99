from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, SetupPrior
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses, single_faults
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import deterministic
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.expected_bayes_factors import (
    ExpectedLogBayesFactor,
    expected_log_bayes_factors,
    truth_and_faults,
)
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.healthy_model import HealthyModel

SETTLED = ("stuck", "encoder_bias", "encoder_scale", "backlash", "torque_loss", "drift")
"""Modes whose members settle exactly somewhere, that is, with nothing drawn for each movement."""


def quiet(imperfections):
    """Return imperfections without chance, but with their declared scatter."""
    return dataclasses.replace(deterministic(imperfections), settling=imperfections.settling)


@pytest.fixture(scope="module")
def found(twin, imperfect):
    return expected_log_bayes_factors(twin, imperfect)


def test_the_truth_is_nearest_to_itself(found):
    own = [found.hypotheses.index(truth) for truth in found.truth]
    np.testing.assert_array_equal(found.nats[np.arange(72), own], 0.0)
    others = found.nats.copy()
    others[np.arange(72), own] = np.inf
    np.testing.assert_array_equal(found.nearest, others.min(axis=1))


def test_runs_that_are_far_ahead_are_diagnosed_right(twin, armpi, measured_armpi):
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 20, 5, measured_armpi))
    nearest = expected_log_bayes_factors(twin, runs).nearest
    ahead, near = np.flatnonzero(nearest >= 5.0)[::4], np.flatnonzero(nearest < 5.0)
    diagnoser = BayesDiagnoser(twin, priors=Priors(setup=SetupPrior.known()))
    right = [
        np.mean([d.truth == d.diagnosis for d in diagnoser.diagnose(runs.isel(run=rows))])
        for rows in (ahead, near)
    ]
    assert len(ahead) >= 35
    assert right[0] >= 0.97
    assert right[1] <= right[0] - 0.05


def test_a_run_is_separated_alone(twin, imperfect, found):
    some, whole = imperfect.isel(run=[3, 20, 52]), found.nats[[3, 20, 52]]
    np.testing.assert_allclose(
        expected_log_bayes_factors(twin, some).nats, whole, rtol=1e-9, atol=1e-9
    )


def test_readings_count_only_by_being_there(twin, imperfect):
    some = imperfect.isel(run=[9, 41])
    moved = some.assign(measured=some["measured"] + 0.1)
    blind = some.assign(measured=some["measured"] * np.nan)
    np.testing.assert_array_equal(
        expected_log_bayes_factors(twin, moved).nats, expected_log_bayes_factors(twin, some).nats
    )
    np.testing.assert_allclose(expected_log_bayes_factors(twin, blind).nats, 0.0, atol=1e-12)


@pytest.fixture(scope="module")
def of_all_modes(armpi, measured_armpi):
    """Runs of every mode at motor 2, with all of their profiles, on an arm that never errs."""
    sure = deterministic(measured_armpi)
    return simulate(Plan(armpi, single_faults(["motor_2"], MODES), 4, 2, sure))


def test_runs_are_made_again_as_they_were(twin, armpi, measured_armpi, of_all_modes):
    compute_posterior = ExpectedLogBayesFactor(
        HealthyModel(twin, deterministic(measured_armpi)), (HEALTHY,), Priors()
    )
    faults = truth_and_faults(of_all_modes)[1]
    again = compute_posterior.noise_free(of_all_modes, faults)
    np.testing.assert_allclose(again["measured"], of_all_modes["measured"], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("motor", "mode"),
    [
        (f"motor_{k}", mode)
        for k in (1, 2, 3, 4)
        for mode in SETTLED
        if (k, mode) != (1, "torque_loss")  # motor 1 carries no load
    ],
)
def test_a_law_puts_the_tool_where_the_simulator_does(twin, armpi, measured_armpi, mode, motor):
    hypothesis = Hypothesis.parse(f"{motor}:{mode}")
    known = quiet(measured_armpi)
    fault_model = dataclasses.replace(MODES[mode], onset_s=(0.0, 0.0), profiles=("step",))
    runs = simulate(
        Plan(armpi, [hypothesis], 4, 1, deterministic(known), modes={mode: fault_model})
    )
    compute_posterior = ExpectedLogBayesFactor(
        HealthyModel(twin, known), (hypothesis, HEALTHY), Priors()
    )
    faults = truth_and_faults(runs)[1]
    own, healthy = compute_posterior.fits(runs, faults, runs["onset"].values).T
    travel = np.diff(
        runs["target"].values[:, :, runs["motor"].values == motor][..., 0], prepend=0.0
    )
    # A movement that is shorter than the play does not turn the joint; laws leave that out.
    simple = (mode != "backlash") | (np.abs(travel).min(axis=1) > runs["magnitude"].values)
    assert simple.any()
    assert own[simple].min() > -1.0
    assert (own - healthy)[simple].min() > 0.0


def test_without_losses_scatter_alone_counts(twin, armpi, imperfect):
    known = load_calibration(None, armpi).imperfections
    stuck = imperfect.isel(run=range(8, 40))
    lossy = expected_log_bayes_factors(twin, stuck).nats[:, 0]
    sound = expected_log_bayes_factors(
        twin, stuck, dataclasses.replace(known, lost_commands=())
    ).nats[:, 0]
    # What healthy had set aside for losses, also in rows, now speaks for it: less than a nat.
    assert (sound >= lossy - 1.0).all()
    assert sound.mean() > 1.1 * lossy.mean()


def test_a_truth_that_is_not_among_the_hypotheses_has_a_nearest_too(twin, imperfect, found):
    two = [HEALTHY, Hypothesis.parse("motor_2:stuck")]
    some = imperfect.isel(run=slice(None, None, 4))
    of_two = expected_log_bayes_factors(twin, some, hypotheses=["healthy", "motor_2:stuck"])
    assert of_two.hypotheses == tuple(two)
    assert of_two.nats.shape == (18, 2)
    np.testing.assert_allclose(of_two.nats, found.nats[::4, [0, 2]], rtol=0, atol=1e-9)
    strange = [truth not in two for truth in of_two.truth]
    np.testing.assert_array_equal(of_two.nearest[strange], of_two.nats[strange].min(axis=1))


def test_wrong_runs_are_refused(twin, armpi, imperfect):
    with pytest.raises(InputError, match="does not tell its truth: no variable `fault_detail`"):
        expected_log_bayes_factors(twin, imperfect.drop_vars("fault_detail"))
    both = Hypothesis.parse("motor_1:stuck+motor_2:stuck")
    runs = simulate(Plan(armpi, [both], 1))
    with pytest.raises(InputError, match="Expected healthy or one fault"):
        expected_log_bayes_factors(twin, runs)
