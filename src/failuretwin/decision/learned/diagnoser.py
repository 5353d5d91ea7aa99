"""The motor-wise network as a diagnoser and as a scikit-learn estimator, with onset and size."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_softmax, softmax
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, parse_hypotheses, single_faults
from failuretwin.core.movements import find_movements
from failuretwin.core.runs import check_motors, check_runs, truth_of
from failuretwin.core.types import FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.decision.learned.estimates import Held, Onset, Size, fitted_factor
from failuretwin.decision.learned.log_pool import PoolWeights
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.motorwise import (
    Batch,
    Labels,
    MotorwiseNetwork,
    Told,
    motorwise_training,
    told_of,
)
from failuretwin.decision.learned.networks import device_of, shuffled
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import worded
from failuretwin.inference.observation.log_quality import LogQuality, drop_invalid, log_quality
from failuretwin.inference.observation.settings import InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

PART_RUNS = 128
"""Runs encoded at a time."""
Estimate = Mapping[str, Any]
"""Onset and size of the likeliest fault, as fields of `Diagnosis`; empty if healthy."""
Runs = Any
"""A run set, or tokens that the encoder made of one."""
Widths = tuple[tuple[float, float], ...]
"""By mode: the power of the shares of onsets, and the factor on the deviations of sizes."""


@dataclass(eq=False, repr=False)
class MotorwiseDiagnoser(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """One network for arms of any number of motors: mode and motor, onset and size.

    Takes run sets, or tokens that its encoder made of them.

    Attributes:
        encoder: What is known of the robot whose runs are diagnosed; see `for_robot`.
        modes: Ids of the fault modes.
        iterations: Number of batches in `fit`.
        learning_rate: Largest learning rate.
        batch_runs: Runs in a batch.
        random_state: Seed of weights and order.
        classes_: Healthy, then each motor under the first mode, under the second, ...
        network_: The trained network.
        temperature_: Divisor of the logits before softmax.
        movements_: Smallest and largest number of movements of the training runs.
        arms_: Names of the robots of the training runs.
        widths_: How much wider intervals are than the network says, by arm.
        weights_: Weights in the pool with the Bayesian diagnosis; None: never fitted.
    """

    encoder: MomentEncoder | None = None
    modes: tuple[str, ...] = ("stuck", "steady_state_error")
    iterations: int = 500
    learning_rate: float = 3e-3
    batch_runs: int = 64
    random_state: int | None = None

    # Learning.

    def fit(self, X: xr.Dataset, y: ArrayLike | None = None) -> MotorwiseDiagnoser:
        """Train on a run set; `y`: its classes, None: the truth in the run set."""
        encoder = self.coder
        tokens, labels = self._tokens(X), self._labels(X, y)
        counts = movement_counts(X)
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
        batch = self.batch_of(tokens, labels)
        batches = (batch[chosen] for chosen in shuffled(len(batch), self.batch_runs, rng))
        movements = int(counts.min()), int(counts.max())
        return self.fit_batches(batches, [tokens], movements, [encoder.robot.name])

    def batch_of(self, tokens: Tokens, labels: Labels) -> Batch:
        """Return runs with their truth as the network learns them."""
        return Batch.of(tokens, labels, np.array([is_angle(mode) for mode in self.modes]))

    def fit_batches(
        self,
        batches: Iterable[Batch],
        sample: Sequence[Tokens],
        movements: tuple[int, int],
        arms: Sequence[str],
        on_iteration: Callable[[int], None] = lambda done: None,
        device: str = "auto",
    ) -> MotorwiseDiagnoser:
        """Train on batches of runs.

        Args:
            batches: The runs.
            sample: Runs of each robot by which features are standardised.
            movements: Smallest and largest number of movements of a run.
            arms: Names of the robots.
            on_iteration: Called after each batch with the number of batches so far.
            device: One of `DEVICES`.
        """
        if self.iterations < 1 or self.batch_runs < 1:
            raise InputError(
                f"{self.iterations} iterations of {self.batch_runs} runs. Expected one at least of "
                "both."
            )
        with torch.random.fork_rng():
            torch.manual_seed(check_random_state(self.random_state).randint(2**31))
            network = MotorwiseNetwork(len(self.modes))
            network.standardise(sample)
            how = self.iterations, self.learning_rate, device_of(device)
            for done in motorwise_training(network, batches, *how):
                on_iteration(done)
        self.network_ = network.cpu()
        self.temperature_: float = 1.0
        self.weights_: PoolWeights | None = None
        self.movements_, self.arms_ = movements, tuple(arms)
        self.widths_: dict[str, Widths] = {}
        self.classes_ = self._class_names()
        return self

    # Calibration on held-out runs, never on a test set.

    def calibrate(self, X: Runs, y: ArrayLike | None = None) -> Self:
        """Set the temperature with the best mean log score.

        `y` are the classes of the runs; None: the truth in the run set.
        """
        scores = self.scores(X)
        number = {name: i for i, name in enumerate(self.classes_.tolist())}
        truth = np.asarray(_truth_or(X, y)).tolist()
        strange = sorted({str(name) for name in truth if name not in number})
        if strange:
            raise InputError(
                f"the network does not know {', '.join(strange)}. Expected runs of "
                f"{', '.join(map(str, number))}."
            )
        index = np.array([number[name] for name in truth], dtype=np.int64)
        self.temperature_ = best_temperature(scores, index)
        return self

    def calibrate_intervals(self, X: xr.Dataset) -> Self:
        """Widen or narrow onsets and sizes until 90 % intervals hold 90 % of runs of this robot."""
        tokens, labels = self._tokens(X), self._labels(X, None)
        told, widths = self._told(tokens), []
        for mode, name in enumerate(self.modes):
            onsets: list[Held] = []
            sizes: list[Held] = []
            for run in np.flatnonzero(labels.mode == mode).tolist():
                at = told, tokens, run, int(labels.motor[run]), mode
                size = labels.size[run]
                if not is_angle(name):
                    size = np.log(max(abs(size), 1e-9))
                if labels.onset[run] > 0.0:  # one before the run has a bin of its own
                    onsets.append((float(labels.onset[run]), Onset.of(*at)))
                sizes.append((float(size), Size.of(*at, angle=is_angle(name))))
            power = fitted_factor(onsets, narrower=True)
            widths.append((power, fitted_factor(sizes, narrower=False)))
        self.widths_ = {**self.widths_, self.known_robot.name: tuple(widths)}
        return self

    # Answers.

    def scores(self, X: Runs) -> FloatArray:
        """Return the logits, (run, class), before the temperature."""
        return self._told(self._tokens(X)).scores

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
        return float(super().score(X, _truth_or(X, y), sample_weight))

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
        tokens = self._tokens(drop_invalid(runs, quality))
        told = self._told(tokens)
        chances = softmax(told.scores / self.temperature_, axis=1).tolist()
        best = told.scores.argmax(axis=1).tolist()
        faults = truth_of(runs)
        found = []
        for run, name in enumerate(runs["run"].values.tolist()):
            diagnosis = Diagnosis(
                run=str(name),
                posterior=dict(zip(map(str, self.classes_), chances[run], strict=True)),
                truth=None if faults is None else faults[run],
            )
            diagnosis = replace(diagnosis, **self._estimate(told, tokens, run, best[run]))
            found.append(self._worded(diagnosis, quality[run], int(tokens.lengths[run])))
        return found

    def _worded(self, diagnosis: Diagnosis, log: LogQuality, movements: int) -> Diagnosis:
        """Return the diagnosis of a run in words; no verdict if the log is too poor.

        Args:
            diagnosis: Posterior, onset and size.
            log: Defects of its log.
            movements: Moments of the run.
        """
        if log.fatal:
            posterior = dict.fromkeys(diagnosis.posterior, 1.0 / len(diagnosis.posterior))
            diagnosis = Diagnosis(diagnosis.run, posterior, truth=diagnosis.truth)
        protocol, method = self.about
        diagnosis = replace(
            diagnosis,
            quality=(*log.remarks, *self._unfamiliar(movements)),
            undecided=log.fatal,
            protocol=protocol,
            method=method,
        )
        ranked = [Hypothesis.parse(name) for name in diagnosis.ranked]
        return worded(diagnosis, ranked, arm_class=class_name(self.known_robot))

    def _estimate(self, told: Told, tokens: Tokens, run: int, best: int) -> Estimate:
        """Return onset and size of the likeliest fault of a run."""
        if best == 0:
            return {}
        number, motor = divmod(best - 1, told.rows.shape[2])
        at, name = (told, tokens, run, motor, number), self.modes[number]
        power, factor = self._widths[number]
        low, onset, high = Onset.of(*at).powered(power).quantiles().tolist()
        sizes = Size.of(*at, angle=is_angle(name)).widened(factor).quantiles()
        if not is_angle(name):
            negative = MODES[name].signed and tokens.anchor[run, 0, motor, 3] < 0.0
            sizes = -np.exp(sizes)[::-1] if negative else np.exp(sizes)
        least, size, most = sizes.tolist()
        return {
            "onset_s": onset,
            "onset_90": (low, high),
            "magnitude": size,
            "magnitude_unit": MODES[name].unit,
            "magnitude_90": (least, most),
        }

    @property
    def _widths(self) -> Widths:
        """Widths of this robot; of another than was learned, the widest of any."""
        if self.known_robot.name in self.widths_:
            return self.widths_[self.known_robot.name]
        known = np.array([*self.widths_.values()] or [((1.0, 1.0),) * len(self.modes)])
        pairs = zip(known[..., 0].min(axis=0), known[..., 1].max(axis=0), strict=True)
        return tuple((float(power), float(factor)) for power, factor in pairs)

    def _unfamiliar(self, movements: int) -> tuple[str, ...]:
        """Return remarks on what differs from the training runs."""
        remarks = []
        if self.movements_ is not None and not (
            self.movements_[0] <= movements <= self.movements_[1]
        ):
            low, high = self.movements_
            known = f"{low}" if low == high else f"{low} to {high}"
            remarks.append(
                f"{movements} movements, and the network learned from runs of {known}: its "
                "probabilities mean little here"
            )
        if self.known_robot.name not in self.arms_:
            known = ", ".join(self.arms_)
            remarks.append(f"the network learned from other arms ({known}): check it on this one")
        return tuple(remarks)

    # The robot.

    def for_robot(self, encoder: MomentEncoder) -> MotorwiseDiagnoser:
        """Return the same network for the runs of another robot, or by another calibration."""
        found = copy(self)
        found.encoder = encoder
        found.classes_ = found._class_names()
        return found

    def _class_names(self) -> NDArray[Any]:
        names = single_faults(self.known_robot.motor_names, self.modes)
        return np.array([str(hypothesis) for hypothesis in names])

    @property
    def about(self) -> tuple[str, str]:
        """Protocol and method, for results."""
        known = self.coder.imperfections
        return known.protocol, f"network; healthy behaviour: {known.name}"

    @property
    def known_robot(self) -> Robot:
        """The robot whose runs are diagnosed."""
        return self.coder.robot

    @property
    def coder(self) -> MomentEncoder:
        """The encoder; InputError if there is none."""
        if self.encoder is None:
            raise InputError("this network has no encoder, so it knows no robot: give it one.")
        return self.encoder

    def _told(self, tokens: Tokens) -> Told:
        check_is_fitted(self, "network_")
        return told_of(self.network_, tokens)

    def _tokens(self, X: Runs) -> Tokens:
        if isinstance(X, Tokens):
            return X
        if not _is_run_set(X):
            raise InputError("the network takes run sets or tokens, not arrays.")
        parts = range(0, X.sizes["run"], PART_RUNS)
        encode = self.coder.encode
        return Tokens.joined([encode(X.isel(run=slice(at, at + PART_RUNS))) for at in parts])

    def _labels(self, X: xr.Dataset, y: ArrayLike | None) -> Labels:
        faults = [str(name) for name in np.asarray(_truth_or(X, y)).tolist()]
        return Labels.of_runs(X, faults, self.known_robot.motor_names, self.modes)


def is_angle(mode: str) -> bool:
    """Return whether the size of a mode is the angle at which the motor is held."""
    return MODES[mode].signature is Signature.HELD


def check_modes(hypotheses: Sequence[Hypothesis | str], robot: Robot) -> tuple[str, ...]:
    """Return the modes of hypotheses: healthy, and each mode at each motor.

    Raises:
        InputError: If they are anything else.
    """
    known = parse_hypotheses(hypotheses, robot.motor_names)
    modes = tuple(dict.fromkeys(fault.mode for one in known for fault in one.faults))
    wanted = {str(one) for one in single_faults(robot.motor_names, modes)}
    if {str(one) for one in known} != wanted:
        raise InputError(
            f"a network cannot distinguish {', '.join(map(str, known))}. Expected healthy and each "
            f"mode at each motor: {','.join(sorted(wanted))}."
        )
    return modes


def _is_run_set(X: Runs) -> bool:
    return hasattr(X, "data_vars")


def _truth_or(X: Runs, y: ArrayLike | None) -> ArrayLike | None:
    """Return the class of each run: `y`, else the truth in the run set."""
    return truth_of(X) if _is_run_set(X) and y is None else y


def movement_counts(runs: xr.Dataset) -> IntArray:
    """Return the number of movements of each run, (run,)."""
    command, time = as_floats(runs["command"].values), as_floats(runs["time"].values)
    return find_movements(command, time).exists.sum(axis=1)


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
