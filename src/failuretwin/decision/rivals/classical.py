"""Classifiers without networks: nearest simulation, gradient boosting, random convolutions.

Each takes X of shape (run, 100 times channel), or (run, 100, channel), and follows scikit-learn.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from failuretwin.core.types import FloatArray
from failuretwin.decision.learned.feature_encoder import POINTS

SEGMENTS = 20
"""Parts of a run whose means and ranges gradient boosting sees: 0.5 s each of ten seconds."""


def series_of(features: ArrayLike) -> FloatArray:
    """Return features as (run, point, channel)."""
    array = np.asarray(features, dtype=np.float64)
    return array if array.ndim == 3 else array.reshape(len(array), POINTS, -1)


class _Fitted(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A classifier of transformed runs; subclasses say which and how."""

    def __init__(self, random_state: int = 0) -> None:
        self.random_state = random_state

    def _model(self) -> Any:
        raise NotImplementedError

    def _transformed(self, series: FloatArray, fresh: bool) -> FloatArray:
        return series.reshape(len(series), -1)

    def fit(self, X: ArrayLike, y: ArrayLike) -> _Fitted:
        """Learn from labelled runs."""
        self.model_ = self._model().fit(self._transformed(series_of(X), True), y)
        self.classes_: NDArray[Any] = self.model_.classes_
        return self

    def predict_proba(self, X: ArrayLike) -> FloatArray:
        """Return the probability of each class, (run, class)."""
        return np.asarray(self.model_.predict_proba(self._transformed(series_of(X), False)))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return the most probable class of each run."""
        return np.asarray(self.classes_[self.predict_proba(X).argmax(axis=1)])


class NearestSimulation(_Fitted):
    """The classes of the nearest simulated runs, weighted by their inverse distance."""

    NEIGHBOURS = 10

    def _model(self) -> Pipeline:
        nearest = KNeighborsClassifier(self.NEIGHBOURS, weights="distance")
        return make_pipeline(StandardScaler(), nearest)


class GradientBoosting(_Fitted):
    """Gradient-boosted trees on mean, range and last value of each part of a run."""

    def _model(self) -> HistGradientBoostingClassifier:
        return HistGradientBoostingClassifier(
            max_iter=150, max_features=0.1, random_state=self.random_state
        )

    def _transformed(self, series: FloatArray, fresh: bool) -> FloatArray:
        parts = series.reshape(len(series), SEGMENTS, -1, series.shape[2])
        seen = (parts.mean(axis=2), np.ptp(parts, axis=2), parts[:, :, -1])
        return np.concatenate([one.reshape(len(series), -1) for one in seen], axis=1)


class MiniRocket(_Fitted):
    """Random convolutions of a fixed set of kernels (Dempster, Schmidt & Webb, KDD 2021).

    All 84 kernels of length 9 with three weights of 2 and six of -1, dilated; the feature is the
    share of values above a bias that is a quantile of the training runs' own convolutions. Each
    kernel sees a random subset of the channels. Logistic regression on top, for probabilities.
    """

    KERNELS = tuple(combinations(range(9), 3))
    DILATIONS = (1, 2, 4, 8)
    QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)

    def _model(self) -> Pipeline:
        return make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=300))

    def _transformed(self, series: FloatArray, fresh: bool) -> FloatArray:
        if fresh:
            rng = np.random.default_rng(self.random_state)
            self.mean_, spread = series.mean(axis=(0, 1)), series.std(axis=(0, 1))
            self.spread_ = np.where(spread > 0.0, spread, 1.0)
            count = len(self.DILATIONS) * len(self.KERNELS)
            sizes = rng.integers(1, min(series.shape[2], 9) + 1, count)
            self.channels_ = [rng.permutation(series.shape[2])[:size] for size in sizes]
            self.biases_: list[FloatArray] = []
        standard = (series - self.mean_) / self.spread_
        features = []
        for number, convolved in enumerate(self._convolved(standard)):
            if fresh:
                self.biases_.append(np.quantile(convolved, self.QUANTILES))
            above = [(convolved > bias).mean(axis=1) for bias in self.biases_[number]]
            features.append(np.stack(above, axis=1))
        return np.concatenate(features, axis=1)

    def _convolved(self, series: FloatArray) -> Any:
        """Yield each kernel's convolution, (run, point)."""
        number = 0
        for dilation in self.DILATIONS:
            reach = 4 * dilation
            padded = np.pad(series, ((0, 0), (reach, reach), (0, 0)))
            length = series.shape[1]
            taps = [padded[:, k * dilation : k * dilation + length] for k in range(9)]
            whole = np.sum(taps, axis=0)
            for kernel in self.KERNELS:
                chosen = self.channels_[number]
                three = sum(taps[k][..., chosen].sum(axis=2) for k in kernel)
                yield 3.0 * three - whole[..., chosen].sum(axis=2)
                number += 1
