"""Networks on features and the training loop: the paper's LSTM, a CNN, and two of others.

Each maps standardised features (run, point, channel) to logits (run, class).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.lr_scheduler import ConstantLR, CosineAnnealingLR, LRScheduler

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.feature_encoder import POINTS, Floats

HIDDEN = 100
"""Units of both LSTM layers (Table I of the paper)."""
DROPOUT = 0.1
"""Dropout rate (Table I of the paper)."""
CNN_WIDTH = 96
STRIDES = (1, 2, 2, 1)
"""Stride of each convolution: 100 points become 50, then 25."""
KERNEL = 5
"""Kernel size of each convolution [points]."""
WIDTH = 64
"""Channels of the networks of others."""
T = TypeVar("T")


class PaperLstm(nn.Module):
    """The paper's network: LSTM 100, dropout 0.1, LSTM 100, last step, one dense layer."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.first = nn.LSTM(channels, HIDDEN, batch_first=True)
        self.dropout = nn.Dropout(DROPOUT)
        self.second = nn.LSTM(HIDDEN, HIDDEN, batch_first=True)
        self.dense = nn.Linear(HIDDEN, classes)
        for layer in (self.first, self.second):
            _initialise_as_published(layer)
        nn.init.xavier_uniform_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (run, class)."""
        steps = self.first(x)[0]
        steps = self.second(self.dropout(steps))[0]
        return self.dense(steps.select(dim=1, index=-1))


def _initialise_as_published(layer: nn.LSTM) -> None:
    """Initialise weights like MATLAB's `lstmLayer`, with which the paper's network was built.

    Glorot input weights, orthogonal recurrent weights, zero biases, forget-gate bias one. PyTorch's
    default learns more slowly here.
    """
    weights = dict(layer.named_parameters())
    nn.init.xavier_uniform_(weights["weight_ih_l0"])
    nn.init.orthogonal_(weights["weight_hh_l0"])
    nn.init.zeros_(weights["bias_ih_l0"])
    nn.init.zeros_(weights["bias_hh_l0"])
    # Gates in the order input, forget, cell, output.
    nn.init.ones_(weights["bias_ih_l0"][HIDDEN : 2 * HIDDEN])


class Cnn(nn.Module):
    """Four convolutions over time, mean and maximum over time, one hidden layer."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        wide = CNN_WIDTH
        self.convolutions = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2)
            for taken, stride in zip((channels, wide, wide, wide), STRIDES, strict=True)
        )
        self.dropout = nn.Dropout(DROPOUT)
        self.hidden = nn.Linear(2 * wide, wide)
        self.dense = nn.Linear(wide, classes)

    def seen(self, x: Tensor) -> Tensor:
        """Return the features behind the last layer, (run, feature)."""
        x = x.permute(0, 2, 1)
        for convolution in self.convolutions:
            x = torch.relu(convolution(x))
        pooled = torch.cat([x.mean(dim=2), x.amax(dim=2)], dim=1)
        return self.dropout(torch.relu(self.hidden(pooled)))

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (run, class)."""
        return self.dense(self.seen(x))


class Tcn(nn.Module):
    """Temporal convolutions: five causal, dilated residual blocks, last step (Bai et al., 2018)."""

    DILATIONS = (1, 2, 4, 8, 16)
    KERNEL = 3

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.first = nn.Conv1d(channels, WIDTH, 1)
        self.blocks = nn.ModuleList(
            nn.Conv1d(WIDTH, WIDTH, self.KERNEL, dilation=d) for d in self.DILATIONS
        )
        self.dropout = nn.Dropout1d(DROPOUT)  # of whole channels, as there
        self.dense = nn.Linear(WIDTH, classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (run, class)."""
        x = self.first(x.permute(0, 2, 1))
        for block, dilation in zip(self.blocks, self.DILATIONS, strict=True):
            past = nn.functional.pad(x, ((self.KERNEL - 1) * dilation, 0))
            x = x + self.dropout(torch.relu(block(past)))
        return self.dense(x[:, :, -1])


class Transformer(nn.Module):
    """Two encoder layers with learned positions, mean over time (Vaswani et al., 2017).

    A token holds two points, which takes half of the time.
    """

    PATCH = 2

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.embed = nn.Linear(self.PATCH * channels, WIDTH)
        self.position = nn.Parameter(0.02 * torch.randn(POINTS // self.PATCH, WIDTH))
        layer = nn.TransformerEncoderLayer(WIDTH, 4, 2 * WIDTH, DROPOUT, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
        self.dense = nn.Linear(WIDTH, classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (run, class)."""
        tokens = self.embed(x.reshape(len(x), POINTS // self.PATCH, -1))
        return self.dense(self.layers(tokens + self.position).mean(dim=1))


NETWORKS: dict[str, Callable[[int, int], nn.Module]] = {
    "lstm": PaperLstm,
    "cnn": Cnn,
    "tcn": Tcn,
    "transformer": Transformer,
}
"""The networks on features by name."""


def build_network(name: str, channels: int, classes: int) -> nn.Module:
    """Return a new network with random weights from torch's generator.

    Points have so many channels; the network tells so many classes apart.
    """
    if name not in NETWORKS:
        raise unknown_name("network", name, NETWORKS)
    return NETWORKS[name](channels, classes)


# Training loop.

Batch = tuple[Floats, IntArray]
"""Standardised features (run, point, channel) and classes (run,)."""

DEVICES = ("auto", "cpu", "cuda")
"""Where networks are trained; auto: on a GPU if there is one."""


def device_of(name: str) -> torch.device:
    """Return a device by its name.

    Raises:
        InputError: If there is none.
    """
    if name not in DEVICES:
        raise unknown_name("device", name, DEVICES)
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no GPU. Use --device auto or cpu.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


EVALUATED_RUNS = 512
"""Runs evaluated at a time."""


def training(
    network: nn.Module,
    batches: Iterable[Batch],
    iterations: int,
    learning_rate: float = 1e-3,
    decay: bool = False,
    device: str = "auto",
) -> Iterator[int]:
    """Train a network in place by Adam with cross-entropy loss.

    With `decay` the learning rate falls to zero along half a cosine; `device` is one of `DEVICES`.
    Yields the number of iterations after each; needs at least as many batches.
    """
    where = device_of(device)
    network.to(where)
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    schedule = CosineAnnealingLR(optimizer, iterations) if decay else ConstantLR(optimizer, 1.0)
    measure = nn.CrossEntropyLoss()

    def loss_of(batch: Batch) -> Tensor:
        features, classes = (torch.from_numpy(values).to(where) for values in batch)
        loss: Tensor = measure(network(features), classes)
        return loss

    return descent(network, islice(batches, iterations), loss_of, schedule)


def descent(
    network: nn.Module,
    batches: Iterable[T],
    loss_of: Callable[[T], Tensor],
    schedule: LRScheduler,
    clip: float | None = None,
) -> Iterator[int]:
    """Train a network in place by the optimizer of a schedule; yields how many batches are done.

    `clip` is the largest norm of the gradient of all weights; None: any.
    """
    for done, batch in enumerate(batches, start=1):
        network.train()
        schedule.optimizer.zero_grad()
        torch.autograd.backward(loss_of(batch))
        if clip is not None:
            nn.utils.clip_grad_norm_(network.parameters(), clip)
        schedule.optimizer.step()
        schedule.step()
        yield done


def scores_of(network: nn.Module, features: Floats) -> FloatArray:
    """Return the logits of runs, (run, class)."""
    where = next(network.parameters()).device
    network.eval()
    parts = []
    with torch.inference_mode():
        for first in range(0, len(features), EVALUATED_RUNS):
            some = torch.from_numpy(features[first : first + EVALUATED_RUNS]).to(where)
            parts.append(network(some).double().cpu().numpy())
    return np.concatenate(parts)


def shuffled_batches(
    features: Floats, classes: IntArray, size: int, rng: np.random.Generator
) -> Iterator[Batch]:
    """Yield batches without end, in a new random order each epoch."""
    for chosen in shuffled(len(features), size, rng):
        yield features[chosen], classes[chosen]


def shuffled(runs: int, size: int, rng: np.random.Generator) -> Iterator[IntArray]:
    """Yield the runs of full batches without end, in a new random order each epoch."""
    size = min(size, runs)
    while True:
        order: IntArray = rng.permutation(runs)
        for first in range(0, runs - size + 1, size):
            yield order[first : first + size]


@dataclass(frozen=True)
class Standard:
    """Standardisation of each channel to zero mean and unit variance.

    Attributes:
        mean: (channel,).
        spread: Standard deviation, (channel,); 1 for a constant channel.
    """

    mean: NDArray[np.float32]
    spread: NDArray[np.float32]

    @classmethod
    def of(cls, features: Floats) -> Standard:
        """Return the standardisation fitted to features (run, point, channel)."""
        flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
        spread = flat.std(axis=0)
        spread[spread < 1e-12] = 1.0
        return cls(flat.mean(axis=0).astype(np.float32), spread.astype(np.float32))

    def __call__(self, features: Floats) -> Floats:
        """Return standardised features."""
        return (features - self.mean) / self.spread


# Adversarial adaptation to target runs without labels.


class _Reversed(torch.autograd.Function):
    """The identity, whose gradient has the other sign and another strength."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, strength: float) -> Tensor:
        ctx.strength = strength
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return -ctx.strength * gradient, None


def adversarial_training(
    network: Cnn,
    batches: Iterable[Batch],
    target: Floats,
    iterations: int,
    learning_rate: float,
    rng: np.random.Generator,
) -> Iterator[int]:
    """Train a CNN so that its features do not tell simulated from target runs (DANN).

    Ganin et al., JMLR 2016: a second head, behind a reversed gradient, learns to tell them apart.
    Its strength rises from 0 to 1 as 2 / (1 + exp(-10 p)) - 1. Target runs have no labels. The
    learning rate falls to zero along half a cosine.
    """
    judge = nn.Sequential(nn.LazyLinear(WIDTH), nn.ReLU(), nn.Linear(WIDTH, 2))
    measure, reverse = nn.CrossEntropyLoss(), cast("Any", _Reversed.apply)
    judge(network.seen(torch.from_numpy(target[:2])))  # sets the size of the lazy layer
    optimizer = torch.optim.Adam([*network.parameters(), *judge.parameters()], lr=learning_rate)
    schedule = CosineAnnealingLR(optimizer, iterations)
    others = shuffled_batches(target, np.zeros(len(target), dtype=np.int64), len(target), rng)

    def loss_of(numbered: tuple[int, Batch]) -> Tensor:
        done, (features, classes) = numbered
        strength = 2.0 / (1.0 + float(np.exp(-10.0 * done / iterations))) - 1.0
        simulated = network.seen(torch.from_numpy(features))
        measured = network.seen(torch.from_numpy(next(others)[0][: len(features)]))
        both: Tensor = reverse(torch.cat([simulated, measured]), strength)
        origin = torch.cat([torch.zeros(len(simulated)), torch.ones(len(measured))]).long()
        loss = measure(network.dense(simulated), torch.from_numpy(classes))
        whole: Tensor = loss + measure(judge(both), origin)
        return whole

    return descent(network, enumerate(islice(batches, iterations), start=1), loss_of, schedule)
