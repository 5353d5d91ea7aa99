from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from coaxial_arm import ARM_M, coaxial_twin

from failuretwin import BayesDiagnoser, SetupPrior, isolability
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses, single_faults
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.nonidealities import Imperfections, Readings
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.expected_bayes_factors import (
    ExpectedLogBayesFactor,
    expected_distance_factor,
)
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.isolability import (
    FOUND_NATS,
    MonteCarloFaults,
    _groups,
    _motions,
    needed_nats,
)
from failuretwin.inference.observation.healthy_model import HealthyModel

TIME = 0.01 * np.arange(1000)
TARGETS = np.array(
    [
        [0.9, 0.5, -0.4, 0.6],
        [-0.7, -0.3, 0.7, -0.5],
        [0.4, 0.8, 0.3, 0.8],
        [-1.1, -0.6, -0.8, -0.7],
        [0.2, 0.3, 0.5, 0.4],
    ]
)
KNOWN_SET_UP = Priors(setup=SetupPrior.known())
NOISE_M = np.hypot(0.0, 0.0003)
"""Noise of a settled position where readings have none: what bending links leave unsaid."""


def motion(targets, initial=None):
    """Return commands of a movement every 2 s, (time, motor)."""
    targets = np.asarray(targets, dtype=float)
    initial = np.zeros(targets.shape[1]) if initial is None else np.asarray(initial, dtype=float)
    return Movements(
        initial=initial[None],
        target=targets[None],
        ramp_duration=np.full((1, *targets.shape), 0.8),
        start=2.0 * np.arange(len(targets), dtype=float)[None] + 0.05,
    ).reference(TIME)[0]


def scattered(scatter, dof=np.inf):
    """Return imperfections of nothing but scatter [rad]."""
    zero = (0.0,) * len(scatter)
    settling = Settling(zero, zero, zero, tuple(scatter), dof, "test")
    return Imperfections("scattered", "test", settling=settling, readings=Readings(rate_hz=10.0))


def faults(*names):
    return [HEALTHY, *(Hypothesis.parse(name) for name in names)]


def told(found, true, other):
    """Return by how much `true` beats `other` [nats]."""
    return found.nats[found.hypotheses.index(true), found.hypotheses.index(other)]


@pytest.fixture(scope="module")
def coaxial(tmp_path_factory):
    return coaxial_twin(tmp_path_factory.mktemp("coaxial"))


def test_a_motor_that_is_never_told_to_move_may_be_stuck(twin):
    idle = TARGETS.copy()
    idle[:, 0] = 0.0
    found = isolability(twin, motion(idle), TIME, scattered([0.005] * 4))
    assert told(found, "motor_1:stuck", "healthy") == pytest.approx(0.0, abs=0.05)
    assert found.groups == (("healthy", "motor_1:stuck"),)
    assert min(told(found, f"motor_{k}:stuck", "healthy") for k in (2, 3, 4)) > 40.0


def test_a_motor_that_moves_is_not_taken_for_stuck(twin):
    found = isolability(twin, motion(TARGETS), TIME, scattered([0.005] * 4))
    assert found.groups == ()


def test_play_of_motors_about_one_axis_shows_whose_it_is_only_if_they_turn_apart(coaxial):
    names = ("motor_1:backlash", "motor_2:backlash")
    there = np.array([0.5, -0.3, 0.4, -0.6, 0.1])
    crossing = np.array([0.5, 0.8, -0.4, 0.3, 0.6])
    scatter = scattered([0.003, 0.003])
    together = isolability(
        coaxial, motion(np.stack([there, there], 1)), TIME, scatter, faults(*names)
    )
    apart = isolability(
        coaxial, motion(np.stack([there, crossing], 1)), TIME, scatter, faults(*names)
    )

    assert together.groups == (names,)
    assert told(together, *names) == pytest.approx(0.0, abs=0.05)
    assert None not in together.detected.values()
    assert set(together.isolated.values()) == {None}
    assert apart.groups == ()
    assert None not in apart.isolated.values()


def test_a_shifted_zero_about_one_axis_never_shows_whose_it_is(coaxial):
    names = ("motor_1:encoder_bias", "motor_2:encoder_bias")
    targets = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    found = isolability(coaxial, motion(targets), TIME, scattered([0.003, 0.003]), faults(*names))
    assert found.groups == (names,)


def expected_smallest(scatter, movements):
    """Return the shifted zero that is 5 nats ahead: half of its squared distance, summed."""
    spread = 2.0 * (ARM_M * scatter) ** 2 + NOISE_M**2
    return np.sqrt(2.0 * 5.0 / movements * spread) / ARM_M


@pytest.mark.parametrize(
    ("scatter", "onset", "spoilt"), [(0.02, 0.0, 5), (0.04, 0.0, 5), (0.02, 5.0, 3)]
)
def test_the_smallest_size_is_where_half_the_squared_distance_says(coaxial, scatter, onset, spoilt):
    targets = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    found = isolability(
        coaxial,
        motion(targets),
        TIME,
        scattered([scatter, scatter]),
        faults("motor_1:encoder_bias"),
        onset_s=onset,
    )
    expected = expected_smallest(scatter, spoilt)
    assert found.detected["motor_1:encoder_bias"] == pytest.approx(expected, rel=0.01)


def test_sizes_may_begin_at_nothing(coaxial):
    """The smallest size found does not depend on where the range begins."""
    targets = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    name = "motor_1:steady_state_error"
    said = {}
    for low in (0.0, 0.001, 0.01):
        priors = Priors(error_ranges=((low, 0.4),))
        found = isolability(
            coaxial, motion(targets), TIME, scattered([0.02] * 2), faults(name), priors
        )
        said[low] = found.detected[name]
        assert np.isfinite(found.nats).all()
    assert said[0.0] == pytest.approx(said[0.001], rel=0.1)
    assert said[0.0] == pytest.approx(said[0.01], rel=0.3)


def test_separation_grows_with_the_square_of_the_size(twin):
    """Compare with half of the squared distance, linearised at the healthy poses."""
    bias, scatter = Hypothesis.parse("motor_3:encoder_bias"), 0.03
    compute_posterior = ExpectedLogBayesFactor(
        HealthyModel(twin, scattered([scatter] * 4)), (HEALTHY, bias), Priors()
    )
    trials = MonteCarloFaults(compute_posterior, _motions(twin, motion(TARGETS), TIME), 0.0)
    sizes = np.array([0.02, 0.03, 0.04])
    _, jacobian = twin.path_and_jacobian(TARGETS)
    lever = jacobian[..., 2]
    spread = scatter**2 * jacobian @ jacobian.swapaxes(-1, -2) + NOISE_M**2 * np.eye(3)
    square = np.einsum("ma,ma->", lever, np.linalg.solve(spread, lever[..., None])[..., 0])
    ahead = trials.log_bayes_factor([(bias, float(size)) for size in sizes])[:, 0]
    np.testing.assert_allclose(ahead, 0.5 * square * sizes**2, rtol=0.08)
    assert ahead[2] / ahead[0] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("square", [0.01, 1.0, 9.0, 100.0])
def test_expected_falls_are_those_of_simulated_scatter(square):
    rng, dof = np.random.default_rng(0), 4.0
    chi = rng.chisquare(dof, 400_000) / dof
    noise = rng.standard_normal((400_000, 3)) / np.sqrt(chi)[:, None]

    def cost(points):
        return 0.5 * (dof + 3.0) * np.log1p(np.sum(points**2, axis=1) / dof)

    shift = np.array([np.sqrt(square), 0.0, 0.0])
    # Both signs: what is odd in the shift cancels.
    drawn = 0.5 * np.mean(cost(noise + shift) + cost(noise - shift)) - np.mean(cost(noise))
    formula = 0.5 * (dof + 3.0) * np.log1p(square * expected_distance_factor(dof) / dof)
    assert formula == pytest.approx(drawn, rel=0.04, abs=min(0.5, 0.05 * square))
    assert expected_distance_factor(np.inf) == 1.0


@pytest.fixture(scope="module")
def of_real_motions(twin, armpi, measured_armpi):
    """What random motions of the imperfect arm can tell of steady-state errors."""
    runs = simulate(Plan(armpi, [HEALTHY], 4, 3, measured_armpi))
    return isolability(twin, runs["command"].values, runs["time"].values, measured_armpi)


def test_faults_above_the_smallest_size_are_found_and_those_well_below_are_not(
    twin, armpi, measured_armpi, of_real_motions
):
    smallest = of_real_motions.isolated
    diagnoser = BayesDiagnoser(twin, measured_armpi, priors=KNOWN_SET_UP)

    def right(factor):
        some = []
        for name, size in smallest.items():
            low = 0.9 * factor * size
            modes = {**MODES, "steady_state_error": SteadyStateError(magnitude=(low, low / 0.81))}
            some.append(simulate(Plan(armpi, faults(name)[1:], 3, 4, measured_armpi, modes=modes)))
        found = diagnoser.diagnose(xr.concat(some, "run"))
        return np.mean([d.diagnosis == d.truth for d in found])

    assert right(2.0) >= 0.9
    assert right(0.4) <= 0.2


def test_stuck_motors_of_real_motions_are_told_apart(armpi, of_real_motions):
    found = of_real_motions
    assert found.hypotheses == tuple(map(str, paper_hypotheses(armpi.motor_names)))
    assert found.groups == ()
    for by_fault in (found.detected, found.isolated, found.typical, found.largest):
        assert list(by_fault) == list(found.hypotheses[5:])
    # geometric mean of 3 and 50 servo counts
    assert np.rad2deg(list(found.typical.values())) / 0.24 == pytest.approx(np.sqrt(150.0))
    assert np.rad2deg(list(found.largest.values())) / 0.24 == pytest.approx(50.0)
    assert all(
        found.detected[name] <= found.isolated[name] < np.deg2rad(5.0) for name in found.isolated
    )


def test_a_late_motor_is_told_by_its_way_where_the_timing_is_known(twin, measured_armpi):
    hypotheses = single_faults(["motor_2"], ["lag", "slow"])
    known = isolability(twin, motion(TARGETS), TIME, measured_armpi, hypotheses)
    unknown = isolability(twin, motion(TARGETS), TIME, scattered([0.006] * 4), hypotheses)
    assert known.groups == ()
    assert ("healthy", "motor_2:lag") in [group[:2] for group in unknown.groups]


def test_losses_that_chance_may_bring_hide_a_fault_of_one_movement(twin, measured_armpi):
    names = ("motor_1:stuck", "motor_2:stuck")
    late = {"hypotheses": faults(*names), "onset_s": 7.9}
    sound = dataclasses.replace(measured_armpi, lost_commands=())
    assert (
        told(isolability(twin, motion(TARGETS), TIME, measured_armpi, **late), names[0], "healthy")
        < 4.0
    )
    assert told(isolability(twin, motion(TARGETS), TIME, sound, **late), names[0], "healthy") > 10.0


def test_groups_hold_all_that_are_alike_and_none_that_are_not():
    """Of a chain healthy - a - b, c apart, the ends are no group."""
    alike = np.zeros((3, 4), dtype=bool)
    alike[0, [0, 2]] = True
    names = ("healthy", "a", "b", "c")
    assert _groups(names, alike) == (("healthy", "a"), ("a", "b"))
    alike[1, 0] = True
    assert _groups(names, alike) == (("healthy", "a", "b"),)
    assert _groups(names, np.eye(3, 4, 1, dtype=bool)) == ()


def test_wrong_requests_are_refused(twin):
    with pytest.raises(InputError, match=r"shape \(1000, 3\), expected \(..., 1000 times, 4 motor"):
        isolability(twin, motion(TARGETS)[:, :3], TIME)
    with pytest.raises(InputError, match="never leaves its first value"):
        isolability(twin, np.zeros((1000, 4)), TIME)
    two = [Hypothesis.parse("motor_1:stuck+motor_2:stuck")]
    with pytest.raises(InputError, match="Expected healthy or one fault"):
        isolability(twin, motion(TARGETS), TIME, hypotheses=two)


def test_hypotheses_may_be_given_as_text(twin):
    texts = ["motor_1:stuck", "motor_2:stuck"]
    found = isolability(twin, motion(TARGETS), TIME, hypotheses=texts)
    assert found.hypotheses == ("healthy", *texts)
    with pytest.raises(InputError, match="unknown motor 'motor_9'"):
        isolability(twin, motion(TARGETS), TIME, hypotheses=["motor_9:stuck"])


@pytest.mark.parametrize("onset_s", [-1.0, 10.0, 50.0, np.nan])
def test_an_onset_outside_the_motion_is_refused(twin, onset_s):
    with pytest.raises(InputError, match=rf"`onset_s` is {onset_s:g} s, expected .* to 9.99 s"):
        isolability(twin, motion(TARGETS), TIME, onset_s=onset_s)


def test_the_page_prints_what_it_says(capsys):
    page = (Path(__file__).parents[2] / "docs" / "isolability.md").read_text()
    code, said = re.findall(r"```(?:python)?\n(.*?)```", page, re.DOTALL)[:2]
    exec(code, {})
    printed, expected = capsys.readouterr().out.split(), said.split()
    assert len(printed) == len(expected)
    for word, other in zip(printed, expected, strict=True):
        if re.fullmatch(r"[\d.]+", other):
            assert float(word) == pytest.approx(float(other), rel=0.02)
        else:
            assert word == other


def test_a_fault_that_is_improbable_must_be_further_ahead():
    """As often ahead of the odds against it as one of even odds is ahead: normal leads, drawn."""
    lead = np.random.default_rng(0).standard_normal(400_000)
    even = needed_nats(1.0)
    assert even == pytest.approx(FOUND_NATS)
    for odds in (4.0, 16.0, 100.0):
        needed = needed_nats(odds)
        found = np.mean(needed + np.sqrt(2.0 * needed) * lead > np.log(odds))
        assert found == pytest.approx(np.mean(even + np.sqrt(2.0 * even) * lead > 0.0), abs=2e-3)
    assert needed_nats(0.1) == pytest.approx(FOUND_NATS)
