"""Run sets made piece by piece: the same bytes whoever makes them, whatever happens meanwhile."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from executed import command_line
from failuretwin import read_runs
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge import pieces
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.pieces import versions
from failuretwin.data_knowledge.resumable import UnfinishedRunSet, produce
from failuretwin.data_knowledge.store import load_run_set, save_run_set, sole_writer
from failuretwin.data_knowledge.workers import ONE_PROCESS
from failuretwin.digital_model.calibrated_robot import load_calibration

HYPOTHESES = ("healthy", "motor_1:stuck", "motor_2:steady_state_error")
RUNS_PER_CLASS = 3
PIECE = 4
PIECES = 3
"""9 runs in pieces of four."""
MAKE = UnfinishedRunSet.make


@pytest.fixture(scope="module")
def imperfect(armpi):
    known = load_calibration("armpi_fpv", armpi).imperfections
    return Plan(armpi, HYPOTHESES, RUNS_PER_CLASS, 5, known)


@pytest.fixture(scope="module")
def in_memory(imperfect):
    return simulate(imperfect)


@pytest.fixture(scope="module")
def whole(imperfect, tmp_path_factory):
    """The run set that nothing interrupted."""
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    produce(imperfect, path, chunk_runs=PIECE)
    return path


@pytest.fixture(scope="module")
def at_once(whole):
    """Its files."""
    return contents(whole)


def contents(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def cut_short(plan, path, pieces, monkeypatch, error=KeyboardInterrupt):
    """Make the first `pieces` only; return what the user is told."""
    told, made = [], []

    def failing(job, piece):
        if len(made) == pieces:
            raise error
        made.append(piece)
        return MAKE(job, piece)

    with monkeypatch.context() as patch:
        patch.setattr(UnfinishedRunSet, "make", failing)
        with pytest.raises(OutputError if error is OSError else error):
            produce(plan, path, tell=told.append, chunk_runs=PIECE)
    return told


def counting(monkeypatch):
    """Count the pieces that are made from now on."""
    made = []

    def counted(job, piece):
        made.append(piece)
        return MAKE(job, piece)

    monkeypatch.setattr(UnfinishedRunSet, "make", counted)
    return made


@pytest.mark.parametrize("chunk_runs", [1, 100])
def test_what_is_made_piece_by_piece_is_what_is_made_in_memory(
    tmp_path, imperfect, in_memory, chunk_runs
):
    produce(imperfect, tmp_path / "runs.zarr", chunk_runs=chunk_runs)
    xr.testing.assert_identical(load_run_set(tmp_path / "runs.zarr"), in_memory)
    save_run_set(in_memory, tmp_path / "whole.zarr")
    with (
        xr.open_zarr(tmp_path / "runs.zarr", chunks=None) as made,
        xr.open_zarr(tmp_path / "whole.zarr", chunks=None) as stored,
    ):
        assert {n: v.dtype for n, v in made.variables.items()} == {
            n: v.dtype for n, v in stored.variables.items()
        }
        assert list(made.variables) == list(stored.variables)
    assert listing(tmp_path) == ["runs.zarr", "whole.zarr"]


def test_netcdf_holds_the_same(tmp_path, imperfect, in_memory):
    done = []
    produce(imperfect, tmp_path / "runs.nc", on_progress=done.append)
    xr.testing.assert_identical(load_run_set(tmp_path / "runs.nc"), in_memory)
    assert done == [9]


def test_netcdf_beyond_memory_is_refused_at_once(tmp_path, imperfect):
    plan = replace(imperfect, runs_per_class=1_000_000)
    with pytest.raises(InputError, match=r"NetCDF is made in memory.* Write to runs\.zarr"):
        produce(plan, tmp_path / "runs.nc")
    assert listing(tmp_path) == []


def test_manifest_says_what_was_made(whole):
    manifest = json.loads((whole / "manifest.json").read_text())
    assert (manifest["runs"], manifest["runs_per_chunk"]) == (9, PIECE)
    assert manifest["versions"]["numpy"] == np.__version__
    assert manifest["plan"]["seed"] == 5
    assert manifest["plan"]["imperfections"]["name"] == "armpi_fpv"
    assert manifest["plan"]["hypotheses"][1]["faults"][0]["motor"] == "motor_1"


def test_manifest_holds_the_hash_of_the_data(whole):
    """The hash as its documentation defines it, from nothing but the files."""
    pieces = []
    for piece in range(PIECES):
        total = hashlib.sha256()
        for file in sorted(whole.glob("*/c.*"), key=str):
            name = f"{file.parent.name}/{file.name}"
            if file.name.split(".")[1] == str(piece):
                data = file.read_bytes()
                total.update(name.encode() + b"\0" + str(len(data)).encode() + b"\0" + data)
        pieces.append(total.hexdigest())
    manifest = json.loads((whole / "manifest.json").read_text())
    assert manifest["content"] == hashlib.sha256("".join(pieces).encode()).hexdigest()


def test_work_that_was_interrupted_goes_on(monkeypatch, tmp_path, imperfect, in_memory, at_once):
    (told,) = cut_short(imperfect, tmp_path / "runs.zarr", 2, monkeypatch)
    assert told.startswith("8 of 9 runs are kept in ")
    made, done, told = counting(monkeypatch), [], []
    produce(imperfect, tmp_path / "runs.zarr", ONE_PROCESS, done.append, told.append, PIECE)
    assert made == [2]
    assert told == ["continuing: 8 of 9 runs were there"]
    assert done == [8, 1]
    xr.testing.assert_identical(load_run_set(tmp_path / "runs.zarr"), in_memory)
    assert contents(tmp_path / "runs.zarr") == at_once
    assert listing(tmp_path) == ["runs.zarr"]


def test_unfinished_work_cannot_be_read(monkeypatch, tmp_path, imperfect):
    cut_short(imperfect, tmp_path / "runs.zarr", PIECES - 1, monkeypatch)
    (partial,) = tmp_path.iterdir()
    for path in (tmp_path, partial, partial / "store"):
        with pytest.raises(InputError):
            read_runs(path)
    with pytest.raises(FileNotFoundError):
        xr.open_zarr(partial / "store")


def test_pieces_that_are_not_what_was_written_are_made_again(
    monkeypatch, tmp_path, imperfect, at_once
):
    cut_short(imperfect, tmp_path / "runs.zarr", 2, monkeypatch)
    (partial,) = tmp_path.glob(".*.partial")
    (partial / "store" / "fault" / "c.0").unlink()
    torn = partial / "store" / "command" / "c.1.0.0"
    torn.write_bytes(torn.read_bytes()[:100])
    made = counting(monkeypatch)
    produce(imperfect, tmp_path / "runs.zarr", chunk_runs=PIECE)
    assert made == [0, 1, 2]
    assert contents(tmp_path / "runs.zarr") == at_once


@pytest.mark.parametrize("change", [{"seed": 6}, {"runs_per_class": 1}])
def test_another_plan_starts_over(monkeypatch, tmp_path, imperfect, change):
    cut_short(imperfect, tmp_path / "runs.zarr", 1, monkeypatch)
    made, told = counting(monkeypatch), []
    other = replace(imperfect, **change)
    produce(other, tmp_path / "runs.zarr", tell=told.append, chunk_runs=PIECE)
    assert (told, made[0]) == ([], 0)
    xr.testing.assert_identical(load_run_set(tmp_path / "runs.zarr"), simulate(other))
    assert listing(tmp_path) == ["runs.zarr"]


def test_other_versions_start_over(monkeypatch, tmp_path, imperfect):
    cut_short(imperfect, tmp_path / "runs.zarr", 1, monkeypatch)
    made = counting(monkeypatch)
    monkeypatch.setattr(pieces, "__version__", "0.0.0")
    produce(imperfect, tmp_path / "runs.zarr", chunk_runs=PIECE)
    assert made == [0, 1, 2]


@pytest.fixture
def old(tmp_path, imperfect):
    """A run set that stands where the new one is to go."""
    path = tmp_path / "runs.zarr"
    produce(replace(imperfect, runs_per_class=1, seed=99), path, chunk_runs=PIECE)
    return path


def test_the_old_run_set_stands_until_the_new_one_does(monkeypatch, imperfect, in_memory, old):
    before, seen = contents(old), []

    def watching(job, piece):
        seen.append(contents(old) == before)
        return MAKE(job, piece)

    monkeypatch.setattr(UnfinishedRunSet, "make", watching)
    produce(imperfect, old, chunk_runs=PIECE)
    assert seen == [True] * PIECES
    xr.testing.assert_identical(load_run_set(old), in_memory)
    assert listing(old.parent) == [old.name]


def test_a_kill_between_the_two_renames_is_mended_by_the_same_command(
    monkeypatch, imperfect, in_memory, old
):
    """The old run set stands aside, the new one is whole but not yet in its place."""
    cut_short(imperfect, old, PIECES - 1, monkeypatch)
    old.rename(old.with_name(".runs.zarr.old"))
    produce(imperfect, old, chunk_runs=PIECE)
    xr.testing.assert_identical(load_run_set(old), in_memory)
    assert listing(old.parent) == [old.name]


def test_what_a_kill_left_half_written_is_no_part_of_the_run_set(
    monkeypatch, tmp_path, imperfect, at_once
):
    cut_short(imperfect, tmp_path / "runs.zarr", 1, monkeypatch)
    (partial,) = tmp_path.glob(".*.partial")
    (partial / "store" / "command" / "c.1.0.0123.partial").write_bytes(b"half")
    (partial / "done" / "1").write_bytes(b"")
    made = counting(monkeypatch)
    produce(imperfect, tmp_path / "runs.zarr", chunk_runs=PIECE)
    assert made == [1, 2]
    assert contents(tmp_path / "runs.zarr") == at_once


def test_a_link_stays_a_link(tmp_path, imperfect):
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs.zarr").symlink_to(tmp_path / "disk" / "runs.zarr")
    produce(imperfect, tmp_path / "runs.zarr", chunk_runs=100)
    assert (tmp_path / "runs.zarr").is_symlink()
    assert load_run_set(tmp_path / "runs.zarr").sizes["run"] == 9


def test_full_disk_keeps_what_is_done(monkeypatch, imperfect, old):
    before = contents(old)
    (told,) = cut_short(imperfect, old, 2, monkeypatch, OSError)
    assert told.startswith("8 of 9 runs are kept in ")
    assert contents(old) == before


def test_nothing_done_leaves_nothing(monkeypatch, tmp_path, imperfect):
    assert cut_short(imperfect, tmp_path / "runs.zarr", 0, monkeypatch, OSError) == []
    assert listing(tmp_path) == []


HOLD = """
import sys, time
from pathlib import Path
from failuretwin.data_knowledge.store import sole_writer
with sole_writer(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_processes_cannot_write_the_same_run_set(tmp_path, imperfect):
    path = tmp_path / "runs.zarr"
    with command_line().begin(path, code=HOLD) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match=rf"process {holder.pid} on .* is writing it"):
            produce(imperfect, path)
        assert listing(tmp_path) == [".runs.zarr.lock"]
        holder.kill()
    produce(imperfect, path)
    assert listing(tmp_path) == ["runs.zarr"]


def test_a_lock_is_for_one_run_set_and_ends_with_its_block(tmp_path):
    with (
        sole_writer(tmp_path / "a.zarr"),
        sole_writer(tmp_path / "b.zarr"),
        pytest.raises(OutputError),
        sole_writer(tmp_path / "a.zarr"),
    ):
        pass
    with sole_writer(tmp_path / "a.zarr"):
        assert listing(tmp_path) == [".a.zarr.lock"]


def started(plan, folder):
    """Return a job as workers get it."""
    job = UnfinishedRunSet(folder / ".runs.zarr.partial", versions(), plan, PIECE)
    job.begin()
    return job


def test_worker_with_other_versions_is_refused(tmp_path, imperfect):
    job = started(imperfect, tmp_path)
    other = replace(job, versions={**job.versions, "numpy": "1.0"})
    with pytest.raises(InputError, match=r"expected .*numpy 1\.0.* Install the same versions"):
        other.make(0)


def test_worker_that_does_not_share_the_folder_is_refused(tmp_path, imperfect):
    job = started(imperfect, tmp_path)
    job.remove()
    with pytest.raises(InputError, match=r"sees no .* that all workers share"):
        job.make(0)
    assert listing(tmp_path) == []


RSS = """
import resource, sys
from pathlib import Path
from failuretwin import load_robot
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan
from failuretwin.data_knowledge.resumable import produce
for runs in map(int, sys.argv[2:]):
    plan = Plan(load_robot("armpi_fpv"), [Hypothesis()], runs)
    produce(plan, Path(sys.argv[1], f"{runs}.zarr"))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_memory_does_not_grow_with_the_runs(tmp_path):
    """400 runs are 39 MB; all that may grow is a few bytes of bookkeeping."""
    command = [sys.executable, "-c", RSS, tmp_path, "200", "600"]
    done = subprocess.run(command, check=True, capture_output=True)
    few, many = map(int, done.stdout.split())
    assert many - few < 17_000


KILL = """
import sys
from pathlib import Path
from failuretwin import load_robot
from failuretwin.data_knowledge.generate import Plan
from failuretwin.data_knowledge.resumable import produce
from failuretwin.digital_model.calibrated_robot import load_calibration
robot = load_robot("armpi_fpv")
known = load_calibration("armpi_fpv", robot).imperfections
plan = Plan(robot, ["healthy"], 40, 5, known)
produce(plan, Path(sys.argv[1]), chunk_runs=4)
"""


def test_killed_process_loses_at_most_the_piece_in_hand(monkeypatch, tmp_path, imperfect):
    plan = replace(imperfect, hypotheses=[Hypothesis()], runs_per_class=40)
    path = tmp_path / "runs.zarr"
    with command_line().begin(path, code=KILL) as process:
        while len(list(tmp_path.glob(".runs.zarr.*.partial/done/*"))) < 2:
            assert process.poll() is None
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    assert not path.exists()
    there = len(list(tmp_path.glob(".runs.zarr.*.partial/done/*")))
    made = counting(monkeypatch)
    produce(plan, path, chunk_runs=PIECE)
    assert len(made) == 10 - there
    produce(plan, tmp_path / "whole.zarr", chunk_runs=PIECE)
    assert contents(path) == contents(tmp_path / "whole.zarr")
    assert listing(tmp_path) == ["runs.zarr", "whole.zarr"]
