from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.inference.faults.priors import (
    MONITORING,
    OnsetIntervals,
    OnsetPrior,
    Priors,
    next_movement,
    plateau_or_ramp,
)

lengths = st.lists(st.floats(0.0, 5.0), min_size=1, max_size=8)
earlies = st.floats(0.0, 1.0)


def stretches(parts, padding=0):
    """Return stretches of these lengths, and as many padded ones as `padding` says."""
    end = np.concatenate([np.cumsum(parts), np.full(padding, np.nan)])[None]
    begin = np.concatenate([np.zeros((1, 1)), end[:, :-1]], axis=1)
    return OnsetIntervals(begin, end)


@given(parts=lengths, early=earlies, padding=st.integers(0, 3))
def test_weights_are_probabilities(parts, early, padding):
    weights = stretches(parts, padding).weights(early)
    assert (weights >= 0.0).all()
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(weights[0, len(parts) :], 0.0)
    alone = stretches(parts).weights(early)[0]
    np.testing.assert_allclose(weights[0, : len(parts)], alone, rtol=0, atol=1e-12)


@given(parts=st.lists(st.floats(0.1, 5.0), min_size=2, max_size=8), early=earlies)
def test_what_begins_in_the_run_may_begin_at_any_time(parts, early):
    """Twice the time, twice the probability; what was there before falls to the first."""
    weights = stretches(parts).weights(early)[0]
    late = weights - early * np.eye(1, len(parts))[0]
    np.testing.assert_allclose(late, (1.0 - early) * np.array(parts) / sum(parts), atol=1e-12)


@given(parts=lengths, early=earlies)
def test_onsets_are_spread_as_their_prior_says(parts, early):
    """By all samples: the mass before the run, and the mean onset of the rest."""
    some = stretches(parts)
    onset, share = (values[0] for values in some.samples(early))
    np.testing.assert_allclose(share.sum(axis=1), 1.0, atol=1e-9)
    mass = some.weights(early)[0][:, None] * share
    total = sum(parts)
    if total == 0.0:
        assert mass[onset == 0.0].sum() == pytest.approx(1.0)
        return
    assert mass[:, 0].sum() == pytest.approx(early, abs=1e-9)
    assert np.sum(mass * onset) == pytest.approx(
        (1.0 - early) * total / 2.0, abs=1e-6 + 1e-9 * total
    )
    assert onset.min() >= 0.0
    assert onset.max() <= total * (1.0 + 1e-12)  # sum rounds otherwise from Python 3.12 on


def test_a_run_has_the_onsets_that_it_has_among_longer_ones():
    start = np.array([[0.5, 2.0, np.nan], [0.0, 2.0, 4.0]])
    movements = Movements(np.zeros((2, 1)), np.zeros((2, 3, 1)), np.full((2, 3, 1), 0.5), start)
    found = next_movement(movements)
    np.testing.assert_allclose(found.weights(0.4), [[0.4 + 0.15, 0.45, 0.0], [0.4, 0.3, 0.3]])
    onset, share = (values[0] for values in found.samples(0.4))
    assert np.isfinite(onset).all()
    assert np.isfinite(share).all()


def test_a_motor_may_get_stuck_on_a_plateau_or_a_ramp():
    """Ramps at 1 to 2 s and 5 to 7 s: 3 s of plateau and 2 s of ramp come after the first ramp."""
    found = plateau_or_ramp(np.array([[1.0, 5.0, np.nan]]), np.array([[2.0, 7.0, np.nan]]))
    wanted = [[[0.2, 0.2], [0.36, 0.24], [0.0, 0.0]]]
    np.testing.assert_allclose(found.weights(0.4), wanted, atol=1e-12)
    for onset_s, where in ((0.0, (0, 0)), (1.5, (0, 1)), (2.0, (1, 0)), (6.9, (1, 1)), (9, (2, 1))):
        assert [tuple(i) for i in np.argwhere(found.holding(onset_s)[0])] == [where]


def test_modes_have_their_own_share_before_the_run():
    """What wears out was there before; a motor may well get stuck in the run."""
    usual, told = OnsetPrior(), OnsetPrior(prior_before_run=0.25)
    assert (usual.before_run("backlash"), usual.before_run("stuck")) == (0.9, 0.5)
    assert {told.before_run(mode) for mode in ("backlash", "stuck")} == {0.25}


def test_usual_beliefs():
    """Sizes of errors come from the robot."""
    assert Priors().error_ranges is None
    assert (Priors().healthy_odds, MONITORING.healthy_odds) == (1.0, 30.0)
    assert (Priors().onset.free, Priors().onset.known_s) == (0.2, None)


@pytest.mark.parametrize(
    ("kind", "values", "match"),
    [
        (OnsetPrior, {"known_s": -1.0}, "known_s is -1, expected 0 or more"),
        (OnsetPrior, {"known_s": np.nan}, "known_s is nan"),
        (OnsetPrior, {"prior_before_run": 1.5}, "expected a probability"),
        (OnsetPrior, {"free": -0.1}, "expected a probability"),
        (Priors, {"error_ranges": ()}, "expected pairs 0 <= low < high"),
        (Priors, {"error_ranges": ((0.2, 0.1),)}, "expected pairs"),
        (Priors, {"healthy_odds": 0.0}, "expected above 0"),
    ],
)
def test_beliefs_that_make_no_sense_are_refused(kind, values, match):
    with pytest.raises(InputError, match=match):
        kind(**values)
