from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import UNKNOWN, Hypothesis, single_faults
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults import double_faults as pairs
from failuretwin.inference.faults.fault_models import (
    growing_offset_model,
    offset_model,
    redrawn_offset_model,
    transient_model,
)
from failuretwin.inference.faults.fault_sizes import SizePrior, redrawn_nodes, size_nodes
from failuretwin.inference.faults.priors import OnsetPrior, Priors
from failuretwin.inference.faults.stuck import _onsets, stuck_model
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.posterior import (
    marginal_likelihood_of,
    marginal_likelihoods,
)

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")
RANGES = ((0.02, 0.08), (0.04, 0.2))

FAULT_MODELS = {
    "stuck": lambda likelihood, early: stuck_model(likelihood, 1, OnsetPrior(early)),
    "stuck at a known time": lambda likelihood, early: stuck_model(
        likelihood, 1, OnsetPrior(known_s=2.3)
    ),
    "steady_state_error": lambda likelihood, early: redrawn_offset_model(
        likelihood, 1, MODES["steady_state_error"], SizePrior.even(RANGES), early
    ),
    "drift": lambda likelihood, early: growing_offset_model(
        likelihood, 1, MODES["drift"], SizePrior.even([(0.005, 0.06)]), early
    ),
    **{
        name: lambda likelihood, early, mode=MODES[name]: transient_model(
            likelihood, 1, mode, SizePrior.even([mode.considered]), early
        )
        for name in ("lag", "slow")
    },
    **{
        name: lambda likelihood, early, mode=MODES[name]: offset_model(
            likelihood, 1, mode, SizePrior.even([mode.considered]), early
        )
        for name in ("encoder_bias", "encoder_scale", "backlash", "torque_loss")
    },
}


@pytest.fixture(scope="module")
def runs(imperfect):
    """A run of each class, of 3 to 5 movements: some end early."""
    some = imperfect.isel(run=slice(0, 72, 8)).copy(deep=True)
    for run, last in enumerate([800, 450] * 4):
        some["command"][run, last:] = some["command"].values[run, last]
        some["measured"][run, last:] = np.nan
    return some


@pytest.fixture(scope="module")
def likelihood(twin, runs):
    return RunLikelihood(settled_evidence(runs), BayesDiagnoser(twin).healthy_model)


@pytest.fixture(scope="module")
def blind(twin, runs):
    return RunLikelihood(settled_evidence(runs.assign(measured=np.nan * runs["measured"])),
                 BayesDiagnoser(twin).healthy_model)  # fmt: skip


@pytest.mark.parametrize("early", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("fault_model", FAULT_MODELS)
def test_prior_mass_of_a_law_is_one(likelihood, fault_model, early):
    """Over all onsets and nodes, or groups of nodes, and within each group."""
    found = FAULT_MODELS[fault_model](likelihood, early)
    mass = np.exp(found.log_prior).sum(axis=(1, 2))
    np.testing.assert_allclose(mass, 1.0, atol=1e-9)
    if found.redrawn is not None:
        np.testing.assert_allclose(np.exp(found.redrawn).sum(axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize("fault_model", FAULT_MODELS)
def test_no_fault_begins_with_a_movement_that_is_not_there(likelihood, fault_model):
    found = FAULT_MODELS[fault_model](likelihood, 0.3)
    mass = np.exp(found.log_prior).sum(axis=2)
    assert (likelihood.evidence.movements.exists.sum(axis=1) < 5).any()
    np.testing.assert_array_equal(mass[~likelihood.evidence.movements.exists], 0.0)


@pytest.mark.parametrize("fault_model", FAULT_MODELS)
def test_onsets_lie_in_the_run(likelihood, fault_model):
    """No later than the end of the last movement; of a stuck motor, of its ramp if that is late."""
    found, evidence = FAULT_MODELS[fault_model](likelihood, 0.3), likelihood.evidence
    for run in range(9):
        onset, share = np.broadcast_arrays(*found.onsets(run))
        assert (share >= 0.0).all()
        assert np.isfinite(onset).all()
        late = 3.0 if "stuck" in fault_model else 0.0
        last = max(np.nanmax(evidence.end[run]), np.nanmax(evidence.movements.start[run]) + late)
        prior = np.exp(found.log_prior[run]).sum(axis=1) > 0.0
        possible = np.broadcast_to(prior[:, None, None] if len(onset) > 1 else True, onset.shape)
        chance = np.isfinite(found.log_prior[run]) if "stuck" in fault_model else slice(None)
        np.testing.assert_allclose(share.sum(axis=-1)[chance], 1.0, atol=1e-9)
        assert onset.min() >= 0.0
        assert onset[possible & (share > 0.0)].max() <= last


def test_onsets_on_a_ramp_hold_the_doubt_about_the_lag_of_one_motor(likelihood):
    """Variances add: that of the start of the movement, which all share, and (0.03 s)^2."""
    alone, usual = likelihood[3], likelihood.model.start_delay.punctual
    chance = np.exp(usual.log_weight)
    mean = chance @ usual.delay
    onset, share = _onsets(alone, 1, np.array([0.1]))[1]
    at, part = np.broadcast_arrays(onset[1, 0], share[1, 0])
    early = at < at.min() + 0.4  # late starts come half a second later
    weight = part[early] / part[early].sum()
    middle = weight @ at[early]
    expected = chance @ (usual.delay - mean) ** 2 + 0.03**2
    assert weight @ (at[early] - middle) ** 2 == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    "hypothesis",
    [*single_faults(MOTORS[1:2], MODES), UNKNOWN,
     Hypothesis.parse("motor_2:encoder_bias+motor_3:stuck")],
    ids=str,
)  # fmt: skip
def test_without_evidence_every_hypothesis_is_as_good(blind, hypothesis):
    """The density of no reading at all is one, whatever may be wrong."""
    if hypothesis == UNKNOWN:
        known = Hypothesis.parse("motor_2:stuck")
        evidence = marginal_likelihoods(blind, (known, UNKNOWN), Priors())[1].log_evidence
    else:
        evidence = marginal_likelihood_of(blind, hypothesis, Priors()).log_evidence
    np.testing.assert_allclose(evidence, 0.0, atol=1e-6)


@given(
    seed=st.integers(0, 10**6),
    sizes=st.sampled_from([(0.02, 0.85), (0.25, 0.8), (0.005, 0.06)]),
    signed=st.booleans(),
)
def test_sizes_are_as_likely_wherever_the_nodes_lie(seed, sizes, signed):
    """The nodes crowd where movements point, the prior stays uniform: its distribution function
    is a straight line on each side of zero."""
    rng = np.random.default_rng(seed)
    best, width = rng.normal(0.0, 0.6, (2, 5)), rng.uniform(1e-4, 0.2, (2, 5))
    nodes, log_mass = size_nodes(best, width, rng.random((2, 5)) < 0.7, [sizes], signed)
    low, high = sizes
    for node, mass in zip(nodes, np.exp(log_mass[:, 0]), strict=True):
        assert mass.sum() == pytest.approx(1.0)
        assert (np.diff(node) >= 0.0).all()
        assert node[mass > 0.0].min() >= (-high if signed else low) - 1e-12
        assert np.abs(node[mass > 0.0]).min() >= low - 1e-12
        for at in rng.uniform(low, high, 5):
            below = mass[(node >= low) & (node < at)].sum() / (0.5 if signed else 1.0)
            step = (high - low) / 40.0
            assert below == pytest.approx((at - low) / (high - low), abs=step / (high - low))
        if signed:
            assert mass[node > 0.0].sum() == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("least", [1e-4, 1.0])
@pytest.mark.parametrize(
    "ranges", [RANGES, ((0.1, 0.3),), ((0.01, 0.02), (0.3, 0.35)), ((5e-4, 0.003), (0.2, 0.9))]
)
def test_errors_are_as_likely_within_each_range(ranges, least):
    best, usable = np.array([[0.15, -0.013]]), np.array([[True, True]])
    size, log_mass = redrawn_nodes(best, np.full((1, 2), 0.001), usable, ranges, least)
    for sizes, weights in zip(size[0], np.exp(log_mass[0]), strict=True):
        np.testing.assert_allclose(weights.sum(axis=1), 1.0)
        np.testing.assert_allclose(weights[:, sizes > 0.0].sum(axis=1), 0.5)
        step = np.diff(sizes).max()
        for (low, high), weight in zip(ranges, weights, strict=True):
            assert weight @ np.abs(sizes) == pytest.approx(0.5 * (low + high), abs=step)
            inside = (np.abs(sizes) > low - step) & (np.abs(sizes) < high + step)
            assert weight[inside].sum() == pytest.approx(1.0)


def test_a_motor_that_lost_torque_sags_as_its_stiffness_is_left():
    """Load over stiffness: of a share s lost, 1 / (1 - s) times as far, which is so much more."""
    weak, share = MODES["torque_loss"], np.linspace(0.0, 0.9, 10)
    np.testing.assert_allclose(weak.amount(share), 1.0 / (1.0 - share) - 1.0)
    np.testing.assert_allclose(weak.size_of(weak.amount(share)), share, atol=1e-12)


def test_drifts_of_all_rates_and_both_signs_are_as_likely(likelihood):
    fault_model = growing_offset_model(
        likelihood, 0, MODES["drift"], SizePrior.even([(0.005, 0.06)]), 0.6
    )
    mass = np.exp(fault_model.log_prior[0]).sum(axis=0)
    low, high = 0.005, 0.06
    size = fault_model.size[0]
    assert np.abs(size).min() == pytest.approx(low)
    assert np.abs(size).max() == pytest.approx(high)
    assert mass @ size == pytest.approx(0.0, abs=1e-12)
    assert mass @ np.abs(size) == pytest.approx(0.5 * (low + high), rel=1e-6)


@pytest.mark.parametrize("mode", ["encoder_bias", "encoder_scale", "drift", "torque_loss"])
def test_offsets_are_those_of_the_simulated_motion(likelihood, mode):
    """What a mode says of its offset is what its stages do to a motor that stands at its target."""
    said, alone = MODES[mode], likelihood[3]
    sizes = SizePrior.even([said.considered])
    found = type("Asked", (type(said),), {"settled_offset": FaultMode.settled_offset})()
    model = growing_offset_model if mode == "drift" else offset_model
    expected, asked = model(alone, 1, said, sizes, 0.3), model(alone, 1, found, sizes, 0.3)
    np.testing.assert_allclose(asked.angle, expected.angle, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(asked.size, expected.size, rtol=0.0, atol=1e-9)


def test_an_offset_that_bends_with_its_size_is_asked_at_every_node(likelihood):
    """A stop in the way at (1 - size) of 80 degrees: not in proportion to any amount."""

    def stops(self, faults, reference, time):
        limit = np.deg2rad(80.0) * (1.0 - faults.effect(time))
        return np.clip(reference, -limit, limit)

    kind = {"mode": "end_stop", "on_reference": stops, "sizes": (0.3, 0.95)}
    stop = type("EndStop", (type(MODES["slow"]),), {**kind, "on_movements": FaultMode.on_movements})
    found = offset_model(likelihood, 1, stop(), SizePrior.even([stop().considered]), 0.3)
    base = likelihood.outcomes.base[..., 1][:, :, None]
    limit = np.deg2rad(80.0) * (1.0 - found.size[:, None, :, None])
    settled = likelihood.profile(1).faulty_baseline[:, :, None]
    expected = np.broadcast_to(np.clip(base, -limit, limit) - base, found.angle.shape)
    np.testing.assert_allclose(found.angle - settled, expected, atol=1e-12)


@pytest.mark.parametrize("mode", ["stuck", "encoder_bias", "drift"])
def test_thinning_a_law_for_pairs_loses_no_mass(likelihood, monkeypatch, mode):
    monkeypatch.setattr(pairs, "MOST_NODES", 48)
    alone = likelihood[3]
    fault_model = FAULT_MODELS[mode](alone, 0.3)
    few = pairs._thinned(alone, fault_model)
    assert few.log_prior.shape[2] == 48 < fault_model.log_prior.shape[2]
    whole, kept = (np.exp(x.log_prior[0]).sum(axis=1) for x in (fault_model, few))
    np.testing.assert_allclose(kept, whole, atol=1e-12)
