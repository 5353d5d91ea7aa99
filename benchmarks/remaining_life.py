"""Remaining life of worn motors: how often 90 % intervals hold, by kind of wear and share of life.

    python benchmarks/remaining_life.py [--lives 50]
    python benchmarks/remaining_life.py --tracked --lives 10 --kind linear jumps

Simulated lives of 600 to 2500 runs, an end at 4 scatters. A reading error of 0.4 scatters a run;
the last 25 runs are not known yet, as in the tracker, and a tenth of the others was frozen. Or
`--tracked`: one motor of an ArmPi FPV wears, five random movements a run, and what
`diagnose --track` keeps of the runs so far is taken as `advise` takes it, silence after an alarm
included. The arm is simulated at rest, with Student scatter; no fault but wear.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from failuretwin import Priors
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.decision.remaining_life import (
    BIAS_ALONE,
    RemainingLife,
    motor_lives,
    remaining_life,
)
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.nonidealities import vary
from failuretwin.digital_model.settling import sag
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.set_ups.setup_prior import SetupPrior
from failuretwin.inference.together.life_filter import LifeFilter
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

LIMIT, NOISE, DELAY = 4.0, 0.4, 25
MOVEMENTS, BATCH, NOISE_M = 5, 10, 0.0005
KNOWN = Priors(setup=SetupPrior.known())
KINDS = ("linear", "walk", "temperature", "jumps", "square", "exponential", "root", "none")
SHARES = (0.3, 0.6, 0.85)


def life(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return the wear of each run and the run in which it passes the limit."""
    end = float(rng.uniform(600, 2500))
    t = np.arange(int(6 * end)) + 0.5
    share = t / end
    wear = {
        "linear": LIMIT * share,
        "walk": LIMIT * (share + 0.3 * np.cumsum(rng.standard_normal(len(t))) / np.sqrt(end)),
        "temperature": LIMIT * share + 0.4 * np.sin(2 * np.pi * t / rng.uniform(60, 300)),
        "jumps": np.cumsum((rng.random(len(t)) < 20 / end) * rng.exponential(LIMIT / 20, len(t))),
        "square": LIMIT * share**2,
        "exponential": LIMIT * np.expm1(3 * share) / np.expm1(3),
        "root": LIMIT * np.sqrt(share),
        "none": np.zeros(len(t)),
    }[kind]  # fmt: skip
    beyond = np.flatnonzero(wear >= LIMIT)
    return wear, float(beyond[0]) if len(beyond) else np.inf


@dataclass
class Cell:
    """Lives of one kind that were looked at once in a share of their length."""

    holds: int = 0
    late: int = 0
    none: int = 0
    silent: int = 0
    count: int = 0

    def add(self, found: RemainingLife | None, left: float) -> None:
        """Add one life; `found` is None where nothing could be said."""
        self.count += 1
        if found is None:
            self.silent += 1
            return
        low, high = found.quantile(0.05), found.quantile(0.95)
        self.holds += low <= left <= high
        self.late += left < low
        self.none += not found.in_sight

    def line(self) -> str:
        """Return counts and shares."""
        return (
            f"holds {self.holds}/{self.count} too late {self.late} no end {self.none} "
            f"nothing said {self.silent}"
        )


def told_at_once(wear: FloatArray, now: int, rng: np.random.Generator) -> RemainingLife:
    """Return the remaining life by readings of a known error."""
    seen = wear[:now] + NOISE * rng.standard_normal(now)
    seen[-DELAY:] = np.nan
    frozen = int(rng.integers(0, max(now - now // 10, 1)))
    seen[frozen : frozen + now // 10] = np.nan
    return remaining_life(seen, NOISE**2, LIMIT, rng)


def settled_runs(known: CalibratedRobot, bias: FloatArray, seed: int) -> SettledEvidence:
    """Return where the tool of an arm settles, its bias (run, motor) [rad] that of each run."""
    robot, settling = known.robot, known.imperfections.settling
    assert settling is not None
    rng, shape = np.random.default_rng(seed), (len(bias), MOVEMENTS, len(robot.motors))
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    target = rng.uniform(low, high, shape)
    movements = Movements(
        np.zeros((len(bias), shape[-1])),
        target,
        np.full(shape, 0.8),
        np.tile(2.0 * np.arange(MOVEMENTS), (len(bias), 1)),
    )
    aim = target + bias[:, None] - settling.friction * np.sign(target - movements.origin())
    pose = aim
    for _ in range(3):  # gravity acts in the pose that the arm is really in
        pose = aim + sag(robot, pose, np.asarray(settling.compliance), settling.payload)
    pose = pose + settling.scatter * rng.standard_t(settling.tail_dof, shape)
    noise = rng.normal(0.0, NOISE_M, (*shape[:2], 3))
    empty = SettledEvidence.empty(run=len(bias), movement=MOVEMENTS, motor=shape[-1], axis=3)
    return replace(
        empty,
        movements=movements,
        point=known.twin.path(pose) + noise,
        usable=np.ones(shape[:2], dtype=bool),
        begin=movements.start + 1.5,
        end=movements.start + 2.0,
    )


def history_of(model: HealthyModel, runs: SettledEvidence) -> list[dict[str, Any]]:
    """Return what `diagnose --track` keeps of runs, as far as `advise` reads it."""
    life = LifeFilter.of(model, [Hypothesis.parse("healthy")], KNOWN, WearLimits())
    rows: list[dict[str, Any]] = []
    for first in range(0, len(runs.usable), BATCH):
        life.follow(runs[first : first + BATCH])
        for alone in zip(*life.bias_by_run(), strict=True):
            told = dict(zip(BIAS_ALONE, (part.tolist() for part in alone), strict=True))
            rows.append({"alarm": life.alarm, **told})
    return rows


def tracked(kind: str, number: int) -> dict[float, tuple[RemainingLife | None, float]]:
    """Return what is told of a life by what the tracker kept, and what is left, by share of it."""
    known, motor = load_calibration(None, "armpi_fpv"), number % 4
    rng = np.random.default_rng([KINDS.index(kind), number])
    wear, end = life(kind, rng)
    while end < 200:
        wear, end = life(kind, rng)
    model = HealthyModel.of(known.twin, known.imperfections)
    true = replace(known, imperfections=vary(known.imperfections, rng))
    length = int(max(SHARES) * (end if np.isfinite(end) else 1500))
    settling = true.imperfections.settling
    assert settling is not None
    bias = np.tile(np.asarray(settling.bias), (length, 1))
    bias[:, motor] += wear[:length] * wear_unit(model)[motor] * rng.choice([-1.0, 1.0])
    rows = history_of(model, settled_runs(true, bias, number))
    found = {}
    for share in SHARES:
        now = int(share * (end if np.isfinite(end) else 1500))
        told = motor_lives(rows[:now], model, rng)[known.robot.motor_names[motor]]
        found[share] = told, end - now
    return found


def main() -> None:
    """Print coverage and lateness."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lives", type=int, default=50)
    parser.add_argument("--kind", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--tracked", action="store_true", help="by what the tracker keeps")
    told = parser.parse_args()
    for kind in told.kind:
        rng, cells = np.random.default_rng(3), {share: Cell() for share in SHARES}
        for number in range(told.lives):
            if told.tracked:
                for share, (found, left) in tracked(kind, number).items():
                    cells[share].add(found, left)
                continue
            wear, end = life(kind, rng)
            if end < 60:
                continue
            for share in SHARES:
                now = int(share * (end if np.isfinite(end) else 1500))
                cells[share].add(told_at_once(wear, now, rng), end - now)
        lines = (f"{share:.0%}: {cell.line()}" for share, cell in cells.items())
        print(f"{kind:12s}", " | ".join(lines), flush=True)


if __name__ == "__main__":
    main()
