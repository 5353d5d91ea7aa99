"""What became of a robot over its runs: faults that stay until they are repaired.

A hidden Markov chain over the runs in their order. Its states are the hypotheses; a run's
likelihood of a state is its posterior over its prior:

    p(s_1) = prior,    p(s_i | s_i-1): a healthy robot fails with rate a, to h by its prior odds;
                       a fault stays but for a rate r, by which it is repaired; by then the robot
                       may have failed anew, by another fault

forward-backward gives p(s_i | all runs), Viterbi the course that is told. Each run keeps its own
size and onset: that these stay too is not used.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.explanation import percent, plain_name

FAULT_RATE, REPAIR_RATE = 0.02, 0.02
"""Share of runs before which a healthy robot fails, and a faulty one is repaired; assumed."""
LEAST = 1e-300
"""Probability that stands for none, so that no run forbids a state for ever."""


EVEN = 0.5
"""A course that is less probable than its opposite is no verdict."""


@dataclass(frozen=True)
class Episode:
    """Some runs in a row in which one hypothesis holds.

    Attributes:
        hypothesis: What is the case.
        first: Index of the first run.
        last: Index of the last.
        probability: That it is the case in the last.
        first_90: 90 % interval of the index of the first run.
    """

    hypothesis: Hypothesis
    first: int
    last: int
    probability: float
    first_90: tuple[int, int]


@dataclass(frozen=True)
class FaultCourse:
    """The state of a robot from run to run.

    Attributes:
        runs: Names of the runs in their order.
        hypotheses: What may be the case.
        log_prior: (hypothesis,).
        log_likelihood: Of each run, up to a constant, (run, hypothesis).
    """

    runs: Sequence[str]
    hypotheses: Sequence[Hypothesis]
    log_prior: FloatArray
    log_likelihood: FloatArray

    @classmethod
    def of(cls, diagnoses: Sequence[Diagnosis], prior: FloatArray | None = None) -> FaultCourse:
        """Return the course of a robot from the diagnoses of its runs.

        Runs that allow no verdict say nothing.

        Args:
            diagnoses: Of its runs, the oldest first.
            prior: Probabilities that each run was judged with, (hypothesis,), in the order of its
                posterior; None: all alike.

        Raises:
            InputError: If there is no run, or runs were judged by other hypotheses.
        """
        if not diagnoses or any(
            d.posterior.keys() != diagnoses[0].posterior.keys() for d in diagnoses
        ):
            raise InputError(
                "a course needs diagnoses of one run at least, all with the same hypotheses."
            )
        names = list(diagnoses[0].posterior)
        even = np.full(len(names), 1.0 / len(names))
        log_prior = log_of(even if prior is None else prior)
        posterior = np.array([[d.posterior[name] for name in names] for d in diagnoses])
        decided = np.array([not d.undecided for d in diagnoses])
        told = np.where(decided[:, None], log_of(np.maximum(posterior, LEAST)) - log_prior, 0.0)
        return cls([d.run for d in diagnoses], [*map(Hypothesis.parse, names)], log_prior, told)

    @cached_property
    def _log_step(self) -> FloatArray:
        """Log probability of the next state, (state, next)."""
        healthy = np.array([h.is_healthy for h in self.hypotheses])
        odds = np.where(healthy, 0.0, np.exp(self.log_prior))
        failing = FAULT_RATE * odds / max(float(odds.sum()), LEAST)
        sound = failing + np.where(healthy, 1.0 - FAULT_RATE, 0.0)
        stays = np.eye(len(healthy))
        repaired = sound * (1.0 - stays)
        repaired /= np.maximum(repaired.sum(axis=1, keepdims=True), LEAST)
        faulty = (1.0 - REPAIR_RATE) * stays + REPAIR_RATE * repaired
        return log_of(np.where(healthy[:, None], sound, faulty))

    @cached_property
    def _forward(self) -> FloatArray:
        """Log p(runs up to i, s_i), (run, state)."""
        rows = [self.log_prior + self.log_likelihood[0]]
        for says in self.log_likelihood[1:]:
            rows.append(log_sum(rows[-1][:, None] + self._log_step, axis=0) + says)
        return np.stack(rows)

    @cached_property
    def _backward(self) -> FloatArray:
        """Log p(runs after i | s_i), (run, state)."""
        rows = [np.zeros(len(self.hypotheses))]
        for says in self.log_likelihood[:0:-1]:
            rows.append(log_sum(self._log_step + (says + rows[-1]), axis=1))
        return np.stack(rows[::-1])

    @property
    def log_evidence(self) -> float:
        """Log probability of all runs, up to the constant of their likelihoods."""
        return float(log_sum(self._forward[-1], axis=0))

    @cached_property
    def posterior(self) -> FloatArray:
        """Probability of each state given all runs, (run, state)."""
        return np.exp(self._forward + self._backward - self.log_evidence)

    @cached_property
    def path(self) -> IntArray:
        """Most probable sequence of states, (run,)."""
        height, back = self.log_prior + self.log_likelihood[0], []
        for says in self.log_likelihood[1:]:
            reached = height[:, None] + self._log_step
            back.append(reached.argmax(axis=0))
            height = reached.max(axis=0) + says
        states = [int(height.argmax())]
        for chosen in reversed(back):
            states.append(int(chosen[states[-1]]))
        return np.array(states[::-1])

    def _begun(self, state: int) -> FloatArray:
        """Return the probability that a state begins with each run, (run,)."""
        others = np.arange(len(self.hypotheses)) != state
        first = self.posterior[:1, state]
        came = self._forward[:-1, others, None] + self._log_step[others][:, [state]]
        came = log_sum(came, axis=(1, 2)) + self.log_likelihood[1:, state]
        return np.concatenate([first, np.exp(came + self._backward[1:, state] - self.log_evidence)])

    @cached_property
    def episodes(self) -> list[Episode]:
        """What was the case, one episode after the other."""
        edges = np.flatnonzero(np.diff(self.path)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(self.path)]
        return [self._episode(a, b - 1) for a, b in zip(starts, stops, strict=True)]

    def _episode(self, first: int, last: int) -> Episode:
        state = int(self.path[first])
        before = np.flatnonzero(self.path[:first] == state)
        since = int(before[-1]) + 1 if len(before) else 0
        runs = np.arange(since, last + 1)
        weight = self._begun(state)[runs]
        share = np.cumsum(weight) / max(float(weight.sum()), LEAST)
        low, high = (int(runs[np.argmax(share >= level)]) for level in (0.05, 0.95))
        told = float(self.posterior[last, state])
        return Episode(self.hypotheses[state], first, last, told, (low, high))

    @property
    def verdict(self) -> tuple[str, ...]:
        """The course in plain sentences, one for each fault; one if there was none."""
        faulty = [e for e in self.episodes if not e.hypothesis.is_healthy]
        if faulty:
            return tuple(self._sentence(episode) for episode in faulty)
        healthy = self.path[0]
        least = float(self.posterior[:, healthy].min())
        sure = percent(least)
        if least < EVEN:
            return (f"cannot tell, because healthy {self._in_all} is only {sure} sure",)
        return (f"healthy {self._in_all}, {sure} sure",)

    @property
    def _in_all(self) -> str:
        count = len(self.runs)
        return "in the one run" if count == 1 else f"in all {counted(count, 'run')}"

    def _sentence(self, episode: Episode) -> str:
        count, first, last = len(self.runs), episode.first + 1, episode.last + 1
        low, high = (end + 1 for end in episode.first_90)
        when = self._in_all
        if first > 1 or last < count:
            when = f"in runs {first} to {last} of {count}" if last > first else f"in run {first}"
        if first > 1:
            if last == count:
                when = f"since run {first} of {count} ({self.runs[episode.first]})"
            if low < high:
                when += f", at the earliest run {low}, at the latest {high}"
        ended = "" if last == count else ", not any more since"
        name = plain_name(episode.hypothesis)
        return f"{name} {when}{ended}, {percent(episode.probability)} sure"
