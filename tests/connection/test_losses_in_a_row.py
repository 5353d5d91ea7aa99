from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failuretwin.inference.observation.command_loss import ConsecutiveLossHmm

SETS = [s for size in (1, 2) for s in combinations(range(3), size)]
MOVEMENTS = 4


def losses_of(sets):
    """Return which motors each loss hits, (loss, motor); the first hits none."""
    return np.array([np.isin(range(3), motors) for motors in ((), *sets)])


def rates_of(sets, seed):
    """Return rates that differ from movement to movement, (1, movement, loss)."""
    lost = np.random.default_rng(seed).uniform(0.02, 0.25, (1, MOVEMENTS, len(sets)))
    return np.concatenate([1.0 - lost.sum(axis=-1, keepdims=True), lost], axis=-1)


def histories(losses, rates):
    """Yield every sequence of losses: its states, a tuple for each movement, and its chances."""
    for sequence in product(range(len(losses)), repeat=MOVEMENTS):
        missed, states = np.zeros(3, dtype=int), []
        for loss in sequence:
            missed = np.where(losses[loss], missed + 1, 0)
            states.append(tuple(missed.tolist()))
        yield states, [rates[0, m, loss] for m, loss in enumerate(sequence)]


@settings(max_examples=20)
@given(
    sets=st.lists(st.sampled_from(SETS), min_size=1, max_size=3, unique=True),
    seed=st.integers(0, 1000),
)
def test_chances_are_those_of_all_histories(sets, seed):
    """State by state, as far as those that were left out leave them alone."""
    losses, rates = losses_of(sets), rates_of(sets, seed)
    chain = ConsecutiveLossHmm.of(losses, rates[0].max(axis=0), 1e-4)
    known = [tuple(missed) for missed in chain.missed.tolist()]
    exact = [dict.fromkeys(known, 0.0) for _ in range(MOVEMENTS)]
    left_out = np.zeros(MOVEMENTS)
    for states, chances in histories(losses, rates):
        share = float(np.prod(chances))
        for m in range(MOVEMENTS):
            if any(state not in exact[m] for state in states[: m + 1]):
                left_out[m] += share
            else:
                exact[m][states[m]] += share
    got = chain.forward(rates)[0]
    np.testing.assert_allclose(got.sum(axis=-1), 1.0, rtol=1e-12)
    for m in range(MOVEMENTS):
        more = got[m] - [exact[m][state] for state in known]
        assert more.min() > -1e-12
        assert more.sum() == pytest.approx(left_out[m], abs=1e-12)


@settings(max_examples=20)
@given(
    sets=st.sampled_from([[(0,)], [(0,), (1,)], [(0,), (0, 1)]]),
    seed=st.integers(0, 1000),
)
def test_what_was_seen_counts_as_bayes_says(sets, seed):
    """Given all before, a state has its share of all histories, weighed by what was seen."""
    losses, rates = losses_of(sets), rates_of(sets, seed)
    chain = ConsecutiveLossHmm.of(losses, np.append(1.0, np.full(len(sets), 0.3)), 1e-6)
    known = [tuple(missed) for missed in chain.missed.tolist()]
    says = 3.0 * np.random.default_rng(seed).standard_normal((1, MOVEMENTS, len(known)))
    joint = np.zeros((MOVEMENTS, len(known)))
    for states, chances in histories(losses, rates):
        at = [known.index(state) for state in states]  # all are there: MOVEMENTS is few
        for m in range(MOVEMENTS):
            seen = np.exp(sum(says[0, i, at[i]] for i in range(m)))
            joint[m, at[m]] += np.prod(chances) * seen
    expected = joint / joint.sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(chain.forward(rates, says)[0], expected, rtol=1e-9, atol=1e-15)


def test_evidence_that_says_nothing_changes_nothing():
    sets = [(0,), (0, 1)]
    losses, rates = losses_of(sets), rates_of(sets, 7)
    chain = ConsecutiveLossHmm.of(losses, rates[0].max(axis=0), 1e-4)
    silent = np.full((1, MOVEMENTS, len(chain.missed)), -700.0)
    np.testing.assert_allclose(chain.forward(rates, silent), chain.forward(rates), rtol=1e-12)


def test_one_motor_misses_as_many_in_a_row_as_are_not_too_rare():
    chain = ConsecutiveLossHmm.of(losses_of([(0,)]), np.array([0.9, 0.1]), 0.9e-3)
    assert chain.missed[:, 0].tolist() == [0, 1, 2, 3]
    missed = chain.forward(np.full((1, 9, 2), [0.9, 0.1]))[0, -1]
    # The last state holds three or more in a row.
    np.testing.assert_allclose(missed, [0.9, 0.09, 0.009, 0.001], rtol=1e-12)


def test_pairs_that_hardly_happen_do_not_take_the_place_of_long_rows():
    """Three motors that lose one command in six, pairs of them only if all is late, as if never."""
    losses = losses_of(SETS)
    usual = np.array([0.5, *[1.0 / 6.0] * 3, *[1e-5] * 3])
    most = np.array([0.5, *[1.0 / 6.0] * 3, *[0.05] * 3])
    chain = ConsecutiveLossHmm.of(losses, usual, 1e-6, most)
    assert len(chain.missed) == 48
    assert (chain.missed.max(axis=0) >= 6).all()
    by_their_highest = ConsecutiveLossHmm.of(losses, most, 1e-6)
    assert by_their_highest.missed.max() < chain.missed.max()
    rates = np.broadcast_to(usual, (1, 12, len(usual)))
    chances, six = chain.forward(rates)[0, -1], chain.missed[:, 0] >= 6
    assert chances[six].sum() == pytest.approx((1.0 / 6.0) ** 6, rel=0.01)


def test_chains_end_although_losses_are_certain():
    chain = ConsecutiveLossHmm.of(losses_of([(0,), (1,)]), np.array([0.0, 1.0, 1.0]), 1e-4)
    assert len(chain.missed) == 48


def test_what_is_impossible_is_not_made_probable_by_what_was_seen():
    """Nobody has missed two commands with the first movement, whatever it looks like."""
    chain = ConsecutiveLossHmm.of(losses_of([(0,)]), np.array([0.9, 0.1]), 1e-3)
    looks = np.zeros((1, 2, len(chain.missed)))
    looks[:, 0, 2] = 1e4
    found = chain.forward(np.full((1, 2, 2), [0.9, 0.1]), looks)
    np.testing.assert_allclose(found[0, 1, :3], [0.9, 0.09, 0.01], rtol=1e-12)
