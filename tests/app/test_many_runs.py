"""`diagnose --parquet` as a user sees it: a summary, results to score, and a store."""

from __future__ import annotations

import pytest

TWO = ("--hypotheses", "healthy,motor_1:stuck", "--calibration", "armpi_fpv")


def test_results_are_summed_up_scored_and_remembered(failuretwin, tmp_path, simulated):
    store = ("--store", tmp_path / "robots.db")
    assert failuretwin("store", "init", *store).returncode == 0
    words = ("diagnose", simulated, "--parquet", tmp_path / "results", *TWO)
    answer = failuretwin(*words, *store, "--robot-name", "arm_7")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith("most probable")
    assert f"9 runs diagnosed: {tmp_path / 'results'}" in answer.stdout
    assert "9 runs of arm_7" in answer.stdout.splitlines()[-1]
    (scored,) = [line for line in answer.stdout.splitlines() if "of 9 runs right" in line]
    assert scored in failuretwin("evaluate", tmp_path / "results").stdout
    again = failuretwin(*words)
    assert "holds these results already" in again.stderr
    assert "9 runs diagnosed" in again.stdout


@pytest.mark.parametrize(
    "option", [("--track",), ("--self-calibrate",), ("--json", "x.jsonl"), ("--method", "m:C")]
)
def test_options_that_need_all_runs_are_refused(failuretwin, tmp_path, simulated, option):
    answer = failuretwin("diagnose", simulated, "--parquet", tmp_path / "results", *option)
    assert answer.returncode == 2
    assert f"leave out {option[0]}" in answer.stderr
    assert not (tmp_path / "results").exists()
