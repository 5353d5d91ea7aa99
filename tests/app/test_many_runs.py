"""`diagnose --parquet` as a user sees it: a summary, results to score, and a store."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import failuretwin as ft
from failuretwin.app.inputs import read_some
from failuretwin.data_knowledge.readers.read import ReadOptions
from failuretwin.data_knowledge.store import load_run_set, save_run_set


@pytest.fixture(scope="module")
def three(simulated, tmp_path_factory):
    """A healthy run and one of each of the first two motors, stuck."""
    path = tmp_path_factory.mktemp("three") / "runs.nc"
    save_run_set(load_run_set(simulated).isel(run=slice(3)), path)
    return path


TWO = ("--hypotheses", "healthy,motor_1:stuck", "--calibration", "armpi_fpv")


def test_results_are_summed_up_scored_and_remembered(failuretwin, tmp_path, three):
    store = ("--store", tmp_path / "robots.db")
    assert failuretwin("store", "init", *store).returncode == 0
    words = ("diagnose", three, "--parquet", tmp_path / "results", *TWO)
    answer = failuretwin(*words, *store, "--robot-name", "arm_7")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith("most probable")
    assert f"3 runs diagnosed: {tmp_path / 'results'}" in answer.stdout
    assert "3 runs of arm_7" in answer.stdout.splitlines()[-1]
    (scored,) = [line for line in answer.stdout.splitlines() if "of 3 runs right" in line]
    assert scored in failuretwin("evaluate", tmp_path / "results").stdout
    again = failuretwin(*words)
    assert "holds these results already" in again.stderr
    assert "3 runs diagnosed" in again.stdout


@pytest.mark.parametrize(
    "option", [("--track",), ("--independent",), ("--json", "x.jsonl"), ("--method", "m:C")]
)
def test_options_that_need_all_runs_are_refused(failuretwin, tmp_path, simulated, option):
    answer = failuretwin("diagnose", simulated, "--parquet", tmp_path / "results", *option)
    assert answer.returncode == 2
    assert f"leave out {option[0]}" in answer.stderr
    assert not (tmp_path / "results").exists()


def test_priors_that_a_store_teaches_count_as_in_memory(failuretwin, tmp_path, three):
    store = ("--store", "robots.db", "--robot-name", "arm_7")
    assert failuretwin("store", "init", *store[:2], folder=tmp_path).returncode == 0
    known = ("diagnose", three, *TWO, *store)
    confirmed = ("found", "arm_7", 1, "--confirmed", *store[:2])
    learned = (*known, "--learned-priors")
    for words in ((*known, "--csv", "plain.csv"), confirmed, (*learned, "--csv", "learned.csv")):
        told = failuretwin(*words, folder=tmp_path)
        assert told.returncode == 0, told.stderr
    found = {name: pd.read_csv(tmp_path / f"{name}.csv") for name in ("plain", "learned")}
    told = failuretwin(*learned, "--parquet", "many", folder=tmp_path)
    assert "learned priors: 1 confirmed fault of 1 robot" in told.stderr
    many = pd.read_parquet(tmp_path / "many")
    chances = [name for name in many.columns if name.startswith("p(")]
    wanted = found["learned"][chances].to_numpy()
    assert many[chances].to_numpy() == pytest.approx(wanted, abs=1e-6)
    assert np.abs(wanted - found["plain"][chances].to_numpy()).max() > 1e-6
    assert all(many.method.str.endswith("; learned priors"))


def test_a_robot_is_learned_from_a_sample_and_judges_each_run(failuretwin, tmp_path, three):
    """Against the calibration file that the same runs teach in memory, and its diagnoses."""
    of = ("diagnose", three, *TWO[:2])
    assert (
        failuretwin(*of, "--self-calibrate", "--out", "own.toml", folder=tmp_path).returncode == 0
    )
    wanted = failuretwin(*of, "--calibration", "own.toml", "--csv", "own.csv", folder=tmp_path)
    assert wanted.returncode == 0, wanted.stderr
    told = failuretwin(*of, "--self-calibrate", "--parquet", "many", folder=tmp_path)
    assert told.returncode == 0, told.stderr
    assert "self-calibrated by 3 runs, evenly spread; each run is judged by" in told.stdout
    many = pd.read_parquet(tmp_path / "many")
    found = many["p(healthy)"].to_numpy()
    assert found == pytest.approx(pd.read_csv(tmp_path / "own.csv")["p(healthy)"], abs=0.01)
    assert set(many.protocol) == {"P1"}


def test_of_too_many_runs_evenly_spread_ones_are_read(armpi, simulated, capsys):
    some = read_some([simulated], armpi, ReadOptions(), None, 3)
    every = ft.read_runs(simulated)
    assert list(some.run.values) == [every.run.values[k] for k in (0, 4, 8)]
    assert "note: 3 of 9 runs are used, evenly spread" in capsys.readouterr().err
    assert read_some([simulated], armpi, ReadOptions(), None, 9).sizes["run"] == 9
    assert "note" not in capsys.readouterr().err
