"""What a network is trained on: runs as various as a real robot may make them, without end.

Other processes make them while a network learns.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, Floats, signals_of
from failuretwin.decision.learned.networks import epoch
from failuretwin.digital_model.nonidealities import SETTLING_LISTS, Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import MODES, SteadyStateError, Stuck
from failuretwin.failure_behavior.random_movements import RandomMovements

if TYPE_CHECKING:
    import xarray as xr

Range = tuple[float, float]

COUNT_RAD = float(np.deg2rad(0.24))
"""One count of the servos whose errors the ranges below were found on [rad]."""
RUNS_PER_CLASS = 10**9
"""Runs of each class that a seed has room for: more than any training sees."""


@dataclass(frozen=True)
class Variant:
    """One kind of runs.

    Attributes:
        error_counts: Range of steady-state errors [counts of 0.24 deg].
        onset_s: Range of the onset of stuck faults [s]; 0: before the run.
        first_motor_deg: Range of the first motor's targets to both sides [deg]; None: as the
            robot's profile says.
    """

    error_counts: Range
    onset_s: Range
    first_motor_deg: float | None = None


VARIANTS = (
    Variant((4.0, 20.0), (0.49, 0.49), 70.0),
    Variant((5.0, 20.0), (0.0, 0.0)),
    Variant((7.0, 35.0), (0.49, 0.49)),
    Variant((10.0, 50.0), (0.49, 0.49)),
    Variant((4.0, 12.0), (0.49, 0.49), 70.0),
    Variant((4.0, 20.0), (0.0, 2.0)),
)
"""Small errors are the hard ones, so they come most often; the paper's are 10 to 50 counts."""


@dataclass(frozen=True)
class TrainingData:
    """An endless supply of labelled runs, the same for the same seed.

    Attributes:
        robot: The robot.
        imperfections: Its healthy behaviour, with the variation to draw robots from.
        seed: Seed of all chance.
        variants: Kinds of runs, equally frequent.
        engine: What moves the robot; see `Plan`.
    """

    robot: Robot
    imperfections: Imperfections
    seed: int = 0
    variants: tuple[Variant, ...] = VARIANTS
    engine: str = "servo"

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The classes: those of the paper."""
        return paper_hypotheses(self.robot.motor_names)

    @property
    def movements(self) -> tuple[int, int]:
        """Fewest and most movements of a run."""
        count = RandomMovements().count
        return count, count

    def chunk(self, number: int, runs: int, encoder: FeatureEncoder) -> tuple[Floats, IntArray]:
        """Return some runs as features, with their classes, in random order.

        Args:
            number: Number of the chunk; each has runs of its own.
            runs: How many; a variant has as many as another.
            encoder: Makes the features.
        """
        made = [
            (places, encoder.encode(signals_of(table)))
            for places, table in self._made(number, runs)
        ]
        order = np.concatenate([places for places, _ in made])
        shuffled = np.random.default_rng([self.seed, number, 1]).permutation(runs)
        features = np.concatenate([part for _, part in made])
        return features[shuffled], self._classes(number, runs)[order[shuffled]]

    def run_set(self, number: int, runs: int) -> xr.Dataset:
        """Return the runs of a chunk as a run set that knows their truth."""
        return concatenate([table.to_dataset() for _, table in self._made(number, runs)])

    def _classes(self, number: int, runs: int) -> IntArray:
        rng = np.random.default_rng([self.seed, number])
        return rng.integers(0, len(self.hypotheses), runs)

    def _made(self, number: int, runs: int) -> Iterator[tuple[IntArray, RunTable]]:
        """Give the runs of each variant, and their places among the classes of the chunk."""
        classes = self._classes(number, runs)
        for kind, variant in enumerate(self.variants):
            places = np.arange(kind, runs, len(self.variants))
            if len(places):
                numbers = [
                    int(classes[i]) * RUNS_PER_CLASS + number * runs + int(i) for i in places
                ]
                yield places, simulate_runs(self._plan(variant), numbers)

    def _plan(self, variant: Variant) -> Plan:
        return Plan(
            robot=_with_range(self.robot, variant.first_motor_deg),
            hypotheses=self.hypotheses,
            runs_per_class=RUNS_PER_CLASS,
            seed=self.seed,
            imperfections=self.imperfections,
            movements=RandomMovements(),
            modes=_modes(variant),
            engine=self.engine,
        )


def _modes(variant: Variant) -> Mapping[str, FaultMode]:
    low, high = variant.error_counts
    return {
        **MODES,
        "stuck": Stuck(onset_s=variant.onset_s),
        "steady_state_error": SteadyStateError(magnitude=(low * COUNT_RAD, high * COUNT_RAD)),
    }


def _with_range(robot: Robot, degrees: float | None) -> Robot:
    """Return the robot with another range of the first motor's targets."""
    if degrees is None:
        return robot
    first, *others = robot.motors
    limit = float(np.deg2rad(degrees))
    motors = (replace(first, movement_range=(-limit, limit)), *others)
    return replace(robot, profile=replace(robot.profile, motors=motors))


def widened(imperfections: Imperfections, factor: float) -> Imperfections:
    """Return imperfections whose robots differ `factor` times as much from each other.

    A calibration knows its figures well on the day of its logs; on another day, and with another
    tool, they are a little different.
    """
    variation = imperfections.variation
    if variation is None:
        return imperfections
    wider: dict[str, Any] = {
        name: tuple(factor * value for value in getattr(variation, name)) for name in SETTLING_LISTS
    }
    wider["rates"] = factor * variation.rates
    return replace(imperfections, variation=replace(variation, **wider))


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

    They depend on `data` alone, not on how many processes make the runs.

    Attributes:
        data: What runs are made.
        encoder: What networks see of them.
        batch_runs: Runs in a batch.
        uses: Batches that a run is part of before it is thrown away; 1: none is seen twice.
    """

    data: TrainingData
    encoder: FeatureEncoder
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
                given.append(pool.submit(self.data.chunk, number, CHUNK_RUNS, self.encoder))
                number += 1
            yield given.popleft().result()

    def batches(self, chunks: Iterator[Chunk]) -> Iterator[Chunk]:
        """Give batches from chunks: each fresh chunk is shuffled with those still in use.

        Args:
            chunks: Fresh runs, as `chunks` gives them.
        """
        rng = np.random.default_rng([self.data.seed, CHUNK_RUNS])
        in_use: deque[Chunk] = deque(maxlen=self.uses)
        for chunk in chunks:
            in_use.append(chunk)
            features, classes = (np.concatenate(parts) for parts in zip(*in_use, strict=True))
            yield from epoch(features, classes, self.batch_runs, rng)
