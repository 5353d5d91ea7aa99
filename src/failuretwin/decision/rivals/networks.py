"""Adversarial adaptation of a network to target runs without labels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from failuretwin.decision.learned.networks import WIDTH, Batch, Cnn, descent, shuffled_batches


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
