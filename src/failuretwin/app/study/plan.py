"""What the study does, to the letter of the paper; and a small version of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

FEATURES = ("original", "augmented")
"""The paper's two feature sets."""
PRINTED_RATE, REPRODUCING_RATE = 1e-4, 1e-3
"""Learning rate as printed in the paper, and the reading that reproduces its Table II."""
BATCH_RUNS = 32
VALIDATION_SHARE = 0.1


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        features: Feature set.
        learning_rate: Of Adam.
        repeat: Number of the repetition, from 0: of the split and the random weights.
    """

    features: str
    learning_rate: float
    repeat: int

    @property
    def name(self) -> str:
        """Name of its result file, without suffix."""
        return f"{self.features}-{self.learning_rate:g}-{self.repeat}"


@dataclass(frozen=True)
class StudyPlan:
    """Sizes of the study; the defaults are the paper's.

    Attributes:
        seed: Seed of all chance.
        runs_per_class: Simulated runs of each of the nine classes.
        checkpoints: Iterations after which accuracies are taken, all of one training. The paper
            calls them epochs; its figures fit iterations, of which an epoch has 101.
        repeats: Repetitions of each training.
        stand_in_runs: Runs of each class by the physics engine where no real test set is given.
    """

    seed: int = 0
    runs_per_class: int = 400
    checkpoints: tuple[int, ...] = (1010, 2020, 3030, 4040, 5050)
    repeats: int = 5
    stand_in_runs: int = 100

    def jobs(self) -> Iterator[Job]:
        """Give every training, those that tell most first."""
        for repeat in range(self.repeats):
            for rate in (REPRODUCING_RATE, PRINTED_RATE):
                for features in reversed(FEATURES):
                    yield Job(features, rate, repeat)

    @property
    def iterations(self) -> int:
        """Iterations of one training."""
        return self.checkpoints[-1]


def quick_plan(seed: int) -> StudyPlan:
    """Return a study of about two minutes: all of its parts, figures that mean little."""
    return StudyPlan(seed, 60, (50, 100, 150, 200, 250), 2, 20)
