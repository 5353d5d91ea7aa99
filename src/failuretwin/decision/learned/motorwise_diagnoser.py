"""The motor-wise network as a diagnoser and as a scikit-learn estimator, with onset and size."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, parse_hypotheses, single_faults
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.diagnoser import (
    Estimate,
    NetworkDiagnoser,
    Runs,
    is_run_set,
    movement_counts,
    truth_or,
)
from failuretwin.decision.learned.labels import Labels
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.motorwise import (
    LOG_SIZE_SCALE,
    LOG_WIDTHS,
    NORMALS,
    Batch,
    MotorwiseNetwork,
    Told,
    motorwise_training,
    told_of,
)
from failuretwin.decision.learned.networks import device_of
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    import xarray as xr

NETWORK = "motorwise"
"""Its name."""
QUANTILES = (0.05, 0.5, 0.95)
"""Ends and middle of the intervals of onset and size."""
PART_RUNS = 128
"""Runs encoded at a time."""
HALVINGS = 50
"""Halvings of the range in which a quantile of a size lies."""
FURTHEST = 8.0
"""Ends of that range, in deviations from the outermost normal distribution."""


@dataclass(eq=False, repr=False)
class MotorwiseDiagnoser(NetworkDiagnoser):
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
        spread_: Factor on the deviations of sizes, by mode.
        arms_: Names of the robots of the training runs.
        weights_: Weights in the pool with the Bayesian diagnosis; None: never fitted.
    """

    encoder: MomentEncoder | None = None
    modes: tuple[str, ...] = ("stuck", "steady_state_error")
    iterations: int = 500
    learning_rate: float = 3e-3
    batch_runs: int = 64
    random_state: int | None = None

    def fit(self, X: xr.Dataset, y: ArrayLike | None = None) -> MotorwiseDiagnoser:
        """Train on a run set; `y`: its classes, None: the truth in the run set."""
        encoder = self.coder
        if not is_run_set(X):
            raise InputError("the motor-wise network learns from a run set, not from arrays.")
        faults = [str(name) for name in np.asarray(truth_or(X, y)).tolist()]
        tokens = self._tokens(X)
        labels = Labels.of_runs(X, faults, encoder.robot.motor_names, self.modes)
        counts = movement_counts(X)
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
        batches = _shuffled(self.batch_of(tokens, labels), self.batch_runs, rng)
        movements = int(counts.min()), int(counts.max())
        return self.fit_batches(batches, [tokens], movements, [encoder.robot.name])

    def batch_of(self, tokens: Tokens, labels: Labels) -> Batch:
        """Return runs with their truth as the network learns them."""
        truth = labels.motor, labels.mode, labels.onset, labels.size
        return Batch.of(tokens, *truth, np.array([is_angle(mode) for mode in self.modes]))

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
        self.temperature_, self.weights_ = 1.0, None
        self.spread_ = (1.0,) * len(self.modes)
        self.movements_, self.arms_ = movements, tuple(arms)
        self.classes_ = self._class_names()
        return self

    def calibrate_sizes(self, exams: Sequence[tuple[Tokens, Labels]]) -> MotorwiseDiagnoser:
        """Widen or narrow sizes until 90 % intervals hold 90 % of held-out runs; no test set.

        Args:
            exams: Tokens and truth of runs of each robot.
        """
        spread = []
        for number in range(len(self.modes)):
            known = [self._sizes(tokens, labels, number) for tokens, labels in exams]
            held = [one for some in known for one in some]
            spread.append(conformal_spread(held) if held else 1.0)
        self.spread_ = tuple(spread)
        return self

    def _sizes(
        self, tokens: Tokens, labels: Labels, number: int
    ) -> list[tuple[float, FloatArray, FloatArray, FloatArray]]:
        """Return true size and its mixture of the runs with a fault of one mode."""
        told, angle = self._told(tokens), is_angle(self.modes[number])
        found = []
        for run in np.flatnonzero(labels.mode == number).tolist():
            size = labels.size[run] if angle else np.log(max(abs(labels.size[run]), 1e-9))
            motor = int(labels.motor[run])
            mixture = size_mixture(told, tokens, run, motor, number, angle)
            found.append((float(size), *mixture))
        return found

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
        encoder = self.coder
        method = f"network {NETWORK}; healthy behaviour: {encoder.expected.name}"
        return encoder.protocol, method

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

    def _unfamiliar(self, movements: int) -> tuple[str, ...]:
        remarks = super()._unfamiliar(movements)
        if self.known_robot.name in self.arms_:
            return remarks
        known = ", ".join(self.arms_)
        return (*remarks, f"the network learned from other arms ({known}): check it on this one")

    def scores(self, X: Runs | Tokens) -> FloatArray:
        """Return the logits, (run, class), before the temperature."""
        return self._told(self._tokens(X)).scores

    def _told(self, tokens: Tokens) -> Told:
        check_is_fitted(self, "network_")
        assert isinstance(self.network_, MotorwiseNetwork)
        return told_of(self.network_, tokens)

    def _tokens(self, X: Runs | Tokens) -> Tokens:
        if isinstance(X, Tokens):
            return X
        if not is_run_set(X):
            raise InputError("the motor-wise network takes run sets or tokens, not arrays.")
        parts = range(0, X.sizes["run"], PART_RUNS)
        encode = self.coder.encode
        return Tokens.joined([encode(X.isel(run=slice(at, at + PART_RUNS))) for at in parts])

    def _answers(self, runs: xr.Dataset) -> tuple[FloatArray, Sequence[Estimate], IntArray]:
        tokens = self._tokens(runs)
        told = self._told(tokens)
        best = told.scores.argmax(axis=1)
        estimates = [self._estimate(told, tokens, *pair) for pair in enumerate(best.tolist())]
        chances = torch.from_numpy(told.scores / self.temperature_).softmax(1).numpy()
        return chances, estimates, tokens.lengths  # many of a run that never rests

    def _estimate(self, told: Told, tokens: Tokens, run: int, best: int) -> Estimate:
        """Return onset and size of the likeliest fault of a run."""
        if best == 0:
            return {}
        number, motor = divmod(best - 1, told.rows.shape[2])
        mode = MODES[self.modes[number]]
        low, onset, high = onset_quantiles(told, tokens, run, motor, number)
        least, size, most = self.size_quantiles(told, tokens, run, motor, number)
        return {
            "onset_s": onset,
            "onset_90": (low, high),
            "magnitude": size,
            "magnitude_unit": mode.unit,
            "magnitude_90": (least, most),
        }

    def size_quantiles(
        self, told: Told, tokens: Tokens, run: int, motor: int, number: int
    ) -> tuple[float, ...]:
        """Return the quantiles of the size of a fault, by `QUANTILES`."""
        name = self.modes[number]
        share, centre, deviation = size_mixture(told, tokens, run, motor, number, is_angle(name))
        found = mixture_quantiles(share, centre, self.spread_[number] * deviation)
        if not is_angle(name):
            negative = MODES[name].signed and tokens.anchor[run, 0, motor, 3] < 0.0
            found = -np.exp(found)[::-1] if negative else np.exp(found)
        return tuple(found.tolist())


def is_angle(mode: str) -> bool:
    """Return whether the size of a mode is the angle at which the motor is held."""
    return MODES[mode].signature is Signature.HELD


def check_modes(hypotheses: Sequence[Hypothesis | str], robot: Robot) -> tuple[str, ...]:
    """Return the modes of hypotheses: healthy, and each mode at each motor.

    Raises:
        InputError: If they are anything else; a network on features takes any.
    """
    known = parse_hypotheses(hypotheses, robot.motor_names)
    modes = tuple(dict.fromkeys(fault.mode for one in known for fault in one.faults))
    wanted = {str(one) for one in single_faults(robot.motor_names, modes)}
    if {str(one) for one in known} != wanted:
        raise InputError(
            "the motor-wise network distinguishes healthy and each mode at each motor. Expected "
            f"--hypotheses {','.join(sorted(wanted))}, or another --network."
        )
    return modes


def onset_shares(told: Told, run: int, motor: int, mode: int) -> FloatArray:
    """Return the probability of each bin of the onset of a fault, (moment, bin)."""
    rows, bins = told.rows[run, :, motor, mode], told.bins[run, :, motor, mode]
    share = np.exp(rows - rows.max())
    inside = np.exp(bins - bins.max(axis=1, keepdims=True))
    inside /= inside.sum(axis=1, keepdims=True)
    return np.asarray(share[:, None] / share.sum() * inside)


def onset_quantiles(
    told: Told, tokens: Tokens, run: int, motor: int, mode: int
) -> tuple[float, ...]:
    """Return the quantiles of the onset of a fault, by `QUANTILES` [s]."""
    share = onset_shares(told, run, motor, mode)
    edges = tokens.edges[run, :, motor].astype(np.float64)
    below = np.r_[0.0, np.cumsum(share.ravel())]
    begin, end = edges[:, :-1].ravel(), edges[:, 1:].ravel()
    found = []
    for quantile in QUANTILES:
        at = min(int(np.searchsorted(below[1:], quantile)), share.size - 1)
        inside = (quantile - below[at]) / max(below[at + 1] - below[at], 1e-12)
        found.append(float(begin[at] + np.clip(inside, 0.0, 1.0) * (end[at] - begin[at])))
    return tuple(found)


def size_mixture(
    told: Told, tokens: Tokens, run: int, motor: int, mode: int, angle: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return share, mean and deviation of the normal distributions of a size, (normal,) each.

    Of an angle [rad], else of the logarithm of the size.
    """
    rows, told_size = told.rows[run, :, motor, mode], told.sizes[run, :, motor, mode]
    row = np.exp(rows - rows.max())
    weight, centre, width = told_size.reshape(len(rows), 3, NORMALS).transpose(1, 0, 2)
    share = np.exp(weight - weight.max(axis=1, keepdims=True))
    share = (row / row.sum())[:, None] * share / share.sum(axis=1, keepdims=True)
    anchor = tokens.anchor[run, :, motor].astype(np.float64)
    middle = anchor[:, 0] if angle else anchor[:, 2]
    scale = np.maximum(anchor[:, 1], 1e-4) if angle else np.full(len(rows), LOG_SIZE_SCALE)
    deviation = scale[:, None] * np.exp(np.clip(width, *LOG_WIDTHS))
    return share.ravel(), (middle[:, None] + scale[:, None] * centre).ravel(), deviation.ravel()


SPREADS = np.geomspace(0.5, 4.0, 61)
"""Factors on deviations of sizes that are tried."""


def conformal_spread(
    held: Sequence[tuple[float, FloatArray, FloatArray, FloatArray]],
) -> float:
    """Return the least factor on deviations with which intervals hold as often as they say.

    Args:
        held: True size, and share, mean and deviation of the normal distributions, of some runs.
    """
    low, _, high = QUANTILES
    for factor in SPREADS.tolist():
        below = [float(s @ ndtr((x - m) / (factor * d))) for x, s, m, d in held]
        inside = np.mean([low <= one <= high for one in below])
        if inside >= high - low:
            return float(factor)
    return float(SPREADS[-1])


def mixture_quantiles(share: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return the quantiles of a sum of normal distributions, by `QUANTILES`."""
    wanted = np.array(QUANTILES)
    low = np.full(len(wanted), np.min(mean - FURTHEST * deviation))
    high = np.full(len(wanted), np.max(mean + FURTHEST * deviation))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        below = ndtr((middle[:, None] - mean) / deviation) @ share
        low, high = np.where(below < wanted, middle, low), np.where(below < wanted, high, middle)
    return np.asarray(0.5 * (low + high))


def _shuffled(batch: Batch, size: int, rng: np.random.Generator) -> Iterator[Batch]:
    """Yield batches without end, in a new random order each epoch."""
    size = min(size, len(batch))
    while True:
        order: IntArray = rng.permutation(len(batch))
        for first in range(0, len(order) - size + 1, size):
            yield batch[order[first : first + size]]
