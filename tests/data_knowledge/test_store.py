from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from failuretwin import read_runs
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.runs import RunTable, Truth
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.calibrated_robot import load_calibration

SUFFIXES = pytest.mark.parametrize("suffix", [".nc", ".zarr"])
names = st.text(st.characters(codec="utf-8", exclude_categories=["C"]), min_size=1, max_size=20)


def small(names=("a", "b"), fill=0.25, samples=11, **changes):
    return RunTable(
        run=names,
        motor=("motor_1", "motor_2"),
        time=np.arange(samples) * 0.1,
        command=np.full((len(names), samples, 2), fill),
        measured=np.full((len(names), samples, 3), fill),
        measured_rate_hz=10.0,
        **changes,
    ).to_dataset()


@st.composite
def run_sets(draw):
    runs = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    samples = draw(st.integers(2, 6))
    numbers = st.floats(-1e5, 1e5) | st.just(float("nan"))
    value = np.array(draw(st.lists(numbers, min_size=len(runs), max_size=len(runs))))
    truth = Truth(runs, [{"text": name} for name in runs], value, value)
    measured = np.broadcast_to(value[:, None, None], (len(runs), samples, 3))
    whole = small(runs, samples=samples, truth=draw(st.sampled_from([None, truth])))
    whole["measured"] = whole["measured"].copy(data=measured)
    return whole.assign_attrs(seed=draw(st.integers(0, 2**31)), source=draw(names))


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def contents(path):
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {str(file.relative_to(path.parent)): file.read_bytes() for file in files}


@SUFFIXES
@settings(max_examples=15)
@given(runs=run_sets())
def test_what_is_written_is_read_back(tmp_path_factory, suffix, runs):
    path = tmp_path_factory.mktemp("store") / f"runs{suffix}"
    save_run_set(runs, path)
    xr.testing.assert_identical(load_run_set(path), runs)


@SUFFIXES
@pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
def test_simulated_runs_are_read_back(tmp_path, armpi, suffix, imperfections):
    known = load_calibration(imperfections, armpi).imperfections
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 1, imperfections=known))
    save_run_set(runs, tmp_path / f"runs{suffix}")
    xr.testing.assert_identical(read_runs(tmp_path / f"runs{suffix}"), runs)


@SUFFIXES
def test_real_runs_are_read_back(tmp_path, measured, suffix):
    save_run_set(measured, tmp_path / f"runs{suffix}")
    xr.testing.assert_identical(load_run_set(tmp_path / f"runs{suffix}"), measured)


@SUFFIXES
def test_a_run_set_of_that_name_is_replaced(tmp_path, suffix):
    path = tmp_path / f"runs{suffix}"
    save_run_set(small(("old", "older")), path)
    save_run_set(small(("new",)), path)
    xr.testing.assert_identical(load_run_set(path), small(("new",)))
    assert listing(tmp_path) == [path.name]


@pytest.fixture(params=[".nc", ".zarr"])
def old(request, tmp_path):
    """Path of a run set that stands there already."""
    path = tmp_path / f"runs{request.param}"
    save_run_set(small(("old",)), path)
    return path


def fails_midway(error):
    """Return a writer that leaves half a file, then fails."""

    def write(self, store=None, *args, **kwargs):
        target = next((Path(a) for a in (store, *args) if isinstance(a, str | Path)), None)
        if target is not None and target.suffix == ".zarr":
            target.mkdir()
            (target / "half").write_bytes(b"half")
        elif target is not None:
            target.write_bytes(b"half")
        raise error

    return write


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("HDF5")])
def test_failed_write_leaves_what_was_there(monkeypatch, old, error):
    before = contents(old)
    monkeypatch.setattr(xr.Dataset, "to_netcdf", fails_midway(error))
    monkeypatch.setattr(xr.Dataset, "to_zarr", fails_midway(error))

    with pytest.raises(OutputError, match=rf"{old.name}: could not be written \({error.args[-1]}"):
        save_run_set(small(("new",)), old)

    assert contents(old) == before
    assert listing(old.parent) == [old.name]


def test_interrupted_write_leaves_what_was_there(monkeypatch, old):
    before = contents(old)
    monkeypatch.setattr(xr.Dataset, "to_netcdf", fails_midway(KeyboardInterrupt()))
    monkeypatch.setattr(xr.Dataset, "to_zarr", fails_midway(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        save_run_set(small(("new",)), old)
    assert contents(old) == before
    assert listing(old.parent) == [old.name]


def test_failure_to_take_the_old_ones_place_leaves_what_was_there(monkeypatch, old):
    before = contents(old)
    replace, refused = Path.replace, []

    def refuse(self, target):
        if Path(target) == old and not refused:
            refused.append(self)
            raise OSError(5, "Input/output error")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(OutputError, match="Input/output error"):
        save_run_set(small(("new",)), old)
    assert contents(old) == before
    assert listing(old.parent) == [old.name]


def test_a_folder_that_a_kill_left_aside_is_removed(tmp_path):
    path = tmp_path / "runs.zarr"
    save_run_set(small(("oldest",)), path)
    path.rename(tmp_path / ".runs.zarr.old")
    save_run_set(small(("old", "older")), path)
    assert listing(tmp_path) == [path.name]
    (tmp_path / ".runs.zarr.old").mkdir()
    save_run_set(small(("new",)), path)
    xr.testing.assert_identical(load_run_set(path), small(("new",)))
    assert listing(tmp_path) == [path.name]


def test_a_zarr_store_is_not_written_over_a_file(tmp_path):
    (tmp_path / "runs.zarr").write_text("mine")
    with pytest.raises(OutputError, match=r"is a file, and a Zarr store is a folder"):
        save_run_set(small(), tmp_path / "runs.zarr")
    assert (tmp_path / "runs.zarr").read_text() == "mine"


@SUFFIXES
def test_missing_folder_is_named(tmp_path, suffix):
    with pytest.raises(OutputError, match=r"nowhere does not exist\. Make it first"):
        save_run_set(small(), tmp_path / "nowhere" / f"runs{suffix}")
    assert listing(tmp_path) == []


@SUFFIXES
def test_a_file_is_no_folder_to_write_to(tmp_path, suffix):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError):
        save_run_set(small(), tmp_path / "file" / f"runs{suffix}")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_is_not_overwritten_by_a_file(tmp_path):
    (tmp_path / "runs.nc").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        save_run_set(small(), tmp_path / "runs.nc")


@pytest.mark.parametrize("name", ["runs", "runs.h5", "runs.csv"])
def test_other_suffixes_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"ends in \.nc \(NetCDF\) or \.zarr"):
        save_run_set(small(), tmp_path / name)


@pytest.mark.parametrize("text", [b"", b"junk" * 100])
@SUFFIXES
def test_files_that_are_no_run_sets_are_refused(tmp_path, text, suffix):
    path = tmp_path / f"runs{suffix}"
    path.write_bytes(text)
    with pytest.raises(InputError, match=rf"{path.name}: cannot be read as a run set"):
        load_run_set(path)


@SUFFIXES
def test_empty_folders_are_refused(tmp_path, suffix):
    path = tmp_path / f"runs{suffix}"
    path.mkdir()
    with pytest.raises(InputError, match=rf"{path.name}: cannot be read as a run set"):
        load_run_set(path)


@SUFFIXES
def test_datasets_of_something_else_are_refused(tmp_path, suffix):
    path = tmp_path / f"runs{suffix}"
    save_run_set(small().drop_vars("measured"), path)
    with pytest.raises(InputError, match=rf"{path.name}: no variable `measured`"):
        load_run_set(path)


def test_file_cut_short_is_refused(tmp_path, published):
    path = tmp_path / "runs.nc"
    save_run_set(published.isel(run=slice(0, 3)), path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="cannot be read as a run set"):
        load_run_set(path)


def test_a_set_whose_grid_was_thinned_is_read_and_one_that_was_cut_is_not(tmp_path):
    runs = small(samples=12)
    save_run_set(runs.isel(time=slice(None, None, 2)), tmp_path / "thin.nc")
    np.testing.assert_allclose(load_run_set(tmp_path / "thin.nc")["duration"], 1.1)
    save_run_set(runs.isel(time=slice(0, 6)), tmp_path / "cut.nc")
    with pytest.raises(InputError, match=r"`duration` of run 'a' is 1\.1, .* `time`, 0\.5 s"):
        load_run_set(tmp_path / "cut.nc")
