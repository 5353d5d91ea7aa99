"""Training a network on the calibrated twin, without recorded failures."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from torch.utils.data import DataLoader, Dataset

from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.core.types import IntArray
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.decision.evaluation import Judged
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser
from failuretwin.decision.learned.feature_encoder import (
    FeatureEncoder,
    Floats,
    expectation_of,
    signals_of,
)
from failuretwin.decision.learned.log_pool import HybridDiagnoser, fit_pool_weights
from failuretwin.decision.learned.networks import Batch, Standard, epoch
from failuretwin.decision.scoring import Scores
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike, calibrated
from failuretwin.digital_model.nonidealities import SETTLING_LISTS, Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser

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


@dataclass(frozen=True)
class _Chunks(Dataset[Batch]):
    """Chunks of simulated runs by number."""

    data: TrainingData
    encoder: FeatureEncoder
    runs: int

    def __getitem__(self, number: int) -> Batch:
        return self.data.chunk(number, self.runs, self.encoder)


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
        """Yield chunks of new runs without end, in order.

        Scripts must be guarded by ``if __name__ == "__main__":``.
        """
        loader: DataLoader[Batch] = DataLoader(
            _Chunks(self.data, self.encoder, CHUNK_RUNS),
            batch_size=None,
            sampler=count(),
            num_workers=max(1, (os.cpu_count() or 1) - 1),
            prefetch_factor=AHEAD,
            collate_fn=tuple,  # arrays, not tensors
            multiprocessing_context="spawn",
        )
        try:
            yield from loader
        except RuntimeError as error:
            raise FailureTwinError(
                "a process that simulates runs has ended. Look for the cause, such as too little "
                "memory, and start again."
            ) from error

    def batches(self, chunks: Iterator[Batch]) -> Iterator[Batch]:
        """Yield shuffled batches of the last `uses` chunks."""
        rng = np.random.default_rng([self.data.seed, CHUNK_RUNS])
        in_use: deque[Batch] = deque(maxlen=self.uses)
        for chunk in chunks:
            in_use.append(chunk)
            features, classes = (np.concatenate(parts) for parts in zip(*in_use, strict=True))
            yield from epoch(features, classes, self.batch_runs, rng)


# Training, and validation on another engine.

WIDER = 2.0
"""Factor on the calibration's variation between robots in training."""
VALIDATION_SEED = 1_000_003
"""Added to the seed for validation runs."""


@dataclass(frozen=True)
class TrainingPlan:
    """How much to train.

    Attributes:
        network: Name of the network; see `NETWORKS`.
        iterations: Batches of 64 runs; the default takes ten minutes on two cores.
        seed: Random seed.
        validation_runs: Runs of the physics engine: half to fit temperature and pool weights, half
            to score the result.
        hypotheses: Classes of the network; None: the paper's.
    """

    network: str = "cnn"
    iterations: int = 6000
    seed: int = 0
    validation_runs: int = 1800
    hypotheses: tuple[Hypothesis, ...] | None = None


def train(
    robot: RobotLike = "armpi_fpv",
    imperfections: HealthyLike = None,
    plan: TrainingPlan = TrainingPlan(),
    *,
    with_bayes: bool = False,
) -> LearnedDiagnoser | HybridDiagnoser:
    """Return a network trained on the twin, or its pool with the Bayesian diagnosis.

    Other processes simulate the runs: guard scripts by ``if __name__ == "__main__":``. Save a
    network with `save_network`.

    Args:
        robot: Robot to train for.
        imperfections: Healthy behaviour, such as a calibration; None: that of the robot's profile.
        plan: How much to train.
        with_bayes: Return the pool with fitted weights.
    """
    known = calibrated(robot, imperfections)
    network, _, _ = train_network(plan, known.robot, known.imperfections)
    if not with_bayes:
        return network
    bayes = BayesDiagnoser(known)
    return HybridDiagnoser(bayes, network, network.weights_, class_name(bayes.twin.robot))


def train_network(
    plan: TrainingPlan,
    robot: Robot,
    imperfections: Imperfections,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> tuple[LearnedDiagnoser, Scores, Scores]:
    """Train a network on the twin and calibrate its probabilities.

    The network of the last iteration is the result. `on_iteration` is called after each batch with
    the number of batches so far. Returns the network, and the scores of the network and of its
    pool with the Bayesian diagnosis on validation runs.
    """
    encoder = FeatureEncoder("robust", robot, expectation_of(robot, imperfections))
    hypotheses = plan.hypotheses or paper_hypotheses(robot.motor_names)
    data = TrainingData(robot, widened(imperfections, WIDER), plan.seed, hypotheses=hypotheses)
    network = LearnedDiagnoser(
        plan.network,
        encoder,
        iterations=plan.iterations,
        learning_rate=2e-3,
        batch_runs=64,
        random_state=plan.seed % 2**32,
    )
    stream = Stream(data, encoder, network.batch_runs)
    classes = [str(hypothesis) for hypothesis in data.hypotheses]
    with closing(stream.chunks()) as chunks:
        standard = Standard.of(next(chunks)[0])
        batches = stream.batches(chunks)
        network.fit_batches(batches, standard, classes, data.movements, on_iteration)
    other = replace(
        data, imperfections=imperfections, seed=plan.seed + VALIDATION_SEED, engine="physics"
    )
    half = plan.validation_runs // 2
    bayes = BayesDiagnoser(DigitalTwin(robot), imperfections, hypotheses)
    _calibrate(network, bayes, other.run_set(0, half))
    judges = other.run_set(1, half)
    both = HybridDiagnoser(bayes, network, network.weights_, class_name(bayes.twin.robot))
    alone, pooled = (Judged.of(d.diagnose(judges)).scores for d in (network, both))
    return network, alone, pooled


def _calibrate(network: LearnedDiagnoser, bayes: BayesDiagnoser, runs: xr.Dataset) -> None:
    """Fit the temperature of a network and its weights in the pool with the Bayesian diagnosis."""
    network.calibrate(runs)
    classes = network.classes_.tolist()
    by_bayes = [[d.posterior[name] for name in classes] for d in bayes.diagnose(runs)]
    truth = [classes.index(str(fault)) for fault in runs["fault"].values]
    network.weights_ = fit_pool_weights(
        np.array(by_bayes), network.predict_proba(runs), np.array(truth, dtype=np.int64)
    )
