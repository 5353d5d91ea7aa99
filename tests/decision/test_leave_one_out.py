"""The option of `benchmarks/leave_one_out.py` that lets motors sag as with the stuck one held."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

import failuretwin as ft

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return importlib.import_module("leave_one_out")


def moved_m(benchmark, data, armpi, label):
    """Return how far the option moves the tool in the runs of a label, (run, time) [m]."""
    folders = (data / "real_robot_b_20241003").glob(f"*label_{label}/*_label_{label}")
    folder = next(iter(sorted(folders)))
    runs = ft.read_runs(folder, armpi, ft.ReadOptions(published_labels=True))
    moving = ft.read_runs(folder, armpi)
    settling = ft.load_calibration(None, armpi).imperfections.settling
    told = benchmark.sagging_as_held(runs, moving, armpi, settling)
    return np.linalg.norm(told["measured"].values - runs["measured"].values, axis=-1)


def test_a_motor_that_turns_about_the_vertical_changes_no_sag(benchmark, data, armpi):
    moved = moved_m(benchmark, data, armpi, label=1)

    assert np.nanmax(moved) < 1e-12


def test_a_held_shoulder_changes_the_sag_of_the_others_a_little_after_it_was_frozen(
    benchmark, data, armpi
):
    moved = moved_m(benchmark, data, armpi, label=2)

    assert np.nanmax(moved[:, :45]) < 1e-12
    assert 0.5e-3 < np.nanmax(moved) < 10e-3


def test_healthy_runs_stay_as_they_are(benchmark, data, armpi):
    assert np.nanmax(moved_m(benchmark, data, armpi, label=0)) == 0.0
