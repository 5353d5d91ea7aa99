"""Endless labelled runs of robots of any arm, for the motor-wise network."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, islice
from typing import TYPE_CHECKING, Any

import numpy as np
from torch.utils.data import DataLoader, Dataset

from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Hypothesis, single_faults
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.motorwise import Batch, Labels
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.nonidealities import SETTLING_LISTS, Imperfections, vary
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.observation.healthy_model import HealthyModel

if TYPE_CHECKING:
    import xarray as xr

Range = tuple[float, float]

COUNT_RAD = float(np.deg2rad(0.24))
"""One servo count [rad]; the error ranges below are in counts of this servo."""
RUNS_PER_CLASS = 10**9
"""Runs of each class reserved per seed; more than any training uses."""


@dataclass(frozen=True)
class Kind:
    """One kind of runs.

    Attributes:
        error_counts: Range of steady-state errors [counts of 0.24 deg] of an arm that scatters
            as an ArmPi does.
        onset_s: Range of the onset of stuck motors [s].
        error_onset_s: Range of the onset of errors [s].
        movements: Movements in a run.
        first_motor_deg: Largest target of the first motor, to both sides [deg]; None: as in the
            robot's profile.
    """

    error_counts: Range
    onset_s: Range
    error_onset_s: Range = (0.0, 0.0)
    movements: int = 5
    first_motor_deg: float | None = None


KINDS = (
    Kind((4.0, 20.0), (0.49, 0.49), first_motor_deg=70.0),
    Kind((5.0, 20.0), (0.0, 0.0)),
    Kind((7.0, 35.0), (0.0, 8.0)),
    Kind((10.0, 50.0), (0.0, 1.0)),
    Kind((4.0, 12.0), (0.2, 0.8), first_motor_deg=70.0),
    Kind((4.0, 20.0), (0.0, 2.5)),
    Kind((5.0, 30.0), (0.0, 8.0), (0.0, 6.0)),
    Kind((5.0, 20.0), (0.0, 3.0), movements=3),
    Kind((4.0, 20.0), (0.0, 12.0), movements=8),
)
"""Small errors are the hardest, so they are the most frequent; the paper's are 10 to 50 counts."""
USUAL_SCATTER_RAD = 0.005
"""Scatter of the motors of an arm whose errors are as large as `KINDS` says [rad]."""
LEAST_FACTOR, MOST_FACTOR = 0.5, 1.5
"""Bounds of the factor on sizes of errors by the scatter of an arm."""
WIDENING = (1.0, 1.5, 2.0)
"""Factors on the variation of robots about what is known of them."""
KNOWN_SHARE = 0.3
"""Deviations of a robot that was drawn from its class and calibrated, in those of the class."""


@dataclass(frozen=True)
class PopulationData:
    """Endless labelled runs of several arms, reproducible by seed.

    Attributes:
        robots: The arms, with what is known of each.
        modes: Modes of fault, by id.
        seed: Random seed.
        engine: Simulation engine; see `Plan`.
        widening: Factors on the variation of robots, one drawn for each chunk, all of which are
            known by their calibration; None: `WIDENING`, and some are known by their class alone,
            or are drawn from it and calibrated.
    """

    robots: tuple[CalibratedRobot, ...]
    modes: Mapping[str, FaultMode]
    seed: int = 0
    engine: str = "servo"
    widening: tuple[float, ...] | None = None

    def chunk(self, number: int, runs: int) -> Chunk:
        """Return tokens and labels of the runs of a chunk, all of one arm, in random order."""
        known = self._known(number)
        encoder = MomentEncoder(known.robot, known.imperfections)
        tables = [table.to_dataset() for table in self._tables(number, runs, known)]
        tokens = Tokens.joined([encoder.encode(table) for table in tables])
        labels = Labels.joined([self.labels(table, known.robot) for table in tables])
        order = np.random.default_rng([self.seed, number, 1]).permutation(len(tokens))
        return tokens[order], labels[order]

    def run_set(self, number: int, runs: int) -> xr.Dataset:
        """Return the runs of five movements of a chunk as a run set with their truth."""
        known = self._known(number)
        tables = self._tables(number, runs, known, [k for k in KINDS if k.movements == 5])
        return concatenate([table.to_dataset() for table in tables])

    def labels(self, runs: xr.Dataset, robot: Robot) -> Labels:
        """Return the truth of a run set."""
        faults = [str(name) for name in runs["fault"].values]
        return Labels.of_runs(runs, faults, robot.motor_names, list(self.modes))

    def _known(self, number: int) -> CalibratedRobot:
        """Return the arm of a chunk, with what is known of it.

        That is its calibration, its class, or the calibration of a robot drawn from the class.
        """
        arm = self.robots[number % len(self.robots)]
        turn = (number // len(self.robots)) % 4
        if self.widening is not None or turn < 2:
            return arm
        of_class = generic_imperfections(arm.robot)
        figures = replace(
            arm.imperfections, settling=of_class.settling, variation=of_class.variation
        )
        if turn == 2:
            return CalibratedRobot(arm.robot, replace(figures, of_class=True))
        rng = np.random.default_rng([self.seed, number, 2])
        drawn = replace(vary(figures, rng), variation=figures.variation)
        return CalibratedRobot(arm.robot, replace(widened(drawn, KNOWN_SHARE), of_class=False))

    @cached_property
    def _factors(self) -> dict[str, float]:
        """Factor on sizes of errors, by arm."""
        scatter = {
            arm.robot.name: float(np.median(HealthyModel.of(arm).scatter)) for arm in self.robots
        }
        least, most = LEAST_FACTOR, MOST_FACTOR
        return {n: float(np.clip(s / USUAL_SCATTER_RAD, least, most)) for n, s in scatter.items()}

    def _tables(
        self, number: int, runs: int, known: CalibratedRobot, kinds: Sequence[Kind] = KINDS
    ) -> list[RunTable]:
        rng = np.random.default_rng([self.seed, number])
        hypotheses = single_faults(known.robot.motor_names, self.modes)
        factors = self.widening or WIDENING
        true = widened(known.imperfections, factors[rng.integers(len(factors))])
        found = []
        for kind, places in zip(kinds, np.array_split(np.arange(runs), len(kinds)), strict=True):
            if not len(places):
                continue
            plan = self._plan(kind, known.robot, true, hypotheses)
            classes = rng.integers(0, len(hypotheses), len(places))
            first = number * runs
            numbers = [c * RUNS_PER_CLASS + first + i for c, i in zip(classes, places, strict=True)]
            found.append(simulate_runs(plan, [int(n) for n in numbers]))
        return found

    def _plan(
        self, kind: Kind, robot: Robot, true: Imperfections, hypotheses: Sequence[Hypothesis]
    ) -> Plan:
        scale = COUNT_RAD * self._factors[robot.name]
        low, high = kind.error_counts
        known = {
            "stuck": Stuck(onset_s=kind.onset_s),
            "steady_state_error": SteadyStateError(
                magnitude=(low * scale, high * scale), onset_s=kind.error_onset_s
            ),
        }
        return Plan(
            robot=_with_range(robot, kind.first_motor_deg),
            hypotheses=hypotheses,
            runs_per_class=RUNS_PER_CLASS,
            seed=self.seed,
            imperfections=true,
            movements=RandomMovements(count=kind.movements),
            modes={**self.modes, **{k: v for k, v in known.items() if k in self.modes}},
            engine=self.engine,
        )


def _with_range(robot: Robot, degrees: float | None) -> Robot:
    """Return the robot with targets of the first motor within so many degrees at most."""
    if degrees is None:
        return robot
    first, *others = robot.motors
    low, high = first.movement_range
    limit = float(np.deg2rad(degrees))
    motors = (replace(first, movement_range=(max(low, -limit), min(high, limit))), *others)
    return replace(robot, profile=replace(robot.profile, motors=motors))


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


# Endless batches, simulated by other processes while the network learns.

CHUNK_RUNS = 576
"""Runs of one arm simulated at a time."""
AHEAD = 2
"""Chunks prepared in advance by each process."""
Chunk = tuple[Tokens, Labels]


@dataclass(frozen=True)
class _Chunks(Dataset[Chunk]):
    """Chunks of simulated runs by number."""

    data: PopulationData
    runs: int

    def __getitem__(self, number: int) -> Chunk:
        return self.data.chunk(number, self.runs)


def _as_made(chunk: Any) -> Any:
    """Return a chunk of arrays, not of tensors."""
    return chunk


@dataclass(frozen=True)
class PopulationStream:
    """Batches of simulated runs, each of one arm; they depend on `data` alone.

    Attributes:
        data: Source of the runs.
        batch_of: Turns tokens and labels into what the network learns.
        batch_runs: Runs in a batch.
        uses: Number of batches that each run is part of.
    """

    data: PopulationData
    batch_of: Callable[[Tokens, Labels], Batch]
    batch_runs: int = 64
    uses: int = 4

    def chunks(self) -> Generator[Chunk]:
        """Yield chunks of new runs without end, one arm after the other.

        Other processes make them: scripts must be guarded by ``if __name__ == "__main__":``.
        """
        loader: DataLoader[Chunk] = DataLoader(
            _Chunks(self.data, CHUNK_RUNS),
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

    def batches(self, chunks: Iterator[Chunk]) -> Iterator[Batch]:
        """Yield shuffled batches of the last `uses` chunks of every arm, arms in random order."""
        rng = np.random.default_rng([self.data.seed, CHUNK_RUNS])
        arms, size = len(self.data.robots), self.batch_runs
        in_use: deque[list[Batch]] = deque(maxlen=self.uses)
        while True:
            made = [self.batch_of(*chunk) for chunk in islice(chunks, arms)]
            if len(made) < arms:
                return
            in_use.append(made)
            known = [Batch.joined(parts) for parts in zip(*in_use, strict=True)]
            places = [
                (arm, runs)
                for arm, batch in enumerate(known)
                for runs in alike(batch.tokens.lengths, size, rng)
            ]
            for at in rng.permutation(len(places)).tolist():
                arm, runs = places[at]
                yield known[arm][runs].cut()


def alike(lengths: IntArray, size: int, rng: np.random.Generator) -> list[IntArray]:
    """Return the runs of full batches, in random order, each of runs of one length."""
    found = []
    for length in np.unique(lengths):
        order = rng.permutation(np.flatnonzero(lengths == length))
        found += [order[at : at + size] for at in range(0, len(order) - size + 1, size)]
    return found
