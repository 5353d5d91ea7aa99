"""A network as a diagnoser and as a scikit-learn estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_softmax, softmax
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils import check_random_state
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.movements import find_movements
from failuretwin.core.runs import check_motors, check_runs, truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.decision.learned.feature_encoder import (
    POINTS,
    SHARED,
    FeatureEncoder,
    Floats,
    signals_of,
)
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.networks import (
    Batch,
    Shape,
    Standard,
    build_network,
    scores_of,
    shuffled_batches,
    training,
)
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import worded
from failuretwin.inference.observation.log_quality import LogQuality, drop_invalid, log_quality
from failuretwin.inference.observation.settings import InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

Estimate = Mapping[str, Any]
"""Onset and size of the likeliest fault, as fields of `Diagnosis`; empty where not known."""
Runs = Any
"""A run set, or an array of features: (run, point, channel), or (run, channel) of one point."""


class NetworkDiagnoser(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """What diagnosers by networks share: probabilities, temperature, and diagnoses in words.

    Attributes:
        network_: The trained network.
        classes_: The classes.
        temperature_: Divisor of the logits before softmax.
        movements_: Smallest and largest number of movements of the training runs; None: unknown.
        weights_: Weights in the pool with the Bayesian diagnosis; None: never fitted.
    """

    network_: torch.nn.Module
    classes_: NDArray[Any]
    temperature_: float
    movements_: tuple[int, int] | None
    weights_: PoolWeights | None

    def scores(self, X: Runs) -> FloatArray:
        """Return the logits, (run, class), before the temperature."""
        raise NotImplementedError

    @property
    def about(self) -> tuple[str, str]:
        """Protocol and method, for results."""
        raise NotImplementedError

    @property
    def known_robot(self) -> Robot:
        """The robot whose runs are diagnosed."""
        raise NotImplementedError

    def calibrate(self, X: Runs, y: ArrayLike | None = None) -> Self:
        """Set the temperature with the best mean log score on held-out runs; no test set.

        `y` are the classes of the runs; None: the truth in the run set.
        """
        scores = self.scores(X)
        number = {name: i for i, name in enumerate(self.classes_.tolist())}
        truth = np.asarray(truth_or(X, y)).tolist()
        strange = sorted({str(name) for name in truth if name not in number})
        if strange:
            raise InputError(
                f"the network does not know {', '.join(strange)}. Expected runs of "
                f"{', '.join(map(str, number))}."
            )
        index = np.array([number[name] for name in truth], dtype=np.int64)
        self.temperature_ = best_temperature(scores, index)
        return self

    def predict_proba(self, X: Runs) -> FloatArray:
        """Return the probability of each class, (run, class), in the order of `classes_`."""
        return softmax(self.scores(X) / self.temperature_, axis=1)

    def predict(self, X: Runs) -> NDArray[Any]:
        """Return the most probable class of each run."""
        best = self.scores(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def score(
        self, X: Runs, y: ArrayLike | None = None, sample_weight: ArrayLike | None = None
    ) -> float:
        """Return the (weighted) accuracy; `y` of None: the truth in the run set."""
        return float(super().score(X, truth_or(X, y), sample_weight))

    def diagnose(self, runs: RunsLike) -> list[Diagnosis]:
        """Return the diagnosis of each run of a run set, or of logs by their path.

        Uses `command` and `measured` alone; the truth is only copied to the results.
        """
        check_is_fitted(self, "network_")
        robot = self.known_robot
        runs = as_runs(runs, robot)
        check_runs(runs, "the run set")
        check_motors(runs, robot.name, robot.motor_names)
        quality = log_quality(runs, settings=InferenceSettings.of(robot))
        chances, estimates, counts = self._answers(drop_invalid(runs, quality))
        names, faults = runs["run"].values.tolist(), truth_of(runs)
        truth: Sequence[str | None] = [None] * len(names) if faults is None else faults
        said = chances.tolist(), estimates
        rows = zip(names, truth, *said, quality, counts.tolist(), strict=True)
        return [self._diagnosis(*row) for row in rows]

    def _answers(self, runs: xr.Dataset) -> tuple[FloatArray, Sequence[Estimate], IntArray]:
        """Return probabilities (run, class), the likeliest fault's onset and size, movements."""
        chances = self.predict_proba(runs)
        return chances, [{}] * len(chances), movement_counts(runs)

    def _diagnosis(
        self,
        name: str,
        truth: str | None,
        chances: list[float],
        estimate: Estimate,
        log: LogQuality,
        movements: int,
    ) -> Diagnosis:
        """Return the diagnosis of a run; no verdict if the log is too poor."""
        if log.fatal:
            chances, estimate = [1.0 / len(chances)] * len(chances), {}
        protocol, method = self.about
        diagnosis = Diagnosis(
            run=str(name),
            posterior=dict(zip(map(str, self.classes_), chances, strict=True)),
            truth=truth,
            quality=(*log.remarks, *self._unfamiliar(movements)),
            undecided=log.fatal,
            protocol=protocol,
            method=method,
        )
        diagnosis = replace(diagnosis, **estimate)
        kind = class_name(self.known_robot)
        ranked = [Hypothesis.parse(name) for name in diagnosis.ranked]
        return worded(diagnosis, ranked, arm_class=kind)

    def _unfamiliar(self, movements: int) -> tuple[str, ...]:
        """Return a remark if the number of movements differs from the training runs."""
        if self.movements_ is None or self.movements_[0] <= movements <= self.movements_[1]:
            return ()
        low, high = self.movements_
        known = f"{low}" if low == high else f"{low} to {high}"
        return (
            f"{movements} movements, and the network learned from runs of {known}: its "
            "probabilities mean little here",
        )


@dataclass(eq=False, repr=False)
class LearnedDiagnoser(NetworkDiagnoser):
    """A network that returns the probability of each class.

    Takes arrays of features, and run sets if it has an encoder.

    Attributes:
        network: Name of the network; see `NETWORKS`.
        encoder: Encodes run sets as features; None: arrays only.
        iterations: Number of batches in `fit`.
        learning_rate: Initial learning rate of Adam.
        decay: Whether the rate falls to zero along half a cosine.
        batch_runs: Runs in a batch.
        random_state: Seed of weights, dropout and order.
        classes_: The classes; sorted after `fit`.
        network_: The trained network.
        standard_: Standardisation of each channel.
        temperature_: Divisor of the logits before softmax.
        movements_: Smallest and largest number of movements of the training runs; None: unknown.
        weights_: Weights in the pool with the Bayesian diagnosis; None: never fitted.
    """

    network: str = "cnn"
    encoder: FeatureEncoder | None = None
    iterations: int = 500
    learning_rate: float = 1e-3
    decay: bool = True
    batch_runs: int = 32
    random_state: int | None = None

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def fit(self, X: Runs, y: ArrayLike | None = None) -> LearnedDiagnoser:
        """Train on runs and their classes; `y` of None: the truth in the run set."""
        y = truth_or(X, y)
        self.movements_ = None
        if is_run_set(X):
            counts = movement_counts(X)
            self.movements_ = (int(counts.min()), int(counts.max()))
        features, classes = validate_data(
            self, self._features(X), y, allow_nd=True, dtype=np.float32
        )
        check_classification_targets(classes)
        names, index = np.unique(classes, return_inverse=True)
        if len(names) < 2:
            raise InputError(f"all runs are of one class, {names[0]!r}. Expected two at least.")
        features = _points(features)
        rng = check_random_state(self.random_state)
        order = np.random.default_rng(rng.randint(2**31))
        batches = shuffled_batches(features, index.astype(np.int64), self.batch_runs, order)
        return self._learn(batches, Standard.of(features), names, rng.randint(2**31))

    def fit_batches(
        self,
        batches: Iterable[Batch],
        standard: Standard,
        classes: Sequence[str],
        movements: tuple[int, int],
        on_iteration: Callable[[int], None] = lambda done: None,
        device: str = "auto",
    ) -> LearnedDiagnoser:
        """Train on batches that are not standardised yet, such as those of a `Stream`.

        `movements` are the smallest and largest number of a run; `on_iteration` is called after
        each batch with the number of batches so far; `device` is one of `DEVICES`.
        """
        seed = check_random_state(self.random_state).randint(2**31)
        self.n_features_in_, self.movements_ = POINTS, movements
        return self._learn(batches, standard, np.array(classes), seed, on_iteration, device)

    def _learn(
        self,
        batches: Iterable[Batch],
        standard: Standard,
        classes: NDArray[Any],
        seed: int,
        on_iteration: Callable[[int], None] = lambda done: None,
        device: str = "auto",
    ) -> LearnedDiagnoser:
        """Train on batches that are not standardised yet."""
        if self.iterations < 1 or self.batch_runs < 1:
            raise InputError(
                f"{self.iterations} iterations of {self.batch_runs} runs. Expected one at least of "
                "both."
            )
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = build_network(
                self.network, network_shape(self.encoder, len(standard.mean), len(classes))
            )
            standardised = ((standard(features), index) for features, index in batches)
            how = self.iterations, self.learning_rate, self.decay
            for done in training(network, standardised, *how, device):
                on_iteration(done)
        self.network_ = network.cpu()
        self.classes_, self.standard_, self.temperature_ = classes, standard, 1.0
        self.weights_: PoolWeights | None = None
        return self

    def scores(self, X: Runs) -> FloatArray:
        """Return the logits, (run, class), before the temperature."""
        check_is_fitted(self, "network_")
        features = validate_data(
            self, self._features(X), allow_nd=True, dtype=np.float32, reset=False
        )
        features = _points(features)
        if features.shape[2] != len(self.standard_.mean):
            raise InputError(
                f"features have {features.shape[2]} channels, the network was trained on "
                f"{len(self.standard_.mean)}."
            )
        return scores_of(self.network_, self.standard_(features))

    @property
    def about(self) -> tuple[str, str]:
        """Protocol and method, for results."""
        encoder = self._encoder()
        method = f"network {self.network}, {encoder.features} features"
        if encoder.expected is not None:
            method += f"; healthy behaviour: {encoder.expected.name}"
        return encoder.protocol, method

    @property
    def known_robot(self) -> Robot:
        """The robot whose features the encoder makes."""
        return self._encoder().robot

    def _encoder(self) -> FeatureEncoder:
        if self.encoder is None:
            raise InputError("this network has no encoder, so it takes arrays, not run sets.")
        return self.encoder

    def _features(self, X: Runs) -> Any:
        return self._encoder().encode(signals_of(X)) if is_run_set(X) else X


def network_shape(encoder: FeatureEncoder | None, channels: int, classes: int) -> Shape:
    """Return the shape of a network for the features of an encoder."""
    if encoder is None or encoder.features != "robust":
        return Shape(channels, classes)
    return Shape(channels, classes, len(encoder.robot.motors), len(SHARED))


def is_run_set(X: Runs) -> bool:
    """Return whether X is a run set rather than an array."""
    return hasattr(X, "data_vars")


def truth_or(X: Runs, y: ArrayLike | None) -> ArrayLike | None:
    """Return the class of each run: `y`, else the truth in the run set."""
    return truth_of(X) if is_run_set(X) and y is None else y


def _points(features: Floats) -> Floats:
    """Return features as (run, point, channel)."""
    return features if features.ndim == 3 else features[:, None, :]


def movement_counts(runs: xr.Dataset) -> IntArray:
    """Return the number of movements of each run, (run,)."""
    signals = signals_of(runs)
    return find_movements(signals.command, signals.time).exists.sum(axis=1)


TEMPERATURES = (0.05, 20.0)
"""Range of temperatures."""


def best_temperature(scores: FloatArray, truth: IntArray) -> float:
    """Return the temperature with the best mean log score (Guo et al., ICML 2017).

    Takes logits (run, class) and the true class index, (run,).
    """
    from scipy.optimize import minimize_scalar

    runs = np.arange(len(truth))

    def log_score(log_temperature: float) -> float:
        return float(-log_softmax(scores / np.exp(log_temperature), axis=1)[runs, truth].mean())

    low, high = np.log(TEMPERATURES)
    return float(np.exp(minimize_scalar(log_score, bounds=(low, high), method="bounded").x))
