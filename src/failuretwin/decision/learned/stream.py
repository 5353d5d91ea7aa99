"""Training batches that never end, made by other processes while a network learns."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import FailureTwinError
from failuretwin.core.types import IntArray
from failuretwin.decision.learned.encoder import Encoder, Floats
from failuretwin.decision.learned.recipe import Recipe

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
