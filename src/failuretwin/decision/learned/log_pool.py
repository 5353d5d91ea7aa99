"""Bayesian diagnosis combined with a network: logarithmic opinion pool, or gate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.diagnoser import Diagnoser
from failuretwin.inference.explanation import worded

if TYPE_CHECKING:
    import xarray as xr

HEALTHY = "healthy"
SIZED = ("onset_s", "onset_90", "magnitude", "magnitude_unit", "magnitude_90")
"""Fields that belong to the fault that a diagnosis names."""
LEAST = 1e-300
"""Lower bound of probabilities before their logarithm."""


@dataclass(frozen=True)
class PoolWeights:
    """Weights of the log probabilities of both parts."""

    bayes: float
    network: float


def log_pool(bayes: FloatArray, network: FloatArray, weights: PoolWeights) -> FloatArray:
    """Return p ~ p_bayes^w_bayes p_network^w_network, (run, class), normalised."""
    from scipy.special import softmax

    return softmax(weights.bayes * _log(bayes) + weights.network * _log(network), axis=1)


def gated(bayes: FloatArray, network: FloatArray, healthy: int) -> FloatArray:
    """Return P(healthy) by Bayes, shared among faults as the network does, (run, class)."""
    faults = np.maximum(network, LEAST)
    faults[:, healthy] = 0.0
    rest = 1.0 - bayes[:, [healthy]]
    chances = rest * faults / faults.sum(axis=1, keepdims=True)
    chances[:, healthy] = bayes[:, healthy]
    return chances


def fit_pool_weights(bayes: FloatArray, network: FloatArray, truth: IntArray) -> PoolWeights:
    """Return the weights with the best mean log score.

    Takes the probabilities of both parts, (run, class), and the true class index, (run,).
    """
    from scipy.optimize import minimize

    runs = np.arange(len(truth))

    def log_score(values: FloatArray) -> float:
        pooled = log_pool(bayes, network, PoolWeights(*values))
        return float(-_log(pooled)[runs, truth].mean())

    best = minimize(log_score, np.array([0.5, 0.5]), bounds=[(0.0, 3.0)] * 2)
    return PoolWeights(*(float(value) for value in best.x))


def _log(chances: FloatArray) -> FloatArray:
    return np.log(np.maximum(chances, LEAST))


@dataclass(frozen=True)
class HybridDiagnoser:
    """Combination of the Bayesian diagnosis and a network.

    Attributes:
        bayes: Bayesian diagnoser; without its verdict the result has none.
        network: Learned diagnoser with the same classes.
        weights: Weights of the pool; None: gate.
        arm_class: Kind of arm, for advice; empty: unknown.
    """

    bayes: Diagnoser
    network: Diagnoser
    weights: PoolWeights | None = None
    arm_class: str = ""

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run of a run set.

        Onset and size are those of the Bayesian part, or of the network if that alone names the
        fault.

        Raises:
            InputError: If the parts have different classes.
        """
        pairs = zip(self.bayes.diagnose(runs), self.network.diagnose(runs), strict=True)
        return [self._joined(first, second) for first, second in pairs]

    def _joined(self, bayes: Diagnosis, network: Diagnosis) -> Diagnosis:
        if bayes.undecided:
            return bayes
        if set(bayes.posterior) != set(network.posterior):
            raise InputError(
                f"the parts know different classes: {', '.join(bayes.posterior)} and "
                f"{', '.join(network.posterior)}."
            )
        classes = list(bayes.posterior)
        first, second = (np.array([[d.posterior[c] for c in classes]]) for d in (bayes, network))
        if self.weights is None:
            chances = gated(first, second, classes.index(HEALTHY))[0]
        else:
            chances = log_pool(first, second, self.weights)[0]
        joined = replace(
            bayes,
            posterior=dict(zip(classes, chances.tolist(), strict=True)),
            evidence=(),
            protocol=max(bayes.protocol, network.protocol),
            method=f"{'gated' if self.weights is None else 'blended'}: {bayes.method} with "
            f"{network.method}",
        )
        if joined.diagnosis != bayes.diagnosis:
            named = joined.diagnosis == network.diagnosis
            sized: dict[str, Any] = {n: getattr(network, n) if named else None for n in SIZED}
            joined = replace(joined, **sized)
        ranked = [Hypothesis.parse(name) for name in joined.ranked]
        return worded(joined, ranked, arm_class=self.arm_class)
