"""Runs made by the twin: any hypotheses, any imperfections, as many as wanted.

Every run has its own random generator, seeded by the plan's seed and the run's number. A run
therefore does not depend on the process that makes it or on other runs.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin import __version__
from failuretwin.core.config import canonical, fingerprint
from failuretwin.core.errors import InputError, check_name
from failuretwin.core.hypothesis import (
    Fault,
    Hypothesis,
    paper_hypotheses,
    parse_hypotheses,
)
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import STEP_S, RunSet, RunTable, Truth, concatenate
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.signals import SIMULATED, drive_of, simulated_sensors
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.disturbances import (
    Disturbances,
    delay_commands,
    draw_disturbances,
    sense,
    stack,
)
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.physics.engine import PhysicsEngine
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.settling import Settling, loads_in_range
from failuretwin.digital_model.twin import DigitalTwin, Engine, ServoEngine
from failuretwin.failure_behavior.fault import FaultValue
from failuretwin.failure_behavior.injection import Injection
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES

# What to simulate: robot, states, imperfections, chance; small enough to write down.

ENGINES = ("servo", "physics")
LATE_STARTS = 2
"""Late starts that a run has room for; what more of them push beyond the grid is cut off."""
LEAST_SAG_RAD = 1e-6
"""A motor that its load moves by less than this in any pose counts as rigid [rad]."""


@dataclass(frozen=True, init=False)
class Plan:
    """Plan of runs: ``Plan("armpi_fpv", ["healthy", "motor_1:stuck"], runs_per_class=20)``.

    Attributes:
        robot: The robot.
        hypotheses: States of the robot, in the order in which their runs come.
        runs_per_class: Runs of each.
        seed: Seed of all chance.
        imperfections: Behaviour of the healthy robot that its twin lacks.
        movements: How movements are drawn.
        modes: Fault modes with their distributions, by id.
        engine: Model of the motors: ``servo`` (the published loops) or ``physics``.
        sensors: Sensors beside that of the tool's position and the motors' own, such as
            ``accelerometer``.

    Raises:
        InputError: If a name or a hypothesis cannot be read, a hypothesis cannot be simulated or
            would not show, or a number makes no sense.
    """

    robot: Robot
    hypotheses: Sequence[Hypothesis]
    runs_per_class: int
    seed: int
    imperfections: Imperfections
    movements: RandomMovements
    modes: Mapping[str, FaultMode]
    engine: str
    sensors: tuple[str, ...]

    def __init__(
        self,
        robot: Robot | str | Path = "armpi_fpv",
        hypotheses: Sequence[Hypothesis | str] | None = None,
        runs_per_class: int = 1,
        seed: int = 0,
        imperfections: Imperfections | str | Path = NO_IMPERFECTIONS,
        movements: RandomMovements | None = None,
        modes: Mapping[str, FaultMode] | None = None,
        engine: str = "servo",
        sensors: Sequence[str] = (),
    ) -> None:
        """Take values or their text form.

        A robot by name or profile; hypotheses as text, None: the paper's nine classes;
        imperfections by the name or path of a calibration, whose servo loops the robot then has;
        movements, None: as in the paper; modes, None: all that are known, as they usually are.
        """
        model = load_robot(robot)
        if not isinstance(imperfections, Imperfections):
            known = load_calibration(imperfections, model)
            model, imperfections = known.robot, known.imperfections
        names = model.motor_names
        given = {
            "robot": model,
            "hypotheses": paper_hypotheses(names)
            if hypotheses is None
            else parse_hypotheses(hypotheses, names),
            "runs_per_class": runs_per_class,
            "seed": seed,
            "imperfections": imperfections,
            "movements": movements or RandomMovements(),
            "modes": dict(MODES) if modes is None else modes,
            "engine": engine,
            "sensors": tuple(sensors),
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)
        self._check()

    def _check(self) -> None:
        if self.runs_per_class < 1:
            raise InputError(f"runs per class is {self.runs_per_class}, expected 1 or more.")
        check_name("engine", self.engine, ENGINES)
        for kind in self.sensors:
            check_name("sensor", kind, SIMULATED)
        for hypothesis in self.hypotheses:
            if not hypothesis.known:
                raise InputError("'unknown' cannot be simulated. Name the faults to simulate.")
            for fault in hypothesis.faults:
                check_name("fault mode", fault.mode, self.modes)
                if self.modes[fault.mode].needs_compliance and self.engine == "servo":
                    self._check_compliance(fault)

    def _check_compliance(self, fault: Fault) -> None:
        """Refuse a loss of stiffness in a motor that does not give way at all."""
        motor = self.robot.motor_names.index(fault.motor)
        settling = self.imperfections.settling or Settling.ideal(len(self.robot.motors))
        load = np.abs(loads_in_range(self.robot, settling.payload)[:, motor]).max()
        if settling.compliance[motor] * load < LEAST_SAG_RAD:
            raise InputError(
                f"'{fault}' would not show: with imperfections {self.imperfections.name!r}, "
                f"{fault.motor} does not give way under load. Choose imperfections in which it "
                "sags (--calibration), or another motor."
            )

    @property
    def size(self) -> int:
        """Number of runs."""
        return len(self.hypotheses) * self.runs_per_class

    def chunks(self, size: int) -> list[range]:
        """Return the numbers of all runs, `size` of them at a time."""
        runs = range(self.size)
        return [runs[first : first + size] for first in runs[::size]]

    @property
    def time(self) -> FloatArray:
        """Time grid of every run, (time,) [s]; long enough for a run of two late starts.

        What is drawn out as published is cut to the published length.
        """
        length = self.movements.duration_s
        if not self.as_published and self.imperfections.timing.late_rate > 0.0:
            length += LATE_STARTS * self.imperfections.timing.late_s[1]
        return as_floats(np.arange(round(length / STEP_S)) * STEP_S)

    @property
    def as_published(self) -> bool:
        """Whether readings are drawn out to the grid as the published data are."""
        readings = self.imperfections.readings
        return readings is not None and readings.drawn_out

    def hypothesis_of(self, run: int) -> Hypothesis:
        """Return the true state of a run."""
        return self.hypotheses[run // self.runs_per_class]

    def attributes(self) -> dict[str, str | int]:
        """Return what a run set says of where it comes from."""
        configuration = {
            "hypotheses": [str(h) for h in self.hypotheses],
            "runs_per_class": self.runs_per_class,
            "imperfections": self.imperfections.name,
            "engine": self.engine,
            "movements": vars(self.movements),
            "modes": {name: vars(mode) for name, mode in self.modes.items()},
        }
        if self.sensors:
            configuration["sensors"] = list(self.sensors)
        return {
            "robot": self.robot.name,
            "source": f"simulated by the {self.engine} engine",
            "seed": self.seed,
            "failuretwin_version": __version__,
            "configuration": json.dumps(configuration),
        }

    def manifest(self) -> dict[str, Any]:
        """Return all that decides what the runs are, as JSON can hold it, and its hash."""
        urdf = (self.robot.folder / self.robot.profile.urdf).read_bytes()
        content = {"plan": canonical(self), "urdf_sha256": hashlib.sha256(urdf).hexdigest()}
        return {**content, "plan_sha256": fingerprint(content)}


CHUNK_RUNS = 100
"""Runs computed at a time: about 30 MB of work."""


def _draw(plan: Plan, run: int) -> tuple[Movements, tuple[FaultValue, ...], Disturbances]:
    """Return all chance of one run."""
    rng = np.random.default_rng([plan.seed, run])
    movements = plan.movements.draw(plan.robot, plan.imperfections.schedule, rng)
    duration = float(plan.time[-1])
    chance = draw_disturbances(plan.imperfections, plan.robot, plan.movements.count, duration, rng)
    faults = tuple(
        plan.modes[fault.mode].draw(fault.motor, plan.movements.count, duration, rng)
        for fault in plan.hypothesis_of(run).faults
    )
    return movements, faults, chance


def simulate_runs(plan: Plan, runs: Sequence[int]) -> RunTable:
    """Simulate some of a plan's runs, by their numbers (each below `plan.size`)."""
    movements, faults, chances = zip(*(_draw(plan, run) for run in runs), strict=True)
    chance = stack(chances)
    commanded = delay_commands(stack_movements(movements), chance.late)
    injection = Injection(faults, plan.robot.motor_names, plan.modes)
    command, time = commanded.reference(plan.time), plan.time
    felt = chance
    if plan.engine == "physics":  # its gears have friction of their own
        felt = replace(chance, friction=np.zeros_like(chance.friction))
    drive = drive_of(commanded, time, injection, felt)
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
    seen = np.asarray(np.isfinite(measured).all(axis=-1))
    seeds = [[plan.seed, run] for run in runs]
    return RunTable(
        run=[f"{plan.hypothesis_of(n)}/{n % plan.runs_per_class:05d}" for n in runs],
        motor=plan.robot.motor_names,
        time=time,
        command=command,
        measured=measured,
        measured_rate_hz=1.0 / STEP_S if readings is None else readings.rate_hz,
        duration=duration,
        movements=commanded,
        truth=_truth(plan, runs, injection.as_struck(position, time, commanded.start)),
        position=read,
        sensors=simulated_sensors(
            plan.sensors, DigitalTwin(plan.robot), plan.imperfections, position, seen, STEP_S, seeds
        ),
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


def _truth(plan: Plan, runs: Sequence[int], faults: Sequence[Sequence[FaultValue]]) -> Truth:
    onset = [min((v.onset_s for v in values), default=np.nan) for values in faults]
    magnitude = [values[0].magnitude if values else np.nan for values in faults]
    return Truth(
        fault=[str(plan.hypothesis_of(run)) for run in runs],
        detail=[
            {"faults": [value.detail(plan.modes[value.fault.mode].unit) for value in values]}
            for values in faults
        ],
        onset=np.array(onset),
        magnitude=np.array(magnitude),
    )


def iterate(
    plan: Plan, runs_at_a_time: int = CHUNK_RUNS, order: Sequence[int] | None = None
) -> Iterator[RunTable]:
    """Simulate runs a few at a time and keep none of them.

    Args:
        plan: Robot, faults, imperfections and seed of the runs.
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
    on_progress: Progress = unseen,
    scheduler: str | None = None,
) -> RunSet:
    """Simulate all runs of a plan in memory; `resumable.produce` has no need to hold them.

    Args:
        plan: Robot, faults, imperfections and seed of the runs.
        workers: Processes to spread the work over; the result does not depend on it. Scripts that
            ask for several must be guarded by ``if __name__ == "__main__":``.
        on_progress: Called with the number of runs that have just been finished.
        scheduler: Address of a Dask scheduler whose workers do it instead.

    Raises:
        InputError: If workers are fewer than one or cannot be had.
    """
    chunks = plan.chunks(CHUNK_RUNS)
    parts = []
    with Workforce(workers, scheduler).map(partial(simulate_runs, plan), chunks) as tables:
        for chunk, table in zip(chunks, tables, strict=True):
            parts.append(table.to_dataset())
            on_progress(len(chunk))
    return concatenate(parts)
