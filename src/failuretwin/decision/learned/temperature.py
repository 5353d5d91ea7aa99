"""From scores to probabilities that mean what they say."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray, IntArray

RANGE = (0.05, 20.0)
"""Temperatures worth trying."""


def log_probabilities(scores: FloatArray, temperature: float) -> FloatArray:
    """Return the logarithm of the probability of each class, (run, class)."""
    scaled = scores / temperature
    scaled = scaled - scaled.max(axis=1, keepdims=True)
    return np.asarray(scaled - np.log(np.exp(scaled).sum(axis=1, keepdims=True)))


def probabilities(scores: FloatArray, temperature: float) -> FloatArray:
    """Return the probability of each class, (run, class)."""
    return np.exp(log_probabilities(scores, temperature))


def best_temperature(scores: FloatArray, truth: IntArray) -> float:
    """Return the temperature at which the truth surprises least (Guo et al., ICML 2017).

    Args:
        scores: (run, class).
        truth: Number of the true class, (run,).
    """
    from scipy.optimize import minimize_scalar

    runs = np.arange(len(truth))

    def surprise(log_temperature: float) -> float:
        return float(-log_probabilities(scores, np.exp(log_temperature))[runs, truth].mean())

    low, high = np.log(RANGE)
    return float(np.exp(minimize_scalar(surprise, bounds=(low, high), method="bounded").x))
