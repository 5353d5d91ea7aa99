"""Probabilities of two witnesses as one: blended or gated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray, IntArray

LEAST = 1e-300
"""Probabilities that have underflowed count as this, so that a logarithm of them exists."""


@dataclass(frozen=True)
class Weights:
    """How much the log probability of each part counts; 1 and 0: the first part alone."""

    bayes: float
    network: float


def blended(bayes: FloatArray, network: FloatArray, weights: Weights) -> FloatArray:
    """Return the weighted product of probabilities (run, class), normalised."""
    logs = weights.bayes * _log(bayes) + weights.network * _log(network)
    chances = np.exp(logs - logs.max(axis=1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=1, keepdims=True))


def gated(bayes: FloatArray, network: FloatArray, healthy: int) -> FloatArray:
    """Return probabilities (run, class): of healthy by the first, of faults by the second.

    Args:
        bayes: (run, class).
        network: (run, class).
        healthy: Number of the healthy class.
    """
    faults = np.maximum(network, LEAST)
    faults[:, healthy] = 0.0
    rest = 1.0 - bayes[:, [healthy]]
    chances = rest * faults / faults.sum(axis=1, keepdims=True)
    chances[:, healthy] = bayes[:, healthy]
    return chances


def fit_weights(bayes: FloatArray, network: FloatArray, truth: IntArray) -> Weights:
    """Return the weights at which the truth surprises a blend least.

    Args:
        bayes: Probabilities of simulated runs by the model, (run, class).
        network: The same by the network.
        truth: Number of the true class, (run,).
    """
    from scipy.optimize import minimize

    runs = np.arange(len(truth))

    def surprise(values: FloatArray) -> float:
        made = blended(bayes, network, Weights(*values))
        return float(-_log(made)[runs, truth].mean())

    best = minimize(surprise, np.array([0.5, 0.5]), bounds=[(0.0, 3.0)] * 2)
    return Weights(*(float(value) for value in best.x))


def _log(chances: FloatArray) -> FloatArray:
    return np.log(np.maximum(chances, LEAST))
