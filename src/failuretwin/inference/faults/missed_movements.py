"""Faults that make a motor miss single movements: lost commands, sticking now and then.

What a healthy robot loses by chance is `command_loss`. Where the motor stands then is a chain: at
the target of the last movement that it made, or, if it stuck on the way, anywhere between. The
chain is summed exactly, for every movement with which the fault may have begun.

    state(m) = sum over places of state(m-1) p(stays, arrives or stops on the way) exp L_m(place)

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.numerics import Weighted, log_of, log_sum
from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.marginal import ChangePointPosterior, Estimate, MarginalLikelihood
from failuretwin.inference.faults.priors import next_movement
from failuretwin.inference.movements.run_likelihood import RunLikelihood

SHARES = 12
"""Shares of movements that are missed, to sum over."""
WAY = np.linspace(0.05, 0.95, 12)
"""Places on the way to a target at which a motor may have stuck."""


def missed_movements_likelihood(
    likelihood: RunLikelihood, motor: int, mode: str, prior_before_run: float
) -> MarginalLikelihood:
    """Return what the runs say of a motor that misses movements.

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Id of the mode, whose signature is `MISSED`.
        prior_before_run: Probability that the fault was there before the run.
    """
    sizes = _sizes(mode)
    intervals = next_movement(likelihood.evidence.movements)
    log_first = log_of(intervals.weights(prior_before_run)) - np.log(SHARES)
    after = log_densities(likelihood, motor, mode)
    found = ChangePointPosterior.of(after[:, -1] + log_first[..., None])
    share = np.exp(found.log_responsibility)
    so_far = log_sum(after + log_first[:, None, :, None], axis=(2, 3))
    by_movement = np.diff(so_far, axis=1, prepend=log_sum(log_first, axis=1)[:, None] + 0.0)

    def estimate(run: int) -> Estimate:
        onset, part = (values[run] for values in intervals.samples(prior_before_run))
        when = (share[run].sum(axis=1)[:, None] * part).ravel()
        return Estimate(
            onset=Weighted(onset.ravel(), when),
            size=Weighted(sizes, share[run].sum(axis=0)),
            outcome_probability=likelihood.outcome_probability[run],
        )

    settled = by_movement - np.maximum(
        likelihood.log_transient, likelihood.log_transient_offset(motor)
    )
    of_run = by_movement.__getitem__
    return MarginalLikelihood(found.log_evidence, of_run, settled.__getitem__, estimate)


def log_densities(likelihood: RunLikelihood, motor: int, mode: str) -> FloatArray:
    """Return the log density of all movements up to each one, (run, movement, first, size).

    Args:
        likelihood: The runs.
        motor: Index of the motor.
        mode: Id of the mode, whose signature is `MISSED`.
    """
    healthy = likelihood.log_healthy + likelihood.log_transient
    return _chain(_densities(likelihood, motor), healthy, MODES[mode].misses, _sizes(mode))


def _sizes(mode: str) -> FloatArray:
    return np.linspace(*MODES[mode].considered, SHARES)


@dataclass(frozen=True)
class _Places:
    """Log density of each movement with the motor at each place it may stand.

    Attributes:
        at: At the target of a movement made earlier, (run, movement, place); place 0 is where it
            stood before the run, place j + 1 the target of movement j.
        way: On the way from such a place to this movement's target, (run, movement, place).
    """

    at: FloatArray
    way: FloatArray


def _densities(likelihood: RunLikelihood, motor: int) -> _Places:
    movements, profile = likelihood.evidence.movements, likelihood.profile(motor)
    arrived = np.nan_to_num(profile.expected[..., 0])
    start = np.nan_to_num(movements.initial[:, motor])[:, None]
    places = np.concatenate([start, arrived], axis=1)  # (run, place)
    at = profile.log_density(places[:, None, :, None], False)
    way = places[:, None, :, None] + (arrived[:, :, None, None] - places[:, None, :, None]) * WAY
    runs, count, _, steps = way.shape
    log_transient = profile.log_density(way.reshape(runs, count, -1, 1), False)
    log_transient = log_sum(log_transient.reshape(runs, count, -1, steps), axis=3) - np.log(steps)
    arrives = np.eye(count, count + 1, 1, dtype=bool)
    held = likelihood.log_transient_stuck(motor, places)
    off = likelihood.log_transient_offset(motor)[..., None]
    return _Places(at + np.where(arrives, off, held), log_transient + held)


def _chain(
    place: _Places, log_healthy: FloatArray, misses: tuple[float, float], sizes: FloatArray
) -> FloatArray:
    """Return the log density of all movements up to each one, (run, movement, first, size).

    The state is the place of the last movement made, and one for a motor that stands on the way.
    """
    runs, count = log_healthy.shape
    stay, midway = misses[0] * sizes, misses[1] * sizes
    log_stay, log_midway = log_of(stay), log_of(midway)
    log_arrive = log_of(np.maximum(1.0 - stay - midway, 1e-6))
    first = np.arange(count)
    state = np.full((runs, count, len(sizes), count + 2), -np.inf)  # last: on the way
    out = np.empty((runs, count, count, len(sizes)))
    state[:, :, :, 0] = 0.0
    for m in range(count):
        spoilt = (first <= m)[:, None, None]
        total = log_sum(state, axis=-1)
        moved = np.full_like(state, -np.inf)
        moved[..., :-1] = state[..., :-1] + log_stay[:, None] + place.at[:, m, None, None]
        from_way = log_sum(state[..., :-1] + place.way[:, m, None, None], axis=-1)
        # Where it stuck before is not known: on the way from any place that it may have left.
        lying = log_sum(place.way[:, m, : m + 1], axis=-1)[:, None, None] - np.log(m + 1)
        moved[..., -1] = np.logaddexp(
            log_midway + from_way, np.logaddexp(log_midway, log_stay) + state[..., -1] + lying
        )
        arrives = np.where(
            spoilt[..., 0], log_arrive + total + place.at[:, m, m + 1][:, None, None], -np.inf
        )
        moved[..., m + 1] = np.logaddexp(moved[..., m + 1], arrives)
        healthy = np.full_like(state, -np.inf)
        healthy[..., m + 1] = total + log_healthy[:, m, None, None]
        state = np.where(spoilt, moved, healthy)
        out[:, m] = log_sum(state, axis=-1)
    return out
