"""Runs diagnosed piece by piece: as in memory, the same bytes whoever does it, and continued."""

from __future__ import annotations

import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import failuretwin as ft
from executed import command_line
from failuretwin.core import foreign
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge import run_pieces
from failuretwin.data_knowledge.run_pieces import RunPieces, open_runs
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.decision import chunked_diagnosis
from failuretwin.decision.chunked_diagnosis import UnfinishedResults, diagnose_to_parquet
from failuretwin.decision.evaluation import Truths
from failuretwin.decision.results import read_diagnoses
from failuretwin.failure_behavior.random_movements import RandomMovements

TWO = ["healthy", "motor_3:stuck"]
PIECE = 4
RUNS = 14
"""Runs in three pieces of four, and one of two."""


@pytest.fixture(scope="module", autouse=True)
def _small_pieces():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_pieces, "PIECE", PIECE)
        yield


@pytest.fixture(autouse=True)
def _nothing_prepared():
    """Each test as in a process of its own."""
    run_pieces._opened_since.cache_clear()
    chunked_diagnosis._known.clear()


@pytest.fixture(scope="module")
def runs():
    plan = ft.Plan("armpi_fpv", TWO, RUNS // 2, 5, "armpi_fpv", RandomMovements(count=2))
    made = ft.simulate(plan)
    made["command"].values[4:8] = made["command"].values[4:8, :1]  # a piece without a movement
    return made


@pytest.fixture(scope="module")
def bayes():
    priors = ft.Priors(setup=ft.SetupPrior.known())
    return ft.BayesDiagnoser("armpi_fpv", "armpi_fpv", TWO, priors)


@pytest.fixture(scope="module", params=[".zarr", ".nc"])
def stored(request, runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("stored") / f"runs{request.param}"
    save_run_set(runs, path)
    return path


@pytest.fixture(scope="module")
def in_memory(bayes, runs):
    return bayes.diagnose(runs)


@pytest.fixture(scope="module")
def zarr(runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("zarr") / "runs.zarr"
    save_run_set(runs, path)
    return path


def pieces_of(*paths):
    return RunPieces(paths, ft.load_robot("armpi_fpv"), ft.ReadOptions())


def contents(folder):
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def posteriors(diagnoses):
    return np.array([list(one.posterior.values()) for one in diagnoses])


def test_pieces_are_diagnosed_as_all_runs_in_memory_are(tmp_path, stored, bayes, in_memory):
    done = []
    diagnose_to_parquet(pieces_of(stored), bayes, tmp_path / "out", on_progress=done.append)
    found = list(read_diagnoses(tmp_path / "out"))
    assert done == [4, 4, 4, 2]
    assert len(contents(tmp_path / "out")) == 4 + 1
    np.testing.assert_allclose(posteriors(found), posteriors(in_memory), rtol=1e-9, atol=1e-15)
    moved = [i for i in range(RUNS) if i not in range(4, 8)]
    assert [found[i] for i in moved] == [in_memory[i] for i in moved]
    assert [one.verdict for one in found] == [one.verdict for one in in_memory]


@pytest.fixture(scope="module")
def results(zarr, bayes):
    """The results, made without an interruption."""
    diagnose_to_parquet(pieces_of(zarr), bayes, zarr.parent / "results")
    return zarr.parent / "results"


def test_parquet_is_read_by_others(results, in_memory):
    table = pd.concat([pd.read_parquet(file) for file in sorted(results.glob("*.parquet"))])
    assert list(table["run"]) == [one.run for one in in_memory]
    assert list(table["state"]) == [one.state for one in in_memory]
    np.testing.assert_array_equal(table["p(motor_3:stuck)"], posteriors(in_memory)[:, 1])


def test_scores_are_those_of_the_diagnoses(results, in_memory):
    scores, expected = ft.evaluate(results), ft.evaluate(in_memory)
    assert scores.brier == expected.brier
    np.testing.assert_array_equal(scores.judged.scores.nats, expected.judged.scores.nats)
    np.testing.assert_array_equal(scores.judged.scores.confusion, expected.judged.scores.confusion)


@pytest.fixture
def made(monkeypatch):
    """Numbers of the pieces that are made; None: the work was interrupted in place of the third."""
    numbers, make = [], UnfinishedResults.make

    def counted(self, piece):
        if len(numbers) == 2:
            numbers.append(None)
            raise KeyboardInterrupt
        numbers.append(piece)
        return make(self, piece)

    monkeypatch.setattr(UnfinishedResults, "make", counted)
    return numbers


def test_interrupted_work_goes_on(tmp_path, zarr, bayes, results, made):
    told = []
    with pytest.raises(KeyboardInterrupt):
        diagnose_to_parquet(pieces_of(zarr), bayes, tmp_path / "out", tell=told.append)
    assert not (tmp_path / "out").exists()
    diagnose_to_parquet(pieces_of(zarr), bayes, tmp_path / "out", tell=told.append)
    assert made == [0, 1, None, 2, 3]
    assert [line.partition(" are")[0] for line in told] == [
        "8 of 14 runs",
        "continuing: 8 of 14 runs were there",
    ]
    assert contents(tmp_path / "out") == contents(results)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_other_options_start_over(tmp_path, zarr, bayes, made):
    with pytest.raises(KeyboardInterrupt):
        diagnose_to_parquet(pieces_of(zarr), bayes, tmp_path / "out")
    other = replace(bayes, whole_run=False)
    diagnose_to_parquet(pieces_of(zarr), other, tmp_path / "out")
    assert made == [0, 1, None, 0, 1, 2, 3]


def test_complete_results_are_kept_until_the_log_changes(tmp_path, runs, bayes, made):
    path, out = tmp_path / "runs.nc", tmp_path / "out"
    save_run_set(runs.isel(run=slice(0, 4)), path)
    diagnose_to_parquet(pieces_of(path), bayes, out)
    diagnose_to_parquet(pieces_of(path), bayes, out)
    assert made == [0]
    save_run_set(runs.isel(run=slice(2, 5)), path)
    diagnose_to_parquet(pieces_of(path), bayes, out)
    assert made == [0, 0]
    assert len(list(read_diagnoses(out))) == 3


def test_runs_of_one_name_are_numbered_as_in_memory(tmp_path, zarr, runs, bayes):
    other = tmp_path / "runs.nc"
    save_run_set(runs.isel(run=slice(0, 2)), other)
    diagnose_to_parquet(pieces_of(zarr, other), bayes, tmp_path / "out")
    names = [one.run for one in read_diagnoses(tmp_path / "out")]
    assert names == [str(name) for name in ft.read_runs([zarr, other])["run"].values]


def test_other_folders_are_left_alone(tmp_path, zarr, bayes):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds something else than results"):
        diagnose_to_parquet(pieces_of(zarr), bayes, tmp_path / "out")
    assert (tmp_path / "out" / "thesis.txt").read_text() == "mine"


def test_folder_without_results_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no results.*diagnose --parquet"):
        ft.read_results(tmp_path)


def test_truth_is_read_without_the_runs(zarr, runs):
    opened = open_runs(zarr, ft.load_robot("armpi_fpv"), ft.ReadOptions())
    assert Truths.of(opened).by_run.keys() == Truths.of(runs).by_run.keys()
    assert not opened["command"].variable._in_memory


def test_lost_chunk_is_named(tmp_path, zarr, bayes):
    copy = tmp_path / "runs.zarr"
    shutil.copytree(zarr, copy)
    chunks = (file for file in (copy / "command").rglob("*") if file.is_file())
    next(file for file in chunks if file.name != "zarr.json").unlink()
    with pytest.raises(InputError, match="is missing"):
        diagnose_to_parquet(pieces_of(copy), bayes, tmp_path / "out")


def test_more_runs_than_memory_holds_can_be_opened(tmp_path, zarr, runs, monkeypatch):
    monkeypatch.setattr(foreign, "free_bytes", lambda: 1.5 * runs.nbytes)
    with pytest.raises(InputError, match="free memory"):
        load_run_set(zarr)
    assert pieces_of(zarr).read(3).identical(runs.isel(run=slice(12, 14)))


def test_other_processes_write_the_same_bytes(tmp_path, zarr, bayes, results, scheduler):
    diagnose_to_parquet(pieces_of(zarr), bayes, tmp_path / "two", scheduler=scheduler)
    assert contents(tmp_path / "two") == contents(results)


def test_folder_of_logs_is_one_set_whoever_reads_it(data, scheduler):
    """Pieces hold logs, each of several runs."""
    sessions = sorted(folder for folder in (data / "real_robot_b_20241003").iterdir())[:5]
    whole = ft.read_runs(sessions)
    assert ft.read_runs(sessions, workforce=Workforce(scheduler=scheduler)).identical(whole)
    pieces = pieces_of(*sessions)
    assert [piece.size for piece in pieces.pieces] == [4, 1]
    names = [str(name) for number in range(2) for name in pieces.read(number)["run"].values]
    assert names == [str(name) for name in whole["run"].values]
    assert pieces.sample().sizes["run"] == PIECE


KILLED = """
import sys
from pathlib import Path
import failuretwin as ft
from failuretwin.data_knowledge import run_pieces
from failuretwin.data_knowledge.run_pieces import RunPieces
from failuretwin.decision.chunked_diagnosis import diagnose_to_parquet
run_pieces.PIECE = 4
priors = ft.Priors(setup=ft.SetupPrior.known())
bayes = ft.BayesDiagnoser("armpi_fpv", "armpi_fpv", ["healthy", "motor_3:stuck"], priors)
runs = RunPieces((Path(sys.argv[1]),), ft.load_robot("armpi_fpv"), ft.ReadOptions())
diagnose_to_parquet(runs, bayes, Path(sys.argv[2]))
"""


def test_killed_work_goes_on(tmp_path, zarr, bayes, results):
    out = tmp_path / "out"
    with command_line().begin(zarr, out, code=KILLED) as process:
        while process.poll() is None and not list(tmp_path.glob(".out.*.partial/done/1")):
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    told = []
    diagnose_to_parquet(pieces_of(zarr), bayes, out, tell=told.append)
    assert contents(out) == contents(results)
    assert told  # that work was there, or all of it where the process was quicker than its end
