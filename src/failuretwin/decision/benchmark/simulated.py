"""Simulated data of the benchmark: the same whole counts on every machine.

Positions are rounded to 10 micrometres and angles to a microradian. Two machines whose sines differ
in the last digit therefore write the same data, and their checksums agree.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError, check_name
from failuretwin.core.hypothesis import PAPER_MODES, Hypothesis, single_faults
from failuretwin.core.runs import concatenate, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, Readings, vary
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.failure_behavior.modes import SteadyStateError, Stuck
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    import xarray as xr

VERSION = 1
"""Version of the data; a change of any run is a new version."""
SEED = 20261126

ERROR_DEG: Mapping[str, tuple[float, float]] = {
    "armpi_fpv": (1.2, 4.8),
    "so101": (2.0, 8.0),
    "ur5e": (0.5, 2.0),
    "panda": (0.5, 2.0),
}
"""Range of steady-state errors of each arm [deg], from about the smallest that can be seen."""
ARMS = tuple(ERROR_DEG)
LADDER = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Sizes of the set `sizes`, in the smallest error of the arm."""
FOREIGN = ("slow", "backlash", "drift", "intermittent", "lost_commands")
"""Modes of the set `foreign`: none is among the hypotheses."""
RATE_HZ = 10.0
NOISE_OF_REACH = 5e-4
"""Noise of the tool sensor on each axis, in the reach of the arm [-]."""
POSITION_M, ANGLE_RAD, TRUTH = 1e-5, 1e-6, 1e-6
"""One count of positions, of angles, and of true onsets and sizes."""
MISSING = np.iinfo(np.int32).min
VARIABLES = ("command", "measured", "duration", "fault", "onset", "magnitude")
COORDINATES = ("run", "time", "motor", "axis")
MOVING = RandomMovements(count=8, period_s=1.25, ramp_shares=(1.0,))
"""Movements that begin where the last one ends: the arm never rests."""


@dataclass(frozen=True)
class SimulatedSet:
    """One data set of each arm.

    Attributes:
        content: What its runs are.
        robot: ``a`` or ``b``: all runs are of this robot of the class; empty: each is of another.
        runs: Runs of each hypothesis.
        modes: Fault modes; healthy is always there too.
        onset_s: Range of the onset of faults [s]; None: as published.
        factors: Sizes of errors in the smallest one of the arm; empty: the arm's range.
        movements: How movements are drawn.
        reversed_motor: Number of a motor whose commands have the wrong sign; None: none.
        healthy: Further healthy runs, for the rate of false alarms.
    """

    content: str
    robot: str = "a"
    runs: int = 10
    modes: tuple[str, ...] = PAPER_MODES
    onset_s: tuple[float, float] | None = None
    factors: tuple[float, ...] = ()
    movements: RandomMovements = field(default_factory=RandomMovements)
    reversed_motor: int | None = None
    healthy: int = 0


SETS: Mapping[str, SimulatedSet] = {
    "train": SimulatedSet("labelled runs, each of another robot", "", 60, onset_s=(0.0, 5.0)),
    "healthy": SimulatedSet("healthy runs of robot a", runs=20, modes=()),
    "labelled": SimulatedSet("labelled runs of robot a", runs=4),
    "other": SimulatedSet("labelled runs of robot b", "b", 8),
    "robot": SimulatedSet("test runs of robot a", healthy=30),
    "class": SimulatedSet("test runs, each of another robot", "", healthy=30),
    "ages": SimulatedSet(
        "faults of robot a that come at any time", runs=8, onset_s=(0.5, 7.0), healthy=20
    ),
    "sizes": SimulatedSet(
        "errors of robot a of five sizes", runs=3, modes=("steady_state_error",), factors=LADDER
    ),
    "foreign": SimulatedSet(
        "faults of robot a outside the hypotheses", runs=3, modes=FOREIGN, healthy=20
    ),
    "moving": SimulatedSet("runs of robot a without rest", runs=6, movements=MOVING, healthy=10),
    "mistaken": SimulatedSet(
        "runs of robot a, commands of motor 2 reversed", runs=4, reversed_motor=2
    ),
}
"""The data sets by name."""


# Making the runs.


def make_set(arm: str, name: str) -> xr.Dataset:
    """Return a data set in whole counts, its runs in random order and named by number.

    Raises:
        InputError: If there is no such arm or set.
    """
    check_name("arm", arm, ARMS)
    check_name("set", name, SETS)
    wanted, robot = SETS[name], load_robot(arm)
    kinds = [(wanted, factor) for factor in wanted.factors or (0.0,)]
    if wanted.healthy:
        kinds.append((replace(wanted, runs=wanted.healthy, modes=()), 0.0))
    parts = []
    for step, (kind, factor) in enumerate(kinds):
        seed = [SEED, ARMS.index(arm), list(SETS).index(name), step]
        number = int(np.random.SeedSequence(seed).generate_state(1)[0])
        parts.append(simulate(_plan(robot, kind, factor, number)))
    runs = shuffled(concatenate(parts)[[*VARIABLES]], f"{arm}-{name}")
    if wanted.reversed_motor is not None:
        sign = np.ones(len(robot.motors))
        sign[wanted.reversed_motor - 1] = -1.0
        runs["command"] = (runs["command"].dims, runs["command"].values * sign)
    runs.attrs = attributes_of(arm, name)
    return _in_counts(runs)


def shuffled(runs: xr.Dataset, name: str) -> xr.Dataset:
    """Return runs in random order, named by number: neither tells their faults."""
    order = np.random.default_rng([SEED, runs.sizes["run"]]).permutation(runs.sizes["run"])
    names = np.array([f"{name}-{number:04d}" for number in range(len(order))], dtype=object)
    return runs.isel(run=order).assign_coords(run=("run", names))


def attributes_of(arm: str, name: str) -> dict[str, Any]:
    """Return the attributes of a data set."""
    return {
        "robot": arm,
        "individual": SETS[name].robot,
        "source": f"benchmark {VERSION}, simulated: {SETS[name].content}",
        "measured_rate_hz": RATE_HZ,
    }


def _plan(robot: Robot, wanted: SimulatedSet, factor: float, seed: int) -> Plan:
    low, high = ERROR_DEG[robot.name] if not factor else (factor * ERROR_DEG[robot.name][0],) * 2
    error = SteadyStateError(
        magnitude=(float(np.deg2rad(low)), float(np.deg2rad(high))),
        onset_s=wanted.onset_s or (0.0, 0.0),
    )
    stuck = Stuck() if wanted.onset_s is None else Stuck(onset_s=wanted.onset_s)
    return Plan(
        robot,
        single_faults(robot.motor_names, wanted.modes),
        wanted.runs,
        seed,
        _healthy_behaviour(robot, wanted.robot),
        wanted.movements,
        {**MODES, "stuck": stuck, "steady_state_error": error},
    )


def _healthy_behaviour(robot: Robot, which: str) -> Imperfections:
    """Return the behaviour of one robot of the class; an empty name: of the whole class."""
    kind = generic_imperfections(robot)
    sensor = Readings(RATE_HZ, noise_m=NOISE_OF_REACH * robot.reach)
    kind = replace(kind, readings=sensor)
    if not which:
        return kind
    rng = np.random.default_rng([SEED, ARMS.index(robot.name), ord(which)])
    own = vary(kind, rng)
    assert own.settling is not None
    friction = tuple(abs(value) for value in own.settling.friction)
    settling = replace(own.settling, friction=friction)
    return replace(own, name=f"robot {which}", of_class=False, settling=settling)


UNITS = {"command": ANGLE_RAD, "measured": POSITION_M, "onset": TRUTH, "magnitude": TRUTH}


def _counts(values: FloatArray, unit: float) -> Any:
    seen = np.isfinite(values)
    return np.where(seen, np.round(np.where(seen, values, 0.0) / unit), MISSING).astype("<i4")


def _in_counts(runs: xr.Dataset) -> xr.Dataset:
    """Return runs whose values are whole counts of `UNITS`."""
    rounded = {n: (runs[n].dims, np.round(runs[n].values / u) * u) for n, u in UNITS.items()}
    return runs.assign(rounded)


# Checksums and files.


def checksum(runs: xr.Dataset) -> str:
    """Return the SHA-256 of names, grid, counts and truth of a data set."""
    names = [[str(name) for name in runs[key].values] for key in ("run", "motor")]
    grid = [len(runs["time"]), round(float(runs["time"].values[-1]), 6), RATE_HZ]
    lengths = np.round(runs["duration"].values, 3).tolist()
    digest = hashlib.sha256(json.dumps([names, grid, lengths, truth_of(runs)]).encode())
    for name, unit in UNITS.items():
        digest.update(_counts(runs[name].values, unit).tobytes())
    return digest.hexdigest()


@cache
def official() -> Mapping[str, str]:
    """Return the checksum of each set, by ``arm/set``."""
    text = (files(__package__) / "checksums.json").read_text(encoding="utf-8")
    return {str(key): str(value) for key, value in json.loads(text).items()}


def load_set(arm: str, name: str, data: Path) -> xr.Dataset:
    """Return a data set from its file below `data`, where it is made if it is missing.

    Raises:
        InputError: If the file is not the official data.
    """
    path = data / "simulated" / arm / f"{name}.nc"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_run_set(make_set(arm, name), path)
    try:
        runs = _in_counts(load_run_set(path))
    except InputError as error:
        raise InputError(f"{error} Remove it and run the command again.") from error
    _check_same(
        path, "variables", sorted(map(str, runs.variables)), sorted([*VARIABLES, *COORDINATES])
    )
    _check_same(path, "attributes", runs.attrs, attributes_of(arm, name))
    _check_same(path, "checksum", checksum(runs)[:12], official()[f"{arm}/{name}"][:12])
    return runs


def _check_same(path: Path, what: str, found: object, expected: object) -> None:
    if found != expected:
        raise InputError(
            f"{path}: has {what} {found}, expected {expected}: the file was changed, or another "
            "version of the package made it. Remove it and run the command again."
        )


def classes_of(arm: str) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of an arm: healthy, and each motor stuck or with an error."""
    return single_faults(load_robot(arm).motor_names, PAPER_MODES)
