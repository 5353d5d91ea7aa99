"""Networks on features and their training loop: the paper's LSTM, and a CNN.

Each maps standardised features (run, point, channel) to logits (run, class).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.lr_scheduler import ConstantLR, CosineAnnealingLR

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.feature_encoder import Floats

HIDDEN = 100
"""Units of both LSTM layers (Table I of the paper)."""
DROPOUT = 0.1
"""Dropout rate (Table I of the paper)."""
CNN_WIDTH = 96
STRIDES = (1, 2, 2, 1)
"""Stride of each convolution: 100 points become 50, then 25."""
KERNEL = 5
"""Kernel size of each convolution [points]."""


@dataclass(frozen=True)
class Shape:
    """Input and output sizes of a network.

    Attributes:
        channels: Channels of each point.
        classes: Number of classes.
    """

    channels: int
    classes: int


class PaperLstm(nn.Module):
    """The paper's network: LSTM 100, dropout 0.1, LSTM 100, last step, one dense layer."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.first = nn.LSTM(shape.channels, HIDDEN, batch_first=True)
        self.dropout = nn.Dropout(DROPOUT)
        self.second = nn.LSTM(HIDDEN, HIDDEN, batch_first=True)
        self.dense = nn.Linear(HIDDEN, shape.classes)
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

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        wide = CNN_WIDTH
        self.convolutions = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2)
            for taken, stride in zip((shape.channels, wide, wide, wide), STRIDES, strict=True)
        )
        self.dropout = nn.Dropout(DROPOUT)
        self.hidden = nn.Linear(2 * wide, wide)
        self.dense = nn.Linear(wide, shape.classes)

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


NETWORKS: dict[str, type[PaperLstm] | type[Cnn]] = {"lstm": PaperLstm, "cnn": Cnn}
"""The networks on features by name."""


def build_network(name: str, shape: Shape) -> nn.Module:
    """Return a new network with random weights from torch's generator."""
    if name not in NETWORKS:
        raise unknown_name("network", name, NETWORKS)
    return NETWORKS[name](shape)


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
    for done, (features, classes) in enumerate(islice(batches, iterations), start=1):
        network.train()
        optimizer.zero_grad()
        scores = network(torch.from_numpy(features).to(where))
        measure(scores, torch.from_numpy(classes).to(where)).backward()
        optimizer.step()
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
    while True:
        yield from epoch(features, classes, min(size, len(features)), rng)


def epoch(
    features: Floats, classes: IntArray, size: int, rng: np.random.Generator
) -> Iterator[Batch]:
    """Yield the full batches of one epoch in random order."""
    order = rng.permutation(len(features))
    for first in range(0, len(order) - size + 1, size):
        chosen = order[first : first + size]
        yield features[chosen], classes[chosen]


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
