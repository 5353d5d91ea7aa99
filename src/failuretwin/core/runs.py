"""The run set: an `xarray.Dataset` of commands and tool paths on one uniform time grid.

`VARIABLES` lists variables, dimensions and units; only `command` and `measured` are required.
Shorter runs are padded: `measured` NaN, `command` held. Without a position sensor of the tool,
`measured` is NaN throughout and other sensors are read: `tool_orientation`, a rotation vector in
the frame of `measured`; `accelerometer` and `gyroscope` on the tool, in their own frames; `wire`, a
length; `position`, the motors' readings. `goal` is the goal that each motor reports to have
received.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.foreign import check_memory
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats

if TYPE_CHECKING:
    import xarray as xr

RunSet: TypeAlias = "xr.Dataset"
"""A run set, by a name that needs no xarray."""
AXES = ("x", "y", "z")

VARIABLES: dict[str, tuple[tuple[str, ...], str]] = {
    "command": (("run", "time", "motor"), "rad"),
    "measured": (("run", "time", "axis"), "m"),
    "duration": (("run",), "s"),
    "target": (("run", "movement", "motor"), "rad"),
    "ramp_duration": (("run", "movement", "motor"), "s"),
    "movement_start": (("run", "movement"), "s"),
    "fault": (("run",), ""),
    "fault_detail": (("run",), "JSON"),
    "onset": (("run",), "s"),
    "magnitude": (("run",), "unit of the fault mode"),
    "position": (("run", "time", "motor"), "rad"),
    "goal": (("run", "time", "motor"), "rad"),
    "temperature": (("run", "time", "motor"), "degC"),
    "voltage": (("run", "time", "motor"), "V"),
    "tool_orientation": (("run", "time", "axis"), "rad"),
    "accelerometer": (("run", "time", "axis"), "m/s2"),
    "gyroscope": (("run", "time", "axis"), "rad/s"),
    "wire": (("run", "time"), "m"),
}
"""Dimensions and unit of every variable of a run set."""

STEP_S = 0.01
"""Step of the time grid of published, simulated and most logged runs [s]."""
GOAL_VARIABLE = "goal"
"""Variable of the goals that motors report to have received."""
UNIFORM = 1e-3
"""Largest relative difference of steps in a uniform grid; single precision rounds by a tenth of
it."""
LARGEST = {
    "command": 1e6,
    "measured": 1e6,
    "tool_orientation": 10.0,
    "accelerometer": 1e4,
    "gyroscope": 1e4,
    "wire": 1e6,
}
"""Largest accepted value of each variable, in its unit."""
REQUIRED = ("command", "measured")


@dataclass(frozen=True)
class Truth:
    """True fault of each run: arrays over runs, as in the run set."""

    fault: Sequence[str]
    detail: Sequence[Mapping[str, Any]]
    onset: FloatArray
    magnitude: FloatArray


@dataclass(frozen=True)
class RunTable:
    """Plain arrays of a run set.

    Attributes:
        run: Unique name of each run.
        motor: Names of the motors in chain order.
        time: Uniform grid from 0, (time,) [s].
        command: (run, time, motor) [rad].
        measured: (run, time, axis) [m]; NaN = no sample.
        measured_rate_hz: True rate of the tool sensor [Hz].
        duration: True length of each run, (run,) [s]; None: the whole grid.
        movements: Commanded movements, where known.
        truth: True faults, where known.
        position: Motor readings, (run, time, motor) [rad], where known.
        sensors: Readings of other sensors, by variable.
    """

    run: Sequence[str]
    motor: Sequence[str]
    time: FloatArray
    command: FloatArray
    measured: FloatArray
    measured_rate_hz: float
    duration: FloatArray | None = None
    movements: Movements | None = None
    truth: Truth | None = None
    position: FloatArray | None = None
    sensors: Mapping[str, FloatArray] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def to_dataset(self) -> xr.Dataset:
        """Return the checked run set."""
        import xarray as xr

        values: dict[str, Any] = {"command": self.command, "measured": self.measured}
        values |= self.sensors
        values["duration"] = (
            np.full(len(self.run), self.time[-1]) if self.duration is None else self.duration
        )
        if self.movements is not None:
            values |= {
                "target": self.movements.target,
                "ramp_duration": self.movements.ramp_duration,
                "movement_start": self.movements.start,
            }
        if self.truth is not None:
            values |= {
                "fault": np.asarray(self.truth.fault, dtype=object),
                "fault_detail": np.array([json.dumps(d) for d in self.truth.detail], dtype=object),
                "onset": self.truth.onset,
                "magnitude": self.truth.magnitude,
            }
        if self.position is not None:
            values["position"] = self.position
        coordinates = {
            "run": np.asarray(self.run, dtype=object),
            "time": self.time,
            "motor": np.asarray(self.motor, dtype=object),
            "axis": np.asarray(AXES, dtype=object),
        }
        try:
            runs = xr.Dataset(
                {name: (VARIABLES[name][0], value) for name, value in values.items()},
                coords=coordinates,
                attrs={**self.attributes, "measured_rate_hz": float(self.measured_rate_hz)},
            )
        except ValueError as error:
            raise InputError(f"the arrays of the run set do not fit together: {error}.") from error
        for name in runs.data_vars:
            runs[name].attrs["units"] = VARIABLES[str(name)][1]
        return check_runs(runs, "the run set")


def run_set(
    time: ArrayLike,
    command: ArrayLike,
    measured: ArrayLike | None = None,
    *,
    motors: Sequence[str] | None = None,
    names: Sequence[str] | None = None,
    measured_rate_hz: float | None = None,
    sensors: Mapping[str, ArrayLike] | None = None,
) -> xr.Dataset:
    """Return a run set from plain arrays.

    Args:
        time: Uniform grid from 0, (time,) [s].
        command: Reference of each motor, (run, time, motor), or (time, motor) of one run [rad].
        measured: Path of the tool in the base frame, (run, time, axis), or (time, axis) of one
            run [m]; NaN = no sample. None: not measured.
        motors: Names of the motors in chain order; None: ``motor_1``, ``motor_2``, ...
        names: Unique name of each run; None: ``run_1``, ``run_2``, ...
        measured_rate_hz: True rate of the tool sensor [Hz]; None: the rate of the grid.
        sensors: Readings of other sensors, by variable (`accelerometer`, `position`, ...), each
            with a first axis for runs, or without where `command` has none.

    Raises:
        InputError: If shapes do not fit together, or the grid is not uniform from 0.
    """
    grid, reference = as_floats(time), as_floats(command)
    unseen = np.full((*reference.shape[:-1], len(AXES)), np.nan)
    path = unseen if measured is None else as_floats(measured)
    others = {name: as_floats(values) for name, values in (sensors or {}).items()}
    for name in others:
        if name not in VARIABLES:
            raise unknown_name("sensor variable", name, VARIABLES)
    if reference.ndim == 2 and path.ndim == 2:
        reference, path = reference[None], path[None]
        others = {name: values[None] for name, values in others.items()}
    if grid.ndim != 1 or len(grid) < 2 or reference.ndim != 3 or path.ndim != 3:
        raise InputError(
            f"the arrays have shapes {grid.shape} (time), {reference.shape} (command) and "
            f"{path.shape} (measured). Expected (time,), (run, time, motor) and (run, time, 3)."
        )
    rate = (len(grid) - 1) / (grid[-1] - grid[0]) if measured_rate_hz is None else measured_rate_hz
    return RunTable(
        run=names or [f"run_{k + 1}" for k in range(len(reference))],
        motor=motors or [f"motor_{k + 1}" for k in range(reference.shape[2])],
        time=grid,
        command=reference,
        measured=path,
        measured_rate_hz=float(rate),
        sensors=others,
    ).to_dataset()


def check_runs(runs: xr.Dataset, where: str) -> xr.Dataset:
    """Return `runs` if they satisfy the contract of a run set."""
    check_layout(runs, where)
    _check_values(runs, where)
    check_duration(runs, where)
    return runs


def check_layout(runs: xr.Dataset, where: str) -> None:
    """Raise InputError unless names, dimensions and grid are right; reads no values of the runs."""
    _check_variables(runs, where)
    if runs.sizes["run"] == 0:
        raise InputError(f"{where}: holds no runs. Expected at least one.")
    if tuple(map(str, runs["axis"].values)) != AXES:
        raise InputError(f"{where}: coordinate `axis` is {runs['axis'].values}, expected x, y, z.")
    _check_time(as_floats(runs["time"].values), where)
    for coordinate in ("run", "motor"):
        names = [str(name) for name in runs[coordinate].values]
        if len(set(names)) < len(names):
            raise InputError(
                f"{where}: {coordinate} names are not unique. Rename those that repeat."
            )
    rate = runs.attrs.get("measured_rate_hz", 1.0)
    if not (isinstance(rate, int | float | np.number) and 0.0 < rate < np.inf):
        raise InputError(f"{where}: `measured_rate_hz` is {rate!r}, expected a rate above 0 [Hz].")


def check_motors(runs: xr.Dataset, robot: str, names: Sequence[str]) -> None:
    """Raise InputError unless the runs have the motors `names` of the robot."""
    motors = [str(name) for name in runs["motor"].values]
    if motors != list(names):
        raise InputError(
            f"the run set has motors {', '.join(motors)}; robot {robot!r} has "
            f"{', '.join(names)}. Name the right robot (--robot)."
        )


def _check_variables(runs: xr.Dataset, where: str) -> None:
    for name in REQUIRED:
        if name not in runs:
            present = ", ".join(sorted(map(str, runs.data_vars))) or "nothing"
            raise InputError(
                f"{where}: no variable `{name}`; it holds {present}. A run set needs "
                f"`command` (run, time, motor) [rad] and `measured` (run, time, axis) [m]."
            )
    for name in ("run", "time", "motor", "axis"):
        if name not in runs.coords:
            raise InputError(f"{where}: no coordinate `{name}`. A run set names every {name}.")
    for name, (dims, _) in VARIABLES.items():
        if name in runs and runs[name].dims != dims:
            raise InputError(
                f"{where}: `{name}` has dimensions {runs[name].dims}, expected {dims}."
            )


def _check_values(runs: xr.Dataset, where: str) -> None:
    for name, most in LARGEST.items():
        if name not in runs:
            continue
        if runs[name].dtype.kind not in "fiu":
            raise InputError(f"{where}: `{name}` holds {runs[name].dtype}, expected numbers.")
        largest = float(np.nanmax(np.abs(runs[name].values), initial=0.0))
        if largest > most:
            raise InputError(
                f"{where}: `{name}` holds values up to {largest:g} {VARIABLES[name][1]}. Check "
                "its unit."
            )


def _check_time(time: FloatArray, where: str) -> None:
    if len(time) < 2:
        raise InputError(f"{where}: `time` has {len(time)} samples, expected at least two.")
    steps = np.diff(time)
    if not np.all(np.isfinite(time)) or steps.min() <= 0:
        raise InputError(f"{where}: `time` does not increase. Expected a uniform grid from 0 [s].")
    if abs(time[0]) > 1e-9 or np.ptp(steps) > UNIFORM * steps.mean():
        raise InputError(
            f"{where}: `time` is not a uniform grid from 0 (it starts at {time[0]:g} s with steps "
            f"of {steps.min():g} to {steps.max():g} s). Resample onto one, with NaN in `measured` "
            f"where there is no sample."
        )


def check_duration(runs: xr.Dataset, where: str, last: float = np.inf) -> None:
    """Raise InputError unless every run has a positive duration and ends by the time `last` [s]."""
    if "duration" not in runs:
        return
    numbers = runs["duration"].dtype.kind in "fiu"
    length = as_floats(runs["duration"].values) if numbers else np.array([np.nan])
    wrong = ~((length > 0.0) & (length < np.inf) & (length <= last * (1.0 + UNIFORM)))
    if wrong.any():
        run = runs["run"].values[int(np.argmax(wrong))]
        raise InputError(
            f"{where}: `duration` of run {str(run)!r} is {length[wrong][0]:g}, expected a time "
            f"above 0 up to the end of `time`, {runs['time'].values[-1]:g} s."
        )


def time_step(runs: xr.Dataset) -> float:
    """Return the step of the time grid [s]."""
    time = runs["time"].values
    return float((time[-1] - time[0]) / (len(time) - 1))


def measured_rate(runs: xr.Dataset) -> float:
    """Return the true rate of the tool sensor [Hz]; default: the rate of the grid."""
    return float(runs.attrs.get("measured_rate_hz", 1.0 / time_step(runs)))


def concatenate(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return one run set of all runs in `parts`, padded to the longest, with unique names.

    Variables missing in any part are dropped; repeated run names get a number. The lowest sensor
    rate is kept, so that no reading counts twice. All are put on the finest of their time grids.
    """
    import xarray as xr

    if not parts:
        raise InputError("there are no runs to put together. Expected one run set at least.")
    first = parts[0]
    if len(parts) == 1:
        return first
    for part in parts[1:]:
        _check_same_motors(first, part)
    rate_hz, step = min(map(measured_rate, parts)), min(map(time_step, parts))
    parts = [_on_step(part, step) for part in parts]
    first = parts[0]
    length = max(part.sizes["time"] for part in parts)
    longest = next(part for part in parts if part.sizes["time"] == length)
    shared = [n for n in first.data_vars if all(n in part for part in parts)]
    count = sum(part.sizes["run"] for part in parts)
    size = padded_bytes(count, length, first.sizes["motor"])
    check_memory(size, "the runs", f"{count} runs, padded to {length} samples,")
    sizes = {"time": length, "movement": max(p.sizes.get("movement", 0) for p in parts)}
    whole = xr.Dataset(
        {name: _stacked([part[name] for part in parts], sizes) for name in shared},
        {name: longest[name] for name in first.coords if name in first.dims and name != "run"},
        first.attrs,
    )
    whole.attrs["measured_rate_hz"] = rate_hz
    names = [str(name) for part in parts for name in part["run"].values]
    return whole.assign_coords(run=np.asarray(unique_names(names), dtype=object))


def padded_bytes(runs: int, samples: int, motors: int) -> float:
    """Return the memory of padded runs: commands, tool path, readings [bytes]."""
    return 8.0 * runs * samples * (2 * motors + len(AXES))


def _check_same_motors(first: xr.Dataset, other: xr.Dataset) -> None:
    motors = [list(map(str, part["motor"].values)) for part in (first, other)]
    if motors[0] != motors[1]:
        raise InputError(f"runs with motors {motors[0]} and {motors[1]} cannot form one run set.")


def _on_step(runs: xr.Dataset, step: float) -> xr.Dataset:
    """Return runs on a time grid that is as fine or finer, with a step in seconds.

    Commands go straight on between samples, and so do readings whose gaps lines have filled; others
    are at the nearest time.
    """
    if np.isclose(time_step(runs), step, rtol=UNIFORM):
        return runs
    time = as_floats(runs["time"].values)
    place = np.rint((time - time[0]) / step).astype(np.int64)
    grid = time[0] + step * np.arange(place[-1] + 1)
    seldom = measured_rate(runs) * time_step(runs) < 1.0 - UNIFORM

    def told(values: FloatArray) -> FloatArray:
        return np.asarray(np.interp(grid, time, values))

    def read(values: FloatArray) -> FloatArray:
        there = np.flatnonzero(np.isfinite(values))
        if seldom and len(there) and np.ptp(there) + 1 == len(there):
            return told(values)
        found = np.full(len(grid), np.nan)
        found[place] = values
        return found

    timed = {
        name: (of.dims, np.apply_along_axis(move, of.dims.index("time"), of.values), of.attrs)
        for name, of in runs.data_vars.items()
        if "time" in of.dims
        for move in [told if name == "command" else read]
    }
    return (
        runs.drop_vars([*timed, "time"])
        .assign(timed)
        .assign_coords(time=("time", grid, runs["time"].attrs))
    )


def _stacked(parts: Sequence[xr.DataArray], sizes: Mapping[str, int]) -> xr.Variable:
    """Return one variable of all runs, padded: command held, everything else NaN."""
    import xarray as xr

    first = parts[0]
    if "run" not in first.dims:
        return first.variable
    values = [part.values for part in parts]
    for axis, dim in enumerate(first.dims):
        if dim in sizes:
            values = [_padded(v, axis, sizes[str(dim)], first.name == "command") for v in values]
    return xr.Variable(first.dims, np.concatenate(values, first.dims.index("run")), first.attrs)


def _padded(values: NDArray[Any], axis: int, size: int, held: bool) -> NDArray[Any]:
    """Return values that are as long as `size` on one axis; the last is held, or NaN follows."""
    missing = size - values.shape[axis]
    if missing == 0:
        return values
    shape = [missing if k == axis else n for k, n in enumerate(values.shape)]
    more = np.broadcast_to(values.take([-1], axis) if held else np.nan, shape)
    return np.concatenate([values, more], axis)


def unique_names(names: Sequence[str]) -> list[str]:
    """Return `names` with a number appended to repeated ones."""
    given, used, unique = set(names), set[str](), []
    for name in names:
        number, candidate = 2, name
        while candidate in used or (candidate != name and candidate in given):
            candidate, number = f"{name}#{number}", number + 1
        used.add(candidate)
        unique.append(candidate)
    return unique


def truth_of(runs: xr.Dataset) -> list[str] | None:
    """Return the true hypothesis of every run, or None where the run set has none."""
    return [str(f) for f in runs["fault"].values] if "fault" in runs else None


def truths_of(runs: xr.Dataset) -> list[str | None]:
    """Return the true hypothesis of every run; None where it is not known."""
    known = truth_of(runs)
    return [None] * runs.sizes["run"] if known is None else [*known]
