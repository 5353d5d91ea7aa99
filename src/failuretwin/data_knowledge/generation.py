"""Runs made by the twin: any hypotheses, any imperfections, as many as wanted.

Every run has its own random generator, seeded by the plan's seed and the run's number, so a run
is the same whoever makes it and whatever is made beside it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import parent_process
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable, Truth
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.assembly import assemble
from failuretwin.data_knowledge.driving import drive_of
from failuretwin.data_knowledge.plan import STEP_S, Plan
from failuretwin.data_knowledge.workforce import Workforce
from failuretwin.digital_model.disturbances import Disturbances, draw_disturbances, stack
from failuretwin.digital_model.engine import Engine, ServoEngine
from failuretwin.digital_model.imperfect import delay_commands
from failuretwin.digital_model.physics.engine import PhysicsEngine
from failuretwin.digital_model.tool_sensor import sense
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.fault_value import FaultValue
from failuretwin.failure_behavior.injection import Injection
from failuretwin.failure_behavior.random_movements import stack_movements

if TYPE_CHECKING:
    import xarray as xr

CHUNK_RUNS = 100
"""Runs computed at a time: about 30 MB of work."""


@dataclass(frozen=True)
class _Draw:
    """All chance of one run."""

    movements: Movements
    faults: tuple[FaultValue, ...]
    chance: Disturbances


def _draw(plan: Plan, run: int) -> _Draw:
    rng = np.random.default_rng([plan.seed, run])
    movements = plan.movements.draw(plan.robot, plan.imperfections.schedule, rng)
    duration = float(plan.time[-1])
    chance = draw_disturbances(plan.imperfections, plan.robot, plan.movements.count, duration, rng)
    faults = tuple(
        plan.modes[fault.mode].draw(fault.motor, plan.movements.count, duration, rng)
        for fault in plan.hypothesis_of(run).faults
    )
    return _Draw(movements, faults, chance)


def simulate_runs(plan: Plan, runs: Sequence[int]) -> RunTable:
    """Simulate some of a plan's runs.

    Args:
        plan: What to simulate.
        runs: Numbers of the runs, each below `plan.size`.
    """
    draws = [_draw(plan, run) for run in runs]
    chance = stack([draw.chance for draw in draws])
    commanded = delay_commands(stack_movements([draw.movements for draw in draws]), chance.late)
    injection = Injection([draw.faults for draw in draws], plan.robot.motor_names, plan.modes)
    command, time = commanded.reference(plan.time), plan.time
    felt = chance
    if plan.engine == "physics":  # its gears have friction of their own
        felt = replace(chance, friction=np.zeros_like(chance.friction))
    drive = drive_of(commanded, command, time, injection, felt)
    position = _engine(plan).angles(drive, time)
    measured, read = sense(
        DigitalTwin(plan.robot),
        plan.imperfections.readings,
        position,
        time,
        commanded.start,
        chance,
    )
    readings = plan.imperfections.readings
    duration = _durations(plan, commanded, chance)
    over = time > duration[:, None] + 1e-9
    measured[over], read[over] = np.nan, np.nan
    return RunTable(
        run=[_run_name(plan, run) for run in runs],
        motor=plan.robot.motor_names,
        time=time,
        command=command,
        measured=measured,
        measured_rate_hz=1.0 / STEP_S if readings is None else readings.rate_hz,
        duration=duration,
        movements=commanded,
        truth=_truth(plan, runs, injection.as_struck(position, time, commanded.start)),
        position=read,
        attributes=plan.attributes(),
    )


def _durations(plan: Plan, commanded: Movements, chance: Disturbances) -> FloatArray:
    """Return how long each run lasts, (run,) [s]: until the command after it would come."""
    last = float(plan.time[-1])
    if plan.as_published or plan.imperfections.timing.late_rate == 0.0:
        return np.full(len(commanded.start), last)
    end = commanded.start[:, -1] + chance.late[:, -1] + plan.movements.period_s
    return np.minimum(end, last)


def _engine(plan: Plan) -> Engine:
    if plan.engine == "servo":
        return ServoEngine(plan.robot)
    # Threads in the process that the user started; its workers are as many as there is room for.
    threads = (os.cpu_count() or 1) if parent_process() is None else 1
    return PhysicsEngine(plan.robot, threads=threads)


def _run_name(plan: Plan, run: int) -> str:
    return f"{plan.hypothesis_of(run)}/{run % plan.runs_per_class:05d}"


def _truth(plan: Plan, runs: Sequence[int], faults: Sequence[Sequence[FaultValue]]) -> Truth:
    onset = [min((v.onset_s for v in values), default=np.nan) for values in faults]
    magnitude = [values[0].magnitude if values else np.nan for values in faults]
    return Truth(
        fault=[str(plan.hypothesis_of(run)) for run in runs],
        detail=[{"faults": [value.detail() for value in values]} for values in faults],
        onset=np.array(onset),
        magnitude=np.array(magnitude),
    )


def iterate(
    plan: Plan, runs_at_a_time: int = CHUNK_RUNS, order: Sequence[int] | None = None
) -> Iterator[RunTable]:
    """Simulate runs a few at a time and keep none of them.

    Args:
        plan: What to simulate.
        runs_at_a_time: Runs in each table; the last one may hold fewer.
        order: Numbers of the runs to make, each below `plan.size`, such as a random permutation;
            None: all of them, one hypothesis after the other.

    Raises:
        InputError: If runs at a time are fewer than one.
    """
    if runs_at_a_time < 1:
        raise InputError(f"runs at a time is {runs_at_a_time}, expected 1 or more.")
    runs = range(plan.size) if order is None else order
    for first in range(0, len(runs), runs_at_a_time):
        yield simulate_runs(plan, runs[first : first + runs_at_a_time])


def simulate(
    plan: Plan,
    workers: int = 1,
    on_progress: Callable[[int], None] = lambda runs: None,
    scheduler: str | None = None,
) -> xr.Dataset:
    """Simulate all runs of a plan in memory; `run_factory.produce` has no need to hold them.

    Args:
        plan: What to simulate.
        workers: Processes to spread the work over; the result does not depend on it. Scripts that
            ask for several must be guarded by ``if __name__ == "__main__":``.
        on_progress: Called with the number of runs that have just been finished.
        scheduler: Address of a Dask scheduler whose workers do it instead.

    Raises:
        InputError: If workers are fewer than one or cannot be had.
    """
    chunks = [
        range(first, min(first + CHUNK_RUNS, plan.size))
        for first in range(0, plan.size, CHUNK_RUNS)
    ]
    with Workforce(workers, scheduler).at_work(partial(simulate_runs, plan), chunks) as results:
        return assemble(_datasets(results, on_progress), plan.size)


def _datasets(
    results: Iterator[tuple[range, RunTable]], on_progress: Callable[[int], None]
) -> Iterator[tuple[int, xr.Dataset]]:
    for runs, table in results:
        yield runs[0], table.to_dataset()
        on_progress(len(runs))
