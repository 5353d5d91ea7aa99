"""The training loop: one for all networks, whether batches come from arrays or never end."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.encoder import Floats

Batch = tuple[Floats, IntArray]
"""Standardised features (run, point, channel) and classes (run,)."""

EVALUATED_RUNS = 512
"""Runs that go through a network at a time when nothing is learned."""


@dataclass(frozen=True)
class Pace:
    """How a network learns. Adam, cross-entropy.

    Attributes:
        iterations: Batches to learn from.
        learning_rate: Learning rate of Adam, at its highest.
        decay: Whether the rate falls to zero at the end along half a cosine; else it stays.
    """

    iterations: int
    learning_rate: float = 1e-3
    decay: bool = False

    def rate(self, done: int) -> float:
        """Return the learning rate after some iterations."""
        if not self.decay:
            return self.learning_rate
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / self.iterations))


def device() -> torch.device:
    """Return where networks are trained: a GPU where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def training(network: nn.Module, batches: Iterable[Batch], pace: Pace) -> Iterator[int]:
    """Train a network and give the number of iterations after each, so that it can be looked at.

    Args:
        network: Changed in place.
        batches: As many as `pace` has iterations, or more.
        pace: How to learn.
    """
    where = device()
    network.to(where)
    optimizer = torch.optim.Adam(network.parameters(), lr=pace.learning_rate)
    measure = nn.CrossEntropyLoss()
    source = iter(batches)
    for done in range(pace.iterations):
        features, classes = next(source)
        for group in optimizer.param_groups:
            group["lr"] = pace.rate(done)
        network.train()
        optimizer.zero_grad()
        scores = network(torch.from_numpy(features).to(where))
        loss = measure(scores, torch.from_numpy(classes).to(where))
        loss.backward()
        optimizer.step()
        yield done + 1


def scores_of(network: nn.Module, features: Floats) -> FloatArray:
    """Return the scores of runs, (run, class), without learning anything."""
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
    """Give batches of arrays without end, in a new order each time through.

    What is left at the end of an epoch is left out, unless it is all there is.

    Args:
        features: (run, point, channel).
        classes: (run,).
        size: Runs in a batch.
        rng: Source of chance.
    """
    size = min(size, len(features))
    while True:
        order = rng.permutation(len(features))
        for first in range(0, len(order) - size + 1, size):
            chosen = order[first : first + size]
            yield features[chosen], classes[chosen]


@dataclass(frozen=True)
class Standard:
    """Mean and spread of each channel, so that a network sees numbers of unit size.

    Attributes:
        mean: (channel,).
        spread: Standard deviation, (channel,); 1 for a channel that never changes.
    """

    mean: NDArray[np.float32]
    spread: NDArray[np.float32]

    @classmethod
    def of(cls, features: Floats) -> Standard:
        """Return those of features (run, point, channel)."""
        flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
        spread = flat.std(axis=0)
        spread[spread < 1e-12] = 1.0
        return cls(flat.mean(axis=0).astype(np.float32), spread.astype(np.float32))

    def __call__(self, features: Floats) -> Floats:
        """Return standardised features."""
        return (features - self.mean) / self.spread
