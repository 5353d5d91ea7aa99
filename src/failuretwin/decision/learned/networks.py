"""The networks: the paper's LSTM, a plain CNN, and one that treats all motors alike.

Each takes standardised features (run, point, channel) and gives a score for each class
(run, class), the logarithm of its probability up to a constant.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from failuretwin.core.errors import FailureTwinError, unknown_name
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.data import Recipe
from failuretwin.decision.learned.features import Encoder, Floats

HIDDEN = 100
"""Units of both LSTM layers, as published (Table I of the paper)."""
DROPOUT = 0.1
"""Share of units left out in training, as published."""
CNN_WIDTH = 96
MOTORWISE_WIDTH = 64
STRIDES = (1, 2, 2, 1)
"""Points by which each convolution moves on: 100 points become 50, then 25."""
KERNEL = 5
"""Points that a convolution sees, half a second of a run of ten."""


@dataclass(frozen=True)
class Shape:
    """What a network takes and gives.

    Attributes:
        channels: Channels of each point.
        classes: Number of classes.
        motors: Motors whose channels come first, equally many each; 1: all channels are alike.
        shared: Channels after those, which belong to no motor.
    """

    channels: int
    classes: int
    motors: int = 1
    shared: int = 0


class PaperLstm(nn.Module):
    """LSTM 100, dropout 0.1, LSTM 100, its last step, one dense layer: the paper's network."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.first = nn.LSTM(shape.channels, HIDDEN, batch_first=True)
        self.dropout = nn.Dropout(DROPOUT)
        self.second = nn.LSTM(HIDDEN, HIDDEN, batch_first=True)
        self.dense = nn.Linear(HIDDEN, shape.classes)
        for layer in (self.first, self.second):
            _begin_as_published(layer)
        nn.init.xavier_uniform_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        steps, _ = self.first(x)
        steps, _ = self.second(self.dropout(steps))
        return self.dense(steps[:, -1])


def _begin_as_published(layer: nn.LSTM) -> None:
    """Draw weights as MATLAB's `lstmLayer` does, in which the paper's network was built.

    Its documented defaults: Glorot for what comes in, orthogonal for what comes back, biases of
    zero but one for the forget gate. PyTorch's own draw learns more slowly here.
    """
    weights = dict(layer.named_parameters())
    nn.init.xavier_uniform_(weights["weight_ih_l0"])
    nn.init.orthogonal_(weights["weight_hh_l0"])
    nn.init.zeros_(weights["bias_ih_l0"])
    nn.init.zeros_(weights["bias_hh_l0"])
    # Gates in the order input, forget, cell, output.
    nn.init.ones_(weights["bias_ih_l0"][HIDDEN : 2 * HIDDEN])


class Cnn(nn.Module):
    """Four convolutions over time, mean and largest value of each channel, one hidden layer."""

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

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        x = x.transpose(1, 2)
        for convolution in self.convolutions:
            x = torch.relu(convolution(x))
        seen = torch.cat([x.mean(dim=2), x.amax(dim=2)], dim=1)
        return self.dense(self.dropout(torch.relu(self.hidden(seen))))


class MotorWise(nn.Module):
    """The same convolutions look at every motor, each with an eye on the mean of all motors.

    What a stuck motor looks like is learned once, not for each motor anew; only the last layers,
    which name the class, tell the motors apart.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.motors, self.shared = shape.motors, shape.shared
        self.each = (shape.channels - shape.shared) // shape.motors
        wide = MOTORWISE_WIDTH
        sizes = list(zip((self.each + shape.shared, wide, wide, wide), STRIDES, strict=True))
        self.own = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2)
            for taken, stride in sizes
        )
        self.all = nn.ModuleList(
            nn.Conv1d(taken, wide, KERNEL, stride=stride, padding=KERNEL // 2, bias=False)
            for taken, stride in sizes
        )
        self.dropout = nn.Dropout(DROPOUT)
        self.hidden = nn.Linear(2 * wide * shape.motors, 2 * wide)
        self.dense = nn.Linear(2 * wide, shape.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores (run, class)."""
        runs, points, _ = x.shape
        own = self.motors * self.each
        motor = x[:, :, :own].reshape(runs, points, self.motors, self.each)
        common = x[:, :, None, own:].expand(runs, points, self.motors, self.shared)
        x = torch.cat([motor, common], dim=3).permute(0, 2, 3, 1)  # run, motor, channel, point
        for own_part, all_part in zip(self.own, self.all, strict=True):
            each = own_part(x.flatten(0, 1)).unflatten(0, (-1, self.motors))
            x = torch.relu(each + all_part(x.mean(dim=1)).unsqueeze(1))
        seen = torch.cat([x.mean(dim=3), x.amax(dim=3)], dim=2).flatten(1)
        return self.dense(self.dropout(torch.relu(self.hidden(seen))))


NETWORKS: dict[str, type[PaperLstm] | type[Cnn] | type[MotorWise]] = {
    "lstm": PaperLstm,
    "cnn": Cnn,
    "motorwise": MotorWise,
}
"""The networks by name."""


def build_network(name: str, shape: Shape) -> nn.Module:
    """Return a new network with random weights (of torch's generator).

    Raises:
        InputError: If there is no such network.
    """
    if name not in NETWORKS:
        raise unknown_name("network", name, NETWORKS)
    return NETWORKS[name](shape)


# The training loop: one for all networks, whether batches come from arrays or never end.

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


# Training batches that never end, made by other processes while a network learns.

CHUNK_RUNS = 576
"""Runs made at a time."""
AHEAD = 2
"""Chunks made ahead for each process, so that none waits."""

Chunk = tuple[Floats, IntArray]


def cores() -> int:
    """Return how many processes this machine can run at a time."""
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Stream:
    """Batches of runs straight from the generator.

    They depend on the recipe alone, not on how many processes make the runs.

    Attributes:
        recipe: What runs are made.
        encoder: What networks see of them.
        batch_runs: Runs in a batch.
        uses: Batches that a run is part of before it is thrown away; 1: none is seen twice.
    """

    recipe: Recipe
    encoder: Encoder
    batch_runs: int = 64
    uses: int = 6

    @contextmanager
    def chunks(self) -> Iterator[Iterator[Chunk]]:
        """Give chunks of fresh runs without end; leaving the block ends the processes.

        Scripts must be guarded by ``if __name__ == "__main__":``.
        """
        workers = max(1, cores() - 1)
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
        try:
            yield self._in_order(pool, AHEAD * workers)
        except BrokenProcessPool as error:
            raise FailureTwinError(
                "a process that makes runs has died. Look for what ended it, such as too little "
                "memory, and start again."
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _in_order(self, pool: ProcessPoolExecutor, ahead: int) -> Iterator[Chunk]:
        given: deque[Future[Chunk]] = deque()
        number = 0
        while True:
            while len(given) <= ahead:
                given.append(pool.submit(self.recipe.chunk, number, CHUNK_RUNS, self.encoder))
                number += 1
            yield given.popleft().result()

    def batches(self, chunks: Iterator[Chunk]) -> Iterator[Chunk]:
        """Give batches from chunks: each fresh chunk is shuffled with those still in use.

        Args:
            chunks: Fresh runs, as `chunks` gives them.
        """
        rng = np.random.default_rng([self.recipe.seed, CHUNK_RUNS])
        in_use: deque[Chunk] = deque(maxlen=self.uses)
        for chunk in chunks:
            in_use.append(chunk)
            features = np.concatenate([features for features, _ in in_use])
            classes = np.concatenate([classes for _, classes in in_use])
            order = rng.permutation(len(classes))
            for first in range(0, len(order) - self.batch_runs + 1, self.batch_runs):
                chosen = order[first : first + self.batch_runs]
                yield features[chosen], classes[chosen]
