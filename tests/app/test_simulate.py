"""`failuretwin simulate` as a user sees it: one worker or many, cut short and continued."""

from __future__ import annotations

import os
import signal
import time

import pytest

from waiting import WAIT_S
from warm_command import remarks

COMMAND = ("simulate", "--runs-per-class", 30, "--calibration", "armpi_fpv", "--out")


def contents(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def made_by_one(failuretwin, tmp_path_factory):
    """A run set in three pieces, made by one process."""
    path = tmp_path_factory.mktemp("one") / "runs.zarr"
    answer = failuretwin(*COMMAND, path)
    assert (answer.returncode, remarks(answer.stderr)) == (0, "")
    assert answer.stdout == f"270 runs written to {path}\n"
    return path


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(failuretwin, tmp_path, made_by_one):
    answer = failuretwin(*COMMAND, tmp_path / "two.zarr", "--workers", 2)
    assert (answer.returncode, remarks(answer.stderr)) == (0, "")
    assert contents(tmp_path / "two.zarr") == contents(made_by_one)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_interrupted_work_is_kept_and_continued(failuretwin, begin, tmp_path, made_by_one, workers):
    arguments = [*COMMAND, tmp_path / "runs.zarr"]
    with begin(*arguments, "--workers", workers) as process:
        while len(list(tmp_path.glob(".*.partial/done/*"))) < 2:
            assert process.poll() is None
            time.sleep(0.005)
        # As a terminal does: to the whole group, workers included; the group is this process's own.
        assert os.getpgid(process.pid) == process.pid
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(WAIT_S) == 1
        told, _, rest = remarks(process.stderr.read()).partition("\n")
    assert "of 270 runs are kept in" in told
    assert rest.split() == ["interrupted"]
    kept = told.split()[0]
    assert not (tmp_path / "runs.zarr").exists()
    again = failuretwin(*arguments)
    assert remarks(again.stderr) == f"continuing: {kept} of 270 runs were there\n"
    assert contents(tmp_path / "runs.zarr") == contents(made_by_one)
    assert [path.name for path in tmp_path.iterdir()] == ["runs.zarr"]


def test_wrong_scheduler_is_refused(failuretwin, tmp_path):
    answer = failuretwin(*COMMAND, tmp_path / "x.zarr", "--scheduler", "tcp://127.0.0.1:1")
    assert answer.returncode == 2
    assert answer.stderr.startswith("error: scheduler 'tcp://127.0.0.1:1' does not answer")
    assert len(answer.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
