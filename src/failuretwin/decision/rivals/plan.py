"""Plan of the study of rivals: methods, twins, seeds and sizes."""

from __future__ import annotations

from dataclasses import dataclass

PUBLISHED, IMPERFECT = TWINS = ("published", "imperfect")
NETWORKS = ("lstm", "cnn", "tcn", "transformer")
ADAPTING = {"dann": "P1", "fine-tuned": "P2"}
"""CNNs that learn from target runs, with the protocol letter."""
CLASSICAL = {
    "minirocket": "MiniRocket",
    "boosting": "GradientBoosting",
    "nearest": "NearestSimulation",
}
OWN = "motorwise"
"""Our network."""
MODELS = ("kalman", "bayes", "self-calibrating", "hybrid")
"""Methods without training, and the hybrid, which pools Bayes with our network of its seed."""
LATE = ("fine-tuned", "hybrid")
"""Methods that go on from a network of their seed."""


@dataclass(frozen=True)
class RivalPlan:
    """Sizes of the study.

    Attributes:
        seed: Random seed.
        runs_per_class: Simulated training runs of each class, for every method.
        iterations: Batches of 32 runs, for every network.
        repeats: Seeds.
        stand_in_runs: Runs per class of the stand-in test set by the physics engine.
    """

    seed: int = 0
    runs_per_class: int = 400
    iterations: int = 3030
    repeats: int = 5
    stand_in_runs: int = 40


def quick_rivals(seed: int) -> RivalPlan:
    """Return a small study."""
    return RivalPlan(seed, 40, 60, 1, 4)


@dataclass(frozen=True)
class RivalJob:
    """One method, trained on runs of one twin with one seed."""

    method: str
    twin: str
    repeat: int

    @property
    def name(self) -> str:
        """Name of its file, without suffix."""
        return f"{self.method}_{self.twin}_{self.repeat}"

    @property
    def protocol(self) -> str:
        """Protocol letter; the imperfect twin was calibrated on healthy logs."""
        if self.method == "self-calibrating":
            return "P1"
        return ADAPTING.get(self.method, "P0" if self.twin == PUBLISHED else "P0c")


def rival_jobs(plan: RivalPlan) -> list[RivalJob]:
    """Return all jobs; methods without chance have one, and those of one twin only that."""
    jobs = []
    for repeat in range(plan.repeats):
        for twin in TWINS:
            names = [*NETWORKS, OWN, *ADAPTING, *CLASSICAL, "hybrid"]
            names += [m for m in MODELS if m != "hybrid" and repeat == 0]
            one_twin = {OWN: IMPERFECT, "hybrid": IMPERFECT, "self-calibrating": PUBLISHED}
            jobs += [RivalJob(n, twin, repeat) for n in names if one_twin.get(n, twin) == twin]
    return jobs
