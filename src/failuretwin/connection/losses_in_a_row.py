"""How many commands in a row each motor has missed: a chain from movement to movement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray

MOST_STATES = 24
"""States of a chain beyond which no more are added; what is left out is the rarest."""


@dataclass(frozen=True)
class LossesInARow:
    """A chain: with each movement some motors miss one command more, the others none any longer.

    Attributes:
        missed: Commands that each motor has missed in a row in each state, (state, motor); none in
            the first.
        leads: 1 where a loss (0: of none) leads from a state to a state, (loss, state, state).
    """

    missed: IntArray
    leads: FloatArray

    @staticmethod
    def of(losses: BoolArray, chance: FloatArray, rare: float) -> LossesInARow:
        """Return the chain of the states that are not too rare, single losses first.

        What is left out counts as fewer losses in a row.

        Args:
            losses: Motors that each loss hits, (loss, motor); the first hits none.
            chance: Highest probability of each, (loss,).
            rare: Losses in a row that are less probable are left out.
        """
        states = _states(losses, chance, rare)
        leads = np.zeros((len(losses), len(states), len(states)))
        for i, loss in enumerate(losses):
            for j, state in enumerate(states):
                leads[i, j, states.index(_known(_one_more(state, loss), states))] = 1.0
        return LossesInARow(np.array(states), leads)

    def chances(self, rates: FloatArray, log_likelihood: FloatArray | None = None) -> FloatArray:
        """Return the probability of each state with each movement, (run, movement, state).

        Args:
            rates: Probability of each loss, (run, movement, loss).
            log_likelihood: What was seen says of each state, (run, movement, state); each movement
                is then given all that was seen before it. None: nothing was seen.
        """
        runs, count, _ = rates.shape
        chances = np.empty((runs, count, len(self.missed)))
        state = np.zeros((runs, len(self.missed)))
        state[:, 0] = 1.0
        for m in range(count):
            chances[:, m] = state = np.einsum("rl,rd,lds->rs", rates[:, m], state, self.leads)
            if log_likelihood is not None:
                says = np.where(state > 0.0, log_likelihood[:, m], -np.inf)
                state = state * np.exp(says - says.max(axis=-1, keepdims=True))
                state = state / state.sum(axis=-1, keepdims=True)
        return chances


def _states(losses: BoolArray, chance: FloatArray, rare: float) -> list[tuple[int, ...]]:
    """Return the states that are not too rare, from few losses in a row to many."""
    none = (0,) * losses.shape[1]
    newest = {_one_more(none, loss): float(p) for loss, p in zip(losses, chance, strict=True)}
    found = list(newest)
    while newest:
        longer: dict[tuple[int, ...], float] = {}
        for state, before in newest.items():
            for loss, now in zip(losses, chance, strict=True):
                missed = _one_more(state, loss)
                if missed not in found:
                    longer[missed] = longer.get(missed, 0.0) + before * float(now)
        ranked = sorted((p, missed) for missed, p in longer.items() if p > rare)[::-1]
        newest = {missed: p for p, missed in ranked[: max(MOST_STATES - len(found), 0)]}
        found += newest
    return found


def _one_more(missed: tuple[int, ...], loss: BoolArray) -> tuple[int, ...]:
    """Return how many commands in a row the motors have missed after one more loss."""
    return tuple(n + 1 if hit else 0 for n, hit in zip(missed, loss, strict=True))


def _known(missed: tuple[int, ...], states: list[tuple[int, ...]]) -> tuple[int, ...]:
    """Return the state of `states` that comes nearest: with fewer losses in the longest row."""
    while missed not in states:
        longest = max(missed)
        missed = tuple(n - 1 if n == longest else n for n in missed)
    return missed
