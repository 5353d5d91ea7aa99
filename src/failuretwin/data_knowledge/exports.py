"""Run sets as files that other people's tools read: the published MATLAB layouts and CSV."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.runs import AXES, truth_of
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.matlab_files import label_text
from failuretwin.data_knowledge.store import SUFFIXES, filling, replacing, save_run_set
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

UNLABELLED = "Unlabelled"


def export_runs(runs: xr.Dataset, path: Path, twin: DigitalTwin) -> None:
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


def write_cell_array(runs: xr.Dataset, path: Path, twin: DigitalTwin) -> None:
    """Write all runs to one file with `X_test_array` and `y_test_array`, 1 x N cells."""
    labels = _labels(runs)
    content = {
        "X_test_array": _cells([_both_paths(runs, i, twin) for i in range(len(labels))]),
        "y_test_array": _cells(labels),
    }
    with replacing(path) as partial:
        partial.write_bytes(_matlab_bytes(content))


def write_pairs(runs: xr.Dataset, folder: Path, twin: DigitalTwin) -> None:
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
            hidden = _matlab_bytes({"hidden_dataset": _hidden(runs, i)})
            (place / f"hidden_dataset_{number}.mat").write_bytes(hidden)


def _labels(runs: xr.Dataset) -> list[str]:
    truth = truth_of(runs)
    if truth is None:
        return [UNLABELLED] * runs.sizes["run"]
    return [label_text(fault) for fault in truth]


def _both_paths(runs: xr.Dataset, run: int, twin: DigitalTwin) -> FloatArray:
    """Return desired and measured path, (time, 6) [m]; missing samples drawn out by lines."""
    time = as_floats(runs["time"].values)
    desired = twin.path(as_floats(runs["command"].values[run]))
    return np.hstack([desired, _drawn_out(time, as_floats(runs["measured"].values[run]))])


def _drawn_out(time: FloatArray, values: FloatArray) -> FloatArray:
    seen = np.isfinite(values).all(axis=1)
    if seen.all() or not seen.any():
        return values
    return np.stack([np.interp(time, time[seen], v[seen]) for v in values.T], axis=1)


def _hidden(runs: xr.Dataset, run: int) -> Any:
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


def write_csv(runs: xr.Dataset, path: Path) -> None:
    """Write a row for each sample: run, time [s], commands [rad], tool position [m]."""
    import pandas as pd

    time = as_floats(runs["time"].values)
    ends = runs["duration"].values if "duration" in runs else [time[-1]] * runs.sizes["run"]
    parts = []
    for run, end in enumerate(ends):
        kept = time <= end + 1e-9
        columns: dict[str, Any] = {"run": str(runs["run"].values[run]), "time_s": time[kept]}
        for m, motor in enumerate(runs["motor"].values):
            columns[f"command_{motor}_rad"] = runs["command"].values[run, kept, m]
        for a, axis in enumerate(AXES):
            columns[f"tool_{axis}_m"] = runs["measured"].values[run, kept, a]
        parts.append(pd.DataFrame(columns))
    with replacing(path) as partial:
        pd.concat(parts).to_csv(partial, index=False)
