"""Motor-wise network: one network for arms of any number of motors and runs of any length.

Every token, a moment and a motor, goes through the same layers. Between them it receives sums over
the moments before and after it, and means and maxima over the motors, so that the network neither
knows which motor is which nor how many there are. Each token says how probable it is that a fault
of its motor began just before its moment:

    log p(k, mode) = log sum over m of exp(row(m, k, mode)),    p(m | k, mode) = softmax over m

and, given that, when exactly (a histogram) and how large the fault is (a sum of normal
distributions about the size that the moments from m on point to).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.lr_scheduler import OneCycleLR

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import ArrayStruct, Axes, FloatArray, IntArray, as_floats
from failuretwin.decision.learned.moment_encoder import BINS, Tokens
from failuretwin.decision.learned.moment_features import FEATURES
from failuretwin.decision.learned.networks import DROPOUT, descent

if TYPE_CHECKING:
    import xarray as xr

WIDTH, BLOCKS = 48, 3
"""Features of a token inside the network, and blocks that exchange them."""
NORMALS = 2
"""Normal distributions of a size given its row."""
SUM_SCALE = 0.25
"""Factor on sums over moments: runs of five movements give sums of the order of one."""
NOWHERE = -1e4
"""Logit of a row that does not exist."""
LOG_WIDTHS = (-3.0, 6.0)
"""Range of the log deviation of a size, in the deviation that the moments suggest."""
ONSET_WEIGHT, SIZE_WEIGHT = 0.2, 0.2
"""Weights of the losses of onset and size beside that of the class."""
EVALUATED_RUNS = 256
"""Runs evaluated at a time."""


class _Block(nn.Module):
    """Exchange over moments and motors, then two layers for each token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.mixed = nn.Linear(6 * width, 2 * width)
        self.dropout = nn.Dropout(DROPOUT)
        self.out = nn.Linear(2 * width, width)

    def forward(self, x: Tensor, exists: Tensor) -> Tensor:
        """Return the tokens (run, moment, motor, width) after the exchange."""
        there = exists[:, :, None, None]
        known = self.norm(x) * there
        flat = known.flatten(2)  # (run, moment, motor x width)
        total = torch.cumsum(flat, dim=1)
        before = torch.unflatten(total - flat, 2, known.shape[2:]) * SUM_SCALE
        after = torch.unflatten(total[:, -1:] - total + flat, 2, known.shape[2:]) * SUM_SCALE
        most = (known + (1.0 - there) * NOWHERE).amax(dim=1, keepdim=True).expand_as(known)
        mean = known.mean(dim=2, keepdim=True).expand_as(known)
        largest = known.amax(dim=2, keepdim=True).expand_as(known)
        seen = torch.cat([known, before, after, most, mean, largest], dim=3)
        return x + self.out(self.dropout(functional.gelu(self.mixed(seen))))


class MotorwiseNetwork(nn.Module):
    """Network on tokens; see the module."""

    def __init__(self, modes: int) -> None:
        super().__init__()
        self.modes = modes
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("spread", torch.ones(FEATURES))
        self.embed = nn.Linear(FEATURES, WIDTH)
        self.blocks = nn.ModuleList(_Block(WIDTH) for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(WIDTH)
        self.rows = nn.Linear(WIDTH, modes * (1 + BINS + 3 * NORMALS))
        self.healthy = nn.Sequential(nn.Linear(3 * WIDTH, WIDTH), nn.GELU(), nn.Linear(WIDTH, 1))

    def standardise(self, sample: Sequence[Tokens]) -> None:
        """Set mean and spread of the features by some runs of each arm."""
        parts = [tokens.features[tokens.exists].reshape(-1, FEATURES) for tokens in sample]
        flat = np.concatenate(parts).astype(np.float64)
        spread = flat.std(axis=0)
        spread[spread < 1e-3] = 1.0
        for name, values in (("mean", flat.mean(axis=0)), ("spread", spread)):
            getattr(self, name).copy_(torch.from_numpy(values.astype(np.float32)))

    def forward(self, features: Tensor, exists: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return logits of healthy (run, 1), rows, bins and sizes (run, moment, motor, mode, ...).

        `exists` is 1 for moments that there are, else 0, (run, moment).
        """
        x = functional.gelu(self.embed((features - self.mean) / self.spread))
        for block in self.blocks:
            x = block(x, exists)
        there = exists[:, :, None, None]
        x = self.norm(x) * there
        pooled = torch.cat([x.sum(dim=1).amax(dim=1), x.sum(dim=1).mean(dim=1)], dim=1) * SUM_SCALE
        most = (x + (1.0 - there) * NOWHERE).amax(dim=(1, 2))
        healthy = self.healthy(torch.cat([pooled, most], dim=1))
        told = torch.unflatten(self.rows(x), 3, (self.modes, 1 + BINS + 3 * NORMALS))
        row, bins, size = torch.split(told, [1, BINS, 3 * NORMALS], dim=4)
        return healthy, row.squeeze(4) + (1.0 - there) * NOWHERE, bins, size


def class_logits(healthy: Tensor, rows: Tensor) -> Tensor:
    """Return the logits of healthy, then of each motor under the first mode, the second, ..."""
    return torch.cat([healthy, rows.logsumexp(dim=1).transpose(1, 2).flatten(1)], dim=1)


def log_size_density(size: Tensor, place: Tensor, scale: Tensor) -> Tensor:
    """Return the log density of z given each row, (run, row).

    Args:
        size: What the network says, (run, row, 3 x normal).
        place: z less the size that the moments point to, (run, row).
        scale: Deviation that the moments suggest, (run, row).
    """
    share, centre, width = torch.unflatten(size, 2, (3, NORMALS)).unbind(2)
    log_width = width.clamp(*LOG_WIDTHS)
    u = (place / scale).unsqueeze(2) - centre
    terms = share.log_softmax(2) - 0.5 * (u * torch.exp(-log_width)) ** 2 - log_width
    return terms.logsumexp(2) - torch.log(scale) - 0.5 * math.log(2.0 * math.pi)


LOG_SIZE_SCALE = 0.3
"""Usual deviation of the logarithm of a size that is not an angle."""


@dataclass(frozen=True)
class Labels(ArrayStruct):
    """Truth of runs.

    Attributes:
        motor: Index of the faulty motor, (run,); 0 if healthy.
        mode: Index of its mode, (run,); -1 if healthy.
        onset: (run,) [s]; NaN if healthy.
        size: In the unit of the mode, (run,); NaN if healthy.
    """

    motor: Annotated[IntArray, Axes("run")]
    mode: Annotated[IntArray, Axes("run")]
    onset: Annotated[FloatArray, Axes("run")]
    size: Annotated[FloatArray, Axes("run")]

    @classmethod
    def of_runs(
        cls, runs: xr.Dataset, faults: Sequence[str], motors: Sequence[str], modes: Sequence[str]
    ) -> Labels:
        """Return the labels of a run set.

        Args:
            runs: The runs, with onset and magnitude of their faults.
            faults: Name of the class of each.
            motors: Names of the motors.
            modes: Ids of the modes.

        Raises:
            InputError: If a class is none of a single fault of these modes, or onset or size are
                missing.
        """
        known = [Hypothesis.parse(name).faults for name in faults]
        for name, fault in zip(faults, known, strict=True):
            if len(fault) > 1 or any(one.mode not in modes for one in fault):
                raise InputError(f"class {name!r}: expected healthy or one of {', '.join(modes)}.")
        missing = [name for name in ("onset", "magnitude") if name not in runs]
        if missing:
            raise InputError(f"the run set lacks {' and '.join(missing)} of its faults.")
        motor = np.array([motors.index(fault[0].motor) if fault else 0 for fault in known])
        mode = np.array([modes.index(fault[0].mode) if fault else -1 for fault in known])
        onset, size = (as_floats(runs[name].values) for name in ("onset", "magnitude"))
        return cls(motor, mode, onset, size)


@dataclass(frozen=True)
class Batch(ArrayStruct):
    """Some runs with their truth, as arrays.

    Attributes:
        tokens: The runs.
        motor: Faulty motor, (run,).
        mode: Its mode, (run,); -1 if healthy.
        row: Moment before which the fault began, (run,).
        bin: Bin of its onset, (run,).
        size: Held angle [rad] or log of the size, (run,).
        angle: Whether `size` is an angle, (run,).
    """

    tokens: Tokens
    motor: Annotated[IntArray, Axes("run")]
    mode: Annotated[IntArray, Axes("run")]
    row: Annotated[IntArray, Axes("run")]
    bin: Annotated[IntArray, Axes("run")]
    size: Annotated[NDArray[np.float32], Axes("run")]
    angle: Annotated[NDArray[np.bool_], Axes("run")]

    def __len__(self) -> int:
        """How many runs."""
        return len(self.tokens)

    def cut(self) -> Batch:
        """Return the same without room that no run needs."""
        return replace(self, tokens=self.tokens.cut())

    @classmethod
    def of(cls, tokens: Tokens, labels: Labels, is_angle: NDArray[np.bool_]) -> Batch:
        """Return runs with their truth; `is_angle` says of each mode whether its size is held."""
        motor, mode = labels.motor, labels.mode
        faulty = mode >= 0
        row, place = onset_bins(tokens, motor, np.where(faulty, labels.onset, 0.0))
        angle = faulty & is_angle[np.maximum(mode, 0)]
        known = np.where(faulty, labels.size, 1.0)
        log_size = np.log(np.maximum(np.abs(known), 1e-6))
        z = np.where(angle, known, log_size).astype(np.float32)
        return cls(tokens, motor, mode, row, place, z, angle)


def onset_bins(tokens: Tokens, motor: IntArray, onset: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the row and the bin of the onset of each run, (run,) each."""
    runs = np.arange(len(tokens))
    edges = tokens.edges[runs, :, motor].astype(np.float64)  # (run, moment, bin + 1)
    late = tokens.exists & (edges[..., -1] <= onset[:, None])
    row = np.minimum(late.sum(axis=1), tokens.exists.sum(axis=1) - 1)
    row = np.where(onset <= 0.0, 0, row)
    inside = (edges[runs, row, 1:] <= onset[:, None]).sum(axis=1)
    first = np.where(onset <= 0.0, 0, np.minimum(inside, BINS - 1))
    return row.astype(np.int64), first.astype(np.int64)


def loss_of(network: MotorwiseNetwork, batch: Batch, where: torch.device) -> Tensor:
    """Return the mean negative log posterior of class, onset and size."""

    def put(values: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(where)

    exists = put(batch.tokens.exists.astype(np.float32))
    healthy, rows, bins, size = network(put(batch.tokens.features), exists)
    motors = rows.shape[2]
    wanted = np.where(batch.mode < 0, 0, 1 + np.maximum(batch.mode, 0) * motors + batch.motor)
    loss = functional.cross_entropy(class_logits(healthy, rows), put(wanted))
    faulty = np.flatnonzero(batch.mode >= 0)
    if not len(faulty):
        return loss
    run, motor, mode = put(faulty), put(batch.motor[faulty]), put(batch.mode[faulty])
    log_row = rows[run, :, motor, mode].log_softmax(1)
    row, place = put(batch.row[faulty]), put(batch.bin[faulty])
    at = torch.arange(len(faulty), device=where)
    log_bin = bins[run, row, motor, mode].log_softmax(1)[at, place]
    onset = -(log_row[at, row] + log_bin).mean()
    anchor = batch.tokens.anchor[faulty, :, batch.motor[faulty]]
    angle = batch.angle[faulty, None]
    centre = np.where(angle, anchor[..., 0], anchor[..., 2])
    scale = np.where(angle, anchor[..., 1], np.float32(LOG_SIZE_SCALE))
    scale = np.maximum(scale, np.float32(1e-4))
    density = log_size_density(
        size[run, :, motor, mode], put(batch.size[faulty, None] - centre), put(scale)
    )
    sizes = -(log_row + density).logsumexp(1).mean()
    return loss + ONSET_WEIGHT * onset + SIZE_WEIGHT * sizes


def motorwise_training(
    network: MotorwiseNetwork,
    batches: Iterable[Batch],
    iterations: int,
    learning_rate: float,
    where: torch.device,
) -> Iterator[int]:
    """Train a network in place by AdamW; yields the number of iterations after each."""
    network.to(where)
    optimizer = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=0.01)
    schedule = OneCycleLR(optimizer, learning_rate, total_steps=iterations + 1, pct_start=0.1)
    some = islice(batches, iterations)
    return descent(network, some, lambda batch: loss_of(network, batch, where), schedule, 1.0)


@dataclass(frozen=True)
class Told:
    """What a network says of some runs.

    Attributes:
        scores: Logits of healthy and each motor under each mode, (run, class).
        rows: (run, moment, motor, mode).
        bins: (run, moment, motor, mode, bin).
        sizes: (run, moment, motor, mode, 3 x normal).
    """

    scores: FloatArray
    rows: FloatArray
    bins: FloatArray
    sizes: FloatArray


def told_of(network: MotorwiseNetwork, tokens: Tokens) -> Told:
    """Return what a network says of runs."""
    where = next(network.parameters()).device
    network.eval()
    parts = []
    with torch.inference_mode():
        for first in range(0, len(tokens), EVALUATED_RUNS):
            some = tokens[slice(first, first + EVALUATED_RUNS)]
            exists = torch.from_numpy(some.exists.astype(np.float32)).to(where)
            answer = network(torch.from_numpy(some.features).to(where), exists)
            values = class_logits(answer[0], answer[1]), *answer[1:]
            parts.append([one.double().cpu().numpy() for one in values])
    return Told(*(np.concatenate(column) for column in zip(*parts, strict=True)))
