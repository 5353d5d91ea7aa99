"""Ten thousand runs of slow wear, then a fault: does the tracker follow the one and not the other?

Every run is simulated in full and diagnosed from its tool path, with the tracker and without it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin import BayesDiagnoser, DigitalTwin, load_robot
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.tracked_diagnosis import History, begin, diagnose_tracked
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import concatenate
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.generate import Plan, simulate, simulate_runs
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import loads_in_range
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.together.life_filter import LifeFilter

if TYPE_CHECKING:
    import xarray as xr

COUNT = float(np.deg2rad(0.24))
"""One servo unit of the ArmPi FPV [rad]."""
WEAR_COUNTS = np.array([3.0, -4.0, 2.0, -3.0])
"""Bias that each motor gains over the wear."""
WEAR_RUNS = 10_000
SWING_COUNTS, SWING_RUNS = np.array([1.0, -1.0, 1.0, 1.0]), 2500.0
"""A swing of the bias as by temperature; at 10 s a run, its period is seven hours."""
SOFTENING = 0.3
"""Share by which the compliance grows over the wear."""
CALIBRATION_RUNS = 100
BLOCK = 100
SMALL_ERROR_RAD = (5 * COUNT, 20 * COUNT)
SEED = 1


@dataclass(frozen=True)
class Trial:
    """A fault that follows the wear.

    Attributes:
        name: What to print.
        hypothesis: The state of the robot.
        runs: How many runs of it.
        growth: What one run adds to bias [counts] and compliance [share] of motor 2.
        error_rad: Sizes of steady-state errors [rad]; None: as published.
    """

    name: str
    hypothesis: str = "healthy"
    runs: int = 100
    growth: tuple[float, float] = (0.0, 0.0)
    error_rad: tuple[float, float] | None = None

    @property
    def motor(self) -> str:
        """The faulty motor."""
        return self.hypothesis.partition(":")[0] if ":" in self.hypothesis else "motor_2"


TRIALS = (
    Trial("motor 2, errors of 10 to 50 counts", "motor_2:steady_state_error"),
    Trial(
        "motor 4, errors of 5 to 20 counts",
        "motor_4:steady_state_error",
        100,
        error_rad=SMALL_ERROR_RAD,
    ),
    Trial("motor 1 stuck", "motor_1:stuck"),
    Trial("motor 2 drifts by 0.02 counts a run", runs=1000, growth=(0.02, 0.0)),
    Trial("motor 2 drifts by 0.1 counts a run", runs=300, growth=(0.1, 0.0)),
    Trial("motor 2 drifts by 0.5 counts a run", runs=100, growth=(0.5, 0.0)),
    Trial("motor 2 softens by 1 % a run", runs=300, growth=(0.0, 0.01)),
)


@dataclass(frozen=True)
class World:
    """The true robot.

    Attributes:
        robot: The robot.
        fresh: Imperfections before any wear.
    """

    robot: Robot
    fresh: Imperfections

    def wear(self, runs: FloatArray, growth: FloatArray | None = None) -> FloatArray:
        """Return bias and compliance of runs, (run, 2 motor).

        Args:
            runs: Numbers of the runs, from 0, (run,).
            growth: What a fault adds to bias [counts] and compliance [share] of motor 2, (run, 2).
        """
        settling = self.fresh.settling
        assert settling is not None
        added = np.zeros((len(runs), 2)) if growth is None else growth
        share = np.minimum(runs / WEAR_RUNS, 1.0)[:, None]
        swing = SWING_COUNTS * np.sin(2.0 * np.pi * runs / SWING_RUNS)[:, None]
        counts, softening = WEAR_COUNTS * share + swing, np.repeat(SOFTENING * share, 4, axis=1)
        counts[:, 1] += added[:, 0]
        softening[:, 1] += added[:, 1]
        bias = np.asarray(settling.bias) + COUNT * counts
        return np.concatenate([bias, np.asarray(settling.compliance) * (1.0 + softening)], axis=1)

    def blocks(
        self, trial: Trial, first: int, runs: int
    ) -> Iterator[tuple[FloatArray, xr.Dataset]]:
        """Yield wear and run sets of a trial that begins with run `first`, without readings."""
        for block in range(0, runs, BLOCK):
            since = np.arange(block, min(block + BLOCK, runs))
            wear = self.wear(as_floats(since + first), since[:, None] * np.asarray(trial.growth))
            tables = [
                simulate_runs(self._plan(trial, now, first + runs), [first + int(number)])
                for number, now in zip(since, wear, strict=True)
            ]
            yield wear, concatenate([t.to_dataset() for t in tables]).drop_vars("position")

    def _plan(self, trial: Trial, wear: FloatArray, runs: int) -> Plan:
        settling = self.fresh.settling
        assert settling is not None
        bias, compliance = (tuple(part.tolist()) for part in np.split(wear, 2))
        worn = replace(settling, bias=bias, compliance=compliance)
        modes = dict(MODES)
        if trial.error_rad is not None:
            modes["steady_state_error"] = SteadyStateError(magnitude=trial.error_rad)
        hypothesis = Hypothesis.parse(trial.hypothesis, self.robot.motor_names)
        known = replace(self.fresh, settling=worn)
        return Plan(self.robot, [hypothesis], runs, SEED, known, modes=modes)


@dataclass
class Followed:
    """What was seen along the runs of a trial."""

    life: LifeFilter
    off: list[FloatArray] = field(default_factory=list)
    tracked: list[Diagnosis] = field(default_factory=list)
    untracked: list[Diagnosis] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)


def follow(
    world: World, diagnoser: BayesDiagnoser, life: LifeFilter, trial: Trial, first: int, plain: bool
) -> Followed:
    """Diagnose and track the runs of a trial.

    Args:
        world: The true robot.
        diagnoser: The diagnoser with the calibration.
        life: What is believed of the robot before.
        trial: What happens.
        first: Number of the first run.
        plain: Whether to diagnose without it as well.
    """
    seen = Followed(life)
    for wear, runs in world.blocks(trial, first, trial.runs):
        done = diagnose_tracked(runs, diagnoser, History(seen.life, cold=False))
        seen.tracked += done.diagnoses
        seen.alarms += [str(row["alarm"]) for row in done.rows]
        seen.off += [
            np.array([*row["bias"], *row["compliance"]]) - now
            for row, now in zip(done.rows, wear, strict=True)
        ]
        seen.life = done.life
        if plain:
            seen.untracked += diagnoser.diagnose(runs)
    return seen


def false_alarms(diagnoses: list[Diagnosis]) -> str:
    """Return how many diagnoses name a fault."""
    count = sum(d.diagnosis not in ("healthy", None) for d in diagnoses)
    return f"{count} of {len(diagnoses)} ({100.0 * count / len(diagnoses):.1f} %)"


def print_errors(name: str, off: FloatArray, robot: Robot) -> None:
    """Print rms and worst errors of tracked wear, (run, 2 motor), in counts."""
    load = loads_in_range(robot, 0.0) * robot.sense
    angle = _in_angle(off, robot) / COUNT
    bias, compliance = np.split(off, 2, axis=1)
    pose = np.mean((bias[:, None] + compliance[:, None] * load) ** 2, axis=1) ** 0.5 / COUNT
    parts = [*np.split(angle, 2, axis=1), pose]
    for what, error in zip(
        ("bias", "sag at the largest load", "settled angle"), parts, strict=True
    ):
        rms, worst = np.sqrt(np.mean(error**2, axis=0)), np.abs(error).max(axis=0)
        print(f"  {name:12s} {what:24s} rms {_row(rms)}   worst {_row(worst)}")


def _in_angle(off: FloatArray, robot: Robot) -> FloatArray:
    """Return bias and compliance as angles, these at the largest load, (..., 2 motor) [rad]."""
    largest = np.abs(loads_in_range(robot, 0.0)).max(axis=0)
    return off * np.concatenate([np.ones_like(largest), largest])


def _row(values: FloatArray) -> str:
    return " ".join(f"{value:5.2f}" for value in values)


def print_trial(seen: Followed, before: LifeFilter, trial: Trial) -> None:
    """Print when the fault was found and how far the tracked state moved with it."""
    wanted = f"{trial.motor}:"
    named = [
        d.diagnosis is not None
        and d.diagnosis.startswith(wanted)
        and d.posterior[d.diagnosis] > 0.9
        for d in seen.tracked
    ]
    found = named.index(True) + 1 if any(named) else None
    declared = [bool(alarm) for alarm in seen.alarms]
    alarm = declared.index(True) + 1 if any(declared) else None
    moved = (seen.life.offsets[0] - before.offsets[0])[:2].ravel()
    after = _in_angle(moved, before.model.twin.robot) / COUNT
    size = ""
    if trial.growth[0]:
        size = f" (the fault: {trial.growth[0] * trial.runs:.0f})"
    print(
        f"  {trial.name:36s} named first in run {found}, in {sum(named)} of {len(named)} runs; "
        f"learning stops in run {alarm}: {seen.alarms[alarm - 1] if alarm else ''}; state "
        f"moved by {np.abs(after).max():.2f} counts at most{size}"
    )


def main() -> None:
    """Run the wear and every fault after it, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=WEAR_RUNS, help="runs of wear")
    options = parser.parse_args()
    robot = load_robot("armpi_fpv")
    world = World(robot, load_calibration("armpi_fpv", robot).imperfections)
    healthy = Plan(robot, [Hypothesis()], CALIBRATION_RUNS, SEED + 1, world.fresh)
    runs = simulate(healthy).drop_vars("position")
    learned = fit_calibration(runs, robot, "fresh", "simulated", thorough=False)
    diagnoser = BayesDiagnoser(DigitalTwin(robot), learned.imperfections)
    start = begin(diagnoser, cold=False)

    begun_s = time.perf_counter()
    seen = follow(world, diagnoser, start, Trial("wear", runs=options.runs), 0, True)
    print(
        f"{options.runs} runs of wear, {time.perf_counter() - begun_s:.0f} s. Errors in counts, "
        "motors 1 to 4:"
    )
    off = np.array(seen.off)
    wear = world.wear(as_floats(np.arange(options.runs)))
    print_errors("tracked", off, robot)
    print_errors("not tracked", start.offsets[0][:2].ravel() - wear, robot)
    quarter = options.runs // 4
    print(
        f"false alarms with the tracker {false_alarms(seen.tracked)}, last quarter "
        f"{false_alarms(seen.tracked[-quarter:])}"
    )
    print(
        f"false alarms without          {false_alarms(seen.untracked)}, last quarter "
        f"{false_alarms(seen.untracked[-quarter:])}"
    )
    print(f"learning stopped in {sum(bool(alarm) for alarm in seen.alarms)} runs\n")
    print("then a fault:", flush=True)
    for trial in TRIALS:
        print_trial(
            follow(world, diagnoser, seen.life, trial, options.runs, False), seen.life, trial
        )


if __name__ == "__main__":
    main()
