"""Endless labelled runs of a robot around its calibration, simulated while a network learns."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from torch.utils.data import DataLoader, Dataset

from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, Floats, signals_of
from failuretwin.decision.learned.networks import Batch, epoch
from failuretwin.digital_model.nonidealities import SETTLING_LISTS, Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    import xarray as xr

Range = tuple[float, float]

COUNT_RAD = float(np.deg2rad(0.24))
"""One servo count [rad]; the error ranges below are in counts of this servo."""
RUNS_PER_CLASS = 10**9
"""Runs of each class reserved per seed; more than any training uses."""


@dataclass(frozen=True)
class Variant:
    """One kind of runs.

    Attributes:
        error_counts: Range of steady-state errors [counts of 0.24 deg].
        onset_s: Range of the onset of stuck faults [s]; 0: before the run.
        first_motor_deg: Largest target of the first motor, to both sides [deg]; None: as in the
            robot's profile.
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
"""Small errors are the hardest, so they are the most frequent; the paper's are 10 to 50 counts."""


@dataclass(frozen=True)
class TrainingData:
    """Endless labelled runs, reproducible by seed.

    Attributes:
        robot: The robot.
        imperfections: Its healthy behaviour, with the variation between robots.
        seed: Random seed.
        engine: Simulation engine; see `Plan`.
        hypotheses: The classes; empty: the paper's.
        modes: Fault modes by id, which other processes would not have registered; `VARIANTS`
            override magnitude and onset of the paper's modes.
    """

    robot: Robot
    imperfections: Imperfections
    seed: int = 0
    engine: str = "servo"
    hypotheses: tuple[Hypothesis, ...] = ()
    modes: Mapping[str, FaultMode] = field(default_factory=lambda: dict(MODES))

    def __post_init__(self) -> None:
        if not self.hypotheses:
            object.__setattr__(self, "hypotheses", paper_hypotheses(self.robot.motor_names))

    @property
    def movements(self) -> tuple[int, int]:
        """Smallest and largest number of movements of a run."""
        count = RandomMovements().count
        return count, count

    def chunk(self, number: int, runs: int, encoder: FeatureEncoder) -> tuple[Floats, IntArray]:
        """Return features and classes of the runs of a chunk, in random order.

        Chunks of different numbers share no runs; variants are equally frequent in each.
        """
        made = [(at, encoder.encode(signals_of(table))) for at, table in self._made(number, runs)]
        order, features = (np.concatenate(parts) for parts in zip(*made, strict=True))
        shuffled = np.random.default_rng([self.seed, number, 1]).permutation(runs)
        return features[shuffled], self._classes(number, runs)[order[shuffled]]

    def run_set(self, number: int, runs: int) -> xr.Dataset:
        """Return the runs of a chunk as a run set with their truth."""
        return concatenate([table.to_dataset() for _, table in self._made(number, runs)])

    def _classes(self, number: int, runs: int) -> IntArray:
        rng = np.random.default_rng([self.seed, number])
        return rng.integers(0, len(self.hypotheses), runs)

    def _made(self, number: int, runs: int) -> Iterator[tuple[IntArray, RunTable]]:
        """Yield the runs of each variant with their indices in the chunk."""
        classes = self._classes(number, runs)
        for kind, variant in enumerate(VARIANTS):
            places = np.arange(kind, runs, len(VARIANTS))
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
            modes={**self.modes, **_modes_of(variant)},
            engine=self.engine,
        )


def _modes_of(variant: Variant) -> Mapping[str, FaultMode]:
    low, high = variant.error_counts
    return {
        "stuck": Stuck(onset_s=variant.onset_s),
        "steady_state_error": SteadyStateError(magnitude=(low * COUNT_RAD, high * COUNT_RAD)),
    }


def _with_range(robot: Robot, degrees: float | None) -> Robot:
    """Return the robot with another target range of the first motor."""
    if degrees is None:
        return robot
    first, *others = robot.motors
    limit = float(np.deg2rad(degrees))
    motors = (replace(first, movement_range=(-limit, limit)), *others)
    return replace(robot, profile=replace(robot.profile, motors=motors))


WIDER = 2.0
"""Factor on the calibration's variation between robots in training."""


def widened(imperfections: Imperfections, factor: float) -> Imperfections:
    """Return imperfections with `factor` times the variation between robots.

    A calibration describes the day of its logs; other days and tools differ more than it states.
    """
    variation = imperfections.variation
    if variation is None:
        return imperfections
    wider: dict[str, Any] = {
        name: tuple(factor * value for value in getattr(variation, name)) for name in SETTLING_LISTS
    }
    wider["rates"] = factor * variation.rates
    return replace(imperfections, variation=replace(variation, **wider))


# Endless training batches, simulated by other processes while a network learns.

CHUNK_RUNS = 576
"""Runs simulated at a time."""
AHEAD = 2
"""Chunks prepared in advance by each process."""


C = TypeVar("C")
"""What a chunk is."""


@dataclass(frozen=True)
class _Chunks(Dataset[C]):
    """Chunks of simulated runs by number."""

    make: Callable[[int], C]

    def __getitem__(self, number: int) -> C:
        return self.make(number)


def _as_made(chunk: C) -> C:
    """Return a chunk of arrays, not of tensors."""
    return chunk


def simulated_chunks(make: Callable[[int], C]) -> Generator[C]:
    """Yield chunks of new runs without end, in order; other processes make them by their number.

    Scripts must be guarded by ``if __name__ == "__main__":``.
    """
    loader: DataLoader[C] = DataLoader(
        _Chunks(make),
        batch_size=None,
        sampler=count(),
        num_workers=max(1, (os.cpu_count() or 1) - 1),
        prefetch_factor=AHEAD,
        collate_fn=_as_made,
        multiprocessing_context="spawn",
    )
    try:
        yield from loader
    except RuntimeError as error:
        raise FailureTwinError(
            "a process that simulates runs has ended. Look for the cause, such as too little "
            "memory, and start again."
        ) from error


@dataclass(frozen=True)
class Stream:
    """Batches of simulated runs; they depend on `data` alone, not on the number of processes.

    Attributes:
        data: Source of the runs.
        encoder: Turns runs into features.
        batch_runs: Runs in a batch.
        uses: Number of batches that each run is part of.
    """

    data: TrainingData
    encoder: FeatureEncoder
    batch_runs: int = 64
    uses: int = 6

    def chunks(self) -> Generator[Batch]:
        """Yield chunks of new runs; see `simulated_chunks`."""
        return simulated_chunks(partial(self.data.chunk, runs=CHUNK_RUNS, encoder=self.encoder))

    def batches(self, chunks: Iterator[Batch]) -> Iterator[Batch]:
        """Yield shuffled batches of the last `uses` chunks."""
        rng = np.random.default_rng([self.data.seed, CHUNK_RUNS])
        in_use: deque[Batch] = deque(maxlen=self.uses)
        for chunk in chunks:
            in_use.append(chunk)
            features, classes = (np.concatenate(parts) for parts in zip(*in_use, strict=True))
            yield from epoch(features, classes, self.batch_runs, rng)
