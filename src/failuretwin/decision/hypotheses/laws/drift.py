"""Drift: a motor that slips away from its targets at a constant rate, from an unknown onset on."""

from __future__ import annotations

import numpy as np

from failuretwin.core.quadrature import log_of, log_sum, weighted_quantiles
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import magnitude_range
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.law import Law
from failuretwin.decision.hypotheses.laws.nodes import pointed, size_nodes
from failuretwin.decision.hypotheses.onsets import Stretches, at_once

CELLS = 3
"""Parts of a stretch, each with one onset to sum over."""
ONSETS = (np.arange(CELLS) + 0.5) / CELLS
"""Those onsets, as shares of its length."""
WITHIN = np.linspace(-0.4, 0.4, 5) / CELLS
"""Where in its part an onset may be, beside its middle, as shares of the length of the stretch."""


def drift_law(scene: Scene, motor: int, early: float) -> Law:
    """Return the law of a motor that slips away from its targets at a constant rate.

    Args:
        scene: The runs.
        motor: Index of the motor.
        early: Probability that it slips from the start of the run.
    """
    middle = np.nan_to_num(0.5 * (scene.evidence.begin + scene.evidence.end))
    settled = scene.profile(motor).beside
    rate, log_rate = _rates(scene, motor, settled, middle)
    stretches = at_once(scene.evidence)
    onset, log_onset = _onsets(stretches, early)  # (run, movement, onset)
    length = np.nan_to_num(stretches.end - stretches.begin)[..., None] * np.ones_like(onset)
    length[..., 0] = 0.0  # before the run is no stretch of it
    runs, movements, onsets = onset.shape
    since = np.maximum(middle[:, :, None] - onset.reshape(runs, 1, -1), 0.0)
    # A node is an onset and a rate; each onset belongs to one movement that it spoils first.
    offset = (since[..., None] * rate[:, None, None]).reshape(runs, movements, -1)
    own = np.repeat(np.eye(movements), onsets, axis=1)
    log_first = log_of(own) + log_onset.reshape(runs, 1, -1)
    log_prior = (log_first[..., None] + log_rate[:, None, None]).reshape(runs, movements, -1)
    rates = rate.shape[1]

    def of_run(run: int) -> tuple[FloatArray, FloatArray]:
        at = onset[run][..., None] + length[run][..., None] * WITHIN
        return (
            np.repeat(at.reshape(1, -1, len(WITHIN)), rates, axis=1),
            np.full((1, 1, len(WITHIN)), 1.0 / len(WITHIN)),
        )

    return Law(
        motor=motor,
        held=False,
        angle=settled[:, :, None] + offset[..., None],
        log_prior=log_prior,
        size=np.tile(rate, (1, movements * onsets)),
        onsets=of_run,
    )


def _rates(
    scene: Scene, motor: int, settled: FloatArray, since: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rates, sorted, and the log of their prior, (run, rate) each.

    They crowd where the movements together point if the motor slips from the start of the run.

    Args:
        scene: The runs.
        motor: Index of the motor.
        settled: Where it settles apart from what has slipped, (run, movement, alternative) [rad].
        since: For how long it has slipped then, (run, movement) [s].
    """
    profile = scene.profile(motor)
    best, width = pointed(profile, settled[..., 0], since)
    weight = np.where(profile.usable & (since > 0.0), 1.0 / width**2, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    some = np.asarray(total > 0.0)
    together = weighted_quantiles(best, weight, (0.5,))
    spread = 1.0 / np.sqrt(np.where(some, total, 1.0))
    return size_nodes(together, spread, some, magnitude_range("drift"), signed=True)


def _onsets(stretches: Stretches, early: float) -> tuple[FloatArray, FloatArray]:
    """Return onsets [s] and their log prior, (run, movement, onset); the first is the start."""
    begin, end = np.nan_to_num(stretches.begin), np.nan_to_num(stretches.end)
    inside = begin[..., None] + ONSETS * (end - begin)[..., None]
    weight = stretches.weights(early)
    late = weight.copy()
    late[:, 0] = np.maximum(late[:, 0] - early, 0.0)
    before = weight - late
    onset = np.concatenate([np.zeros_like(inside[..., :1]), inside], axis=-1)
    shares = np.concatenate(
        [before[..., None], np.repeat(late[..., None] / len(ONSETS), len(ONSETS), -1)],
        axis=-1,
    )
    log_shares = log_of(shares)
    return onset, log_shares - log_sum(log_shares, axis=(1, 2))[:, None, None]
