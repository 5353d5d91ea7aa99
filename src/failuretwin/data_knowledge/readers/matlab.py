"""The published MATLAB files: pairs of data set and hidden data set, and cell arrays of runs.

A pair holds one run: `dataset_i.mat` the desired and the measured path side by side, and
`hidden_dataset_i.mat` the commands and responses of the motors. A cell-array file holds many
runs, paths only; their commands are recovered from the desired path.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError, needs_extra, unknown_name
from failuretwin.core.foreign import as_cell, files_below, reading
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.runs import AXES, RunSet, RunTable, Truth, truth_of
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.readers.file_claims import check_matlab
from failuretwin.data_knowledge.readers.raw_sessions import READING_RATE_HZ, published_onset
from failuretwin.data_knowledge.recovery import recover_movements
from failuretwin.data_knowledge.store import SUFFIXES, filling, replacing, save_run_set
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

CELL_ARRAYS = (("X_test_array", "y_test_array"), ("X_array", "y_array"))
"""Names of the runs and of their labels in cell-array files."""
PATH_COLUMNS = 6
"""Desired xyz, then measured xyz."""
SAME_PATH_M = 1e-6
"""Commands belong to a desired path if their kinematics differ from it by less than this [m]."""
HEALTHY_LABEL = "Healthy"


@dataclass(frozen=True)
class _Paths:
    """Desired and measured path of one run, (time, axis) [m], and its label as text."""

    name: str
    desired: FloatArray
    measured: FloatArray
    label: str | None


def label_text(hypothesis: str) -> str:
    """Return the published label of a hypothesis, such as ``Motor_1_Stuck``."""
    if hypothesis == "healthy":
        return HEALTHY_LABEL
    return "_".join(part.capitalize() for part in hypothesis.split(":"))


def hypothesis_of_label(label: str, robot: Robot) -> str | None:
    """Return the hypothesis that a published label stands for, None if it is none of them."""
    names = [str(h) for h in paper_hypotheses(robot.motor_names)]
    return {label_text(name).lower(): name for name in names}.get(label.strip().lower())


def find_matlab_files(folder: Path) -> list[Path]:
    """Return the files of runs at or below `folder`: cell arrays and first halves of pairs."""
    files = sorted(files_below(folder, "*.mat"), key=_natural_order)
    return [path for path in files if not path.name.startswith("hidden_")]


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a key that puts `dataset_2` before `dataset_10`."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def read_matlab_file(path: Path, robot: Robot) -> RunTable:
    """Read the run or the runs of a published MATLAB file.

    Args:
        path: A cell-array file, or `dataset_i.mat` with `hidden_dataset_i.mat` beside it; without
            the latter the commands are recovered.
        robot: The robot that the runs are of.

    Raises:
        InputError: If the file is none of these, or the commands cannot be recovered.
    """
    content = _load(path)
    for runs, labels in CELL_ARRAYS:
        if runs in content:
            texts = [str(np.ravel(cell)[0]) for cell in np.ravel(content.get(labels, []))]
            paths = _cell_paths(path, list(np.ravel(content[runs])), runs, texts, robot)
            return _recovered(paths, robot)
    if "dataset" in content:
        hidden = path.with_name(f"hidden_{path.name}")
        name = f"{path.parent.name}/{path.stem}"
        run = _Paths(name, *_split_paths(content["dataset"], str(path)), path.parent.name)
        if hidden.exists():
            return _pair_run(run, hidden, path, robot)
        return _recovered([run], robot)
    present = ", ".join(name for name in content if not name.startswith("__")) or "nothing"
    hint = " Give the folder, or the dataset_i.mat beside it." if "hidden" in path.name else ""
    raise InputError(
        f"{path}: holds {present}; expected `dataset` (1000 x 6), or `X_test_array` or `X_array` "
        f"(cells of 1000 x 6).{hint}"
    )


def _load(path: Path) -> dict[str, Any]:
    # It sets a deprecated option of pandas when imported.
    with needs_extra(f"{path}: MATLAB files need mat-io", "files"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from matio import load_from_mat
    with reading(path, "a MATLAB file"), path.open("rb") as file:
        newest = file.read(10) == b"MATLAB 7.3"
    if newest:
        raise InputError(f"{path}: is of MATLAB's version 7.3. Save it again with the option -v7.")
    check_matlab(path)
    with reading(path, "a MATLAB file", "Save it again with the option -v7."):
        return dict(load_from_mat(str(path)))


def _cell_paths(
    path: Path, cells: Sequence[Any], runs: str, labels: Sequence[str], robot: Robot
) -> list[_Paths]:
    """Return the runs in a cell array `runs`, with the labels beside it, if any."""
    if len(cells) == 0:
        raise InputError(f"{path}: `{runs}` holds no runs. Expected cells of (samples, 6).")
    if labels and len(labels) != len(cells):
        raise InputError(f"{path}: {len(cells)} runs in `{runs}` but {len(labels)} labels.")
    _check_labels(labels, robot, path)
    paths = []
    for i, cell in enumerate(cells):
        name = f"{path.stem}/run_{i + 1:03d}"
        label = labels[i] if labels else None
        paths.append(_Paths(name, *_split_paths(cell, f"{path}: {name}"), label))
    lengths = {len(run.desired) for run in paths}
    if len(lengths) > 1:
        raise InputError(f"{path}: runs have {sorted(lengths)} samples; expected equally many.")
    return paths


def _recovered(paths: Sequence[_Paths], robot: Robot) -> RunTable:
    """Return runs with commands recovered from their desired paths."""
    desired, names = np.stack([run.desired for run in paths]), [run.name for run in paths]
    time, movements = recover_movements(desired, robot, names=names)
    shifted = replace(movements, start=movements.start - time[0])
    return _table(paths, time - time[0], shifted, READING_RATE_HZ, robot)


def _pair_run(run: _Paths, hidden: Path, path: Path, robot: Robot) -> RunTable:
    """Return the run of a pair, with the commands and responses in its hidden half."""
    time, command, response_time, response = _hidden(hidden, len(robot.motors))
    same = len(command) == len(run.desired)
    if not same or np.abs(DigitalTwin(robot).path(command) - run.desired).max() >= SAME_PATH_M:
        raise InputError(f"{path}: its desired path is not that of the commands in {hidden.name}.")
    late = round((response_time[0] - time[0]) / (time[1] - time[0]))
    drawn_out = np.mean(np.abs(np.diff(response, 2, axis=0)).max(axis=1) > 1e-9) < 0.5
    rate = READING_RATE_HZ if drawn_out else (len(time) - 1) / (time[-1] - time[0])
    table = _table(
        [replace(run, measured=_later(run.measured, late))],
        time - time[0],
        find_movements(command[None], time - time[0]),
        float(rate),
        robot,
    )
    return replace(table, command=command[None], position=_later(response, late)[None])


def _later(values: FloatArray, samples: int) -> FloatArray:
    """Return `values` (time, ...) at the samples where they belong, NaN before the first."""
    if samples <= 0:
        return values
    return np.concatenate([np.full_like(values[:samples], np.nan), values[:-samples]])


def _hidden(path: Path, motors: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return times and angles of commands and of responses, (time,) [s], (time, motor) [rad]."""
    content = _load(path)
    if "hidden_dataset" not in content:
        raise InputError(f"{path}: holds no `hidden_dataset`.")
    halves = np.ravel(content["hidden_dataset"])
    if len(halves) != 2 or any(np.size(half) < motors for half in halves):
        raise InputError(
            f"{path}: expected two cells, commands and responses, of {motors} motors or more."
        )
    found = []
    for half in halves:
        with reading(path, "commands and responses", "Expected a timeseries for each motor."):
            series = [_series(item, path) for item in np.ravel(half)[:motors]]
            found += [series[0][0], np.stack([values for _, values in series], axis=1)]
    return found[0], found[1], found[2], found[3]


def _series(item: Any, path: Path) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and values [rad] of a MATLAB timeseries, or of a structure like one."""
    while isinstance(item, np.ndarray) and item.dtype == object:
        item = item.ravel()[0]
    if isinstance(item, np.ndarray):  # a plain structure: fields Time and Data
        return np.ravel(item["Time"].item()), np.ravel(item["Data"].item())
    values = np.ravel(as_floats(item.properties["Data_"]))
    info = item.properties["TimeInfo"].properties
    if np.size(info["Time_"]):
        return np.ravel(as_floats(info["Time_"])), values
    if not np.size(info["Start_"]) or not np.size(info["Increment_"]):
        raise InputError(f"{path}: a timeseries has neither times nor start and increment.")
    # A uniform timeseries stores no times.
    start, step = float(np.ravel(info["Start_"])[0]), float(np.ravel(info["Increment_"])[0])
    return as_floats(start + step * np.arange(len(values))), values


def _table(
    paths: Sequence[_Paths], time: FloatArray, movements: Movements, rate: float, robot: Robot
) -> RunTable:
    return RunTable(
        run=[run.name for run in paths],
        motor=robot.motor_names,
        time=time,
        command=movements.reference(time),
        measured=np.stack([run.measured for run in paths]),
        measured_rate_hz=rate,
        movements=movements,
        truth=_truth(paths, time, robot),
    )


def _truth(paths: Sequence[_Paths], time: FloatArray, robot: Robot) -> Truth | None:
    """Return what the labels say; None unless every run has a known one."""
    faults = [hypothesis_of_label(run.label or "", robot) for run in paths]
    if any(fault is None for fault in faults):
        return None
    known = [str(fault) for fault in faults]
    return Truth(
        fault=known,
        detail=[{"source": "published label", "label": run.label} for run in paths],
        onset=np.array([published_onset(fault, time) for fault in known]),
        magnitude=np.full(len(known), np.nan),
    )


def _check_labels(texts: Sequence[str], robot: Robot, path: Path) -> None:
    """Raise InputError if some labels are known and others are not; all unknown is no truth."""
    unknown = [text for text in texts if hypothesis_of_label(text, robot) is None]
    if unknown and len(unknown) < len(texts):
        valid = [label_text(str(h)) for h in paper_hypotheses(robot.motor_names)]
        raise InputError(f"{path}: {unknown_name('label', unknown[0], valid)}")


def _split_paths(values: Any, where: str) -> tuple[FloatArray, FloatArray]:
    try:
        both = as_floats(values)
    except (TypeError, ValueError):
        raise InputError(f"{where}: holds no table of numbers.") from None
    if both.ndim != 2 or both.shape[1] != PATH_COLUMNS or len(both) < 2:
        raise InputError(
            f"{where}: has shape {both.shape}, expected (samples, 6): desired xyz, measured xyz."
        )
    if not np.all(np.isfinite(both[:, :3])):
        raise InputError(f"{where}: the desired path has values that are not finite.")
    return both[:, :3], both[:, 3:]


# Run sets as files that other people's tools read: the published MATLAB layouts and CSV.

UNLABELLED = "Unlabelled"


def export_runs(runs: RunSet, path: Path, twin: DigitalTwin) -> None:
    """Write a run set in the layout that the name of `path` asks for.

    Args:
        runs: The run set.
        path: ``.nc`` or ``.zarr``: a run set; ``.mat``: one file of cells as published; ``.csv``:
            a row for each sample; no suffix: a folder of published pairs by class.
        twin: Kinematics, for the desired path.

    Raises:
        InputError: If the suffix is none of these.
        OutputError: If it cannot be written; nothing is left behind.
    """
    check_export_suffix(path)
    if path.suffix in SUFFIXES:
        save_run_set(runs, path)
    elif path.suffix == ".mat":
        write_cell_array(runs, path, twin)
    elif path.suffix == ".csv":
        write_csv(runs, path)
    else:
        write_pairs(runs, path, twin)


def check_export_suffix(path: Path) -> None:
    """Raise InputError unless the name of `path` asks for a known layout."""
    if path.suffix not in (*SUFFIXES, ".mat", ".csv", ""):
        raise InputError(
            f"{path}: expected a name that ends in .nc or .zarr (run set), .mat (published cells), "
            ".csv (a row for each sample), or has no ending (folder of published pairs)."
        )


def write_cell_array(runs: RunSet, path: Path, twin: DigitalTwin) -> None:
    """Write all runs to one file with `X_test_array` and `y_test_array`, 1 x N cells."""
    labels = _labels(runs)
    content = {
        "X_test_array": _cells([_both_paths(runs, i, twin) for i in range(len(labels))]),
        "y_test_array": _cells(labels),
    }
    with replacing(path) as partial:
        partial.write_bytes(_matlab_bytes(content))


def write_pairs(runs: RunSet, folder: Path, twin: DigitalTwin) -> None:
    """Write `<Class>/dataset_i.mat` and `hidden_dataset_i.mat` for every run into a new folder.

    MATLAB's timeseries objects cannot be written; their place is taken by structures with the
    fields Time and Data.
    """
    if folder.exists():
        raise InputError(f"{folder}: exists already. Give the name of a new folder.")
    count: dict[str, int] = {}
    with filling(folder) as partial:
        for i, label in enumerate(_labels(runs)):
            count[label] = number = count.get(label, 0) + 1
            place = partial / label
            place.mkdir(parents=True, exist_ok=True)
            dataset = {"dataset": _both_paths(runs, i, twin)}
            (place / f"dataset_{number}.mat").write_bytes(_matlab_bytes(dataset))
            hidden = _matlab_bytes({"hidden_dataset": _hidden_cells(runs, i)})
            (place / f"hidden_dataset_{number}.mat").write_bytes(hidden)


def _labels(runs: RunSet) -> list[str]:
    truth = truth_of(runs)
    if truth is None:
        return [UNLABELLED] * runs.sizes["run"]
    return [label_text(fault) for fault in truth]


def _both_paths(runs: RunSet, run: int, twin: DigitalTwin) -> FloatArray:
    """Return desired and measured path, (time, 6) [m]; missing samples drawn out by lines."""
    time = as_floats(runs["time"].values)
    desired = twin.path(as_floats(runs["command"].values[run]))
    return np.hstack([desired, _drawn_out(time, as_floats(runs["measured"].values[run]))])


def _drawn_out(time: FloatArray, values: FloatArray) -> FloatArray:
    seen = np.isfinite(values).all(axis=1)
    if seen.all() or not seen.any():
        return values
    return np.stack([np.interp(time, time[seen], v[seen]) for v in values.T], axis=1)


def _hidden_cells(runs: RunSet, run: int) -> Any:
    time = as_floats(runs["time"].values)
    command = as_floats(runs["command"].values[run])
    response = command * np.nan
    if "position" in runs:
        response = _drawn_out(time, as_floats(runs["position"].values[run]))
    halves = [
        _cells([{"Time": time[:, None], "Data": motor[:, None]} for motor in angles.T])
        for angles in (command, response)
    ]
    return _cells(halves)


def _cells(items: list[Any]) -> Any:
    cells = np.empty((1, len(items)), dtype=object)
    for i, item in enumerate(items):
        cells[0, i] = item
    return cells


def _matlab_bytes(content: dict[str, Any]) -> bytes:
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, content, do_compression=True)  # type: ignore[arg-type]  # stubs know paths only
    return buffer.getvalue()


def write_csv(runs: RunSet, path: Path) -> None:
    """Write a row for each sample: run, time [s], commands [rad], tool position [m]."""
    import pandas as pd

    time = as_floats(runs["time"].values)
    ends = runs["duration"].values if "duration" in runs else time[-1:]
    kept = np.broadcast_to(time <= ends[:, None] + 1e-9, runs["command"].shape[:2])
    run, sample = np.nonzero(kept)
    names = np.array([as_cell(str(name)) for name in runs["run"].values], dtype=object)
    columns: dict[str, Any] = {"run": names[run], "time_s": time[sample]}
    for m, motor in enumerate(runs["motor"].values):
        columns[f"command_{motor}_rad"] = runs["command"].values[kept, m]
    for a, axis in enumerate(AXES):
        columns[f"tool_{axis}_m"] = runs["measured"].values[kept, a]
    with replacing(path) as partial:
        pd.DataFrame(columns).to_csv(partial, index=False)
