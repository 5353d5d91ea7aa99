"""Networks of others: temporal convolutions, attention, and adversarial adaptation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from failuretwin.decision.learned.feature_encoder import POINTS
from failuretwin.decision.learned.networks import (
    DROPOUT,
    Batch,
    Cnn,
    Shape,
    build_network,
    shuffled_batches,
)

WIDTH = 64
"""Channels of both networks."""


class Tcn(nn.Module):
    """Temporal convolutions: five causal, dilated residual blocks, last step (Bai et al., 2018)."""

    DILATIONS = (1, 2, 4, 8, 16)
    KERNEL = 3

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.first = nn.Conv1d(shape.channels, WIDTH, 1)
        self.blocks = nn.ModuleList(
            nn.Conv1d(WIDTH, WIDTH, self.KERNEL, dilation=d) for d in self.DILATIONS
        )
        self.dropout = nn.Dropout1d(DROPOUT)  # of whole channels, as there
        self.dense = nn.Linear(WIDTH, shape.classes)

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

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.embed = nn.Linear(self.PATCH * shape.channels, WIDTH)
        self.position = nn.Parameter(0.02 * torch.randn(POINTS // self.PATCH, WIDTH))
        layer = nn.TransformerEncoderLayer(WIDTH, 4, 2 * WIDTH, DROPOUT, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
        self.dense = nn.Linear(WIDTH, shape.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (run, class)."""
        tokens = self.embed(x.reshape(len(x), POINTS // self.PATCH, -1))
        return self.dense(self.layers(tokens + self.position).mean(dim=1))


def build(name: str, shape: Shape) -> nn.Module:
    """Return a new network of this package or of others."""
    own: dict[str, type[nn.Module]] = {"tcn": Tcn, "transformer": Transformer}
    return own[name](shape) if name in own else build_network(name, shape)


# Adversarial adaptation.


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
    target: np.ndarray[Any, np.dtype[np.float32]],
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
    for done, (features, classes) in enumerate(islice(batches, iterations), start=1):
        network.train()
        optimizer.zero_grad()
        strength = 2.0 / (1.0 + float(np.exp(-10.0 * done / iterations))) - 1.0
        simulated = network.seen(torch.from_numpy(features))
        measured = network.seen(torch.from_numpy(next(others)[0][: len(features)]))
        both: Tensor = reverse(torch.cat([simulated, measured]), strength)
        origin = torch.cat([torch.zeros(len(simulated)), torch.ones(len(measured))]).long()
        loss = measure(network.dense(simulated), torch.from_numpy(classes))
        (loss + measure(judge(both), origin)).backward()
        optimizer.step()
        schedule.step()
        yield done
