"""A robot without a calibration as one of the calibrated robots of its kind, by the store."""

from __future__ import annotations

from dataclasses import replace

import pytest

import failuretwin as ft
from failuretwin.connection.calibration.result import Calibration, calibration_text
from failuretwin.data_knowledge.store import save_run_set

SCATTER = (0.7, 1.0, 1.5)
"""Scatter of three robots, as a factor."""


def document(robot, times):
    """Return the calibration of a robot that scatters so many times as the bundled one."""
    known = ft.load_calibration("armpi_fpv", robot).imperfections
    settling = known.settling
    scatter = tuple(times * value for value in settling.scatter)
    own = replace(known, name=f"x{times}", settling=replace(settling, scatter=scatter))
    found = Calibration(own, (), ("by hand",), runs=9, movements=45, used_readings=False)
    return calibration_text(found, robot)


@pytest.fixture
def fleet(tmp_path, armpi):
    """A store with three calibrated robots, their files, and a log."""
    store = ft.open_store(tmp_path / "robots.db", create=True)
    for k, times in enumerate(SCATTER):
        text = document(armpi, times)
        (tmp_path / f"{k}.toml").write_text(text)
        store.keep_calibration(f"arm_{k}", text, name=f"{k}", protocol="P0c", profile=armpi)
    save_run_set(ft.read_runs(ft.sample_log()).isel(run=[0]), tmp_path / "log.nc")
    return store


@pytest.fixture
def diagnosed(failuretwin, tmp_path):
    """Diagnose the log, and return the posterior of its run and what was told beside it."""

    def call(*words):
        given = ("log.nc", "--hypotheses", "healthy,motor_3:stuck")
        answer = failuretwin("diagnose", *given, *words, "--csv", "out.csv", folder=tmp_path)
        assert answer.returncode == 0, answer.stderr
        header, row = (tmp_path / "out.csv").read_text().splitlines()[:2]
        columns = dict(zip(header.split(","), row.split(","), strict=False))
        return columns["probability"], answer.stderr

    return call


LEARNED = ("--store", "robots.db", "--learned-priors")


def test_the_population_is_that_of_the_pooled_calibrations(fleet, diagnosed, failuretwin, tmp_path):
    """Against `calibrate --pool` and `--calibration`, which go another way to the same figures."""
    pooled = ("0.toml", "1.toml", "2.toml", "--pool", "--out", "all.toml")
    assert failuretwin("calibrate", *pooled, folder=tmp_path).returncode == 0
    wanted, _ = diagnosed("--calibration", "all.toml")
    found, told = diagnosed(*LEARNED, "--robot-name", "arm_9")
    said = "learned healthy behaviour: population of 3 calibrated robots (armpi_fpv)"
    assert said in told
    assert float(found) == pytest.approx(float(wanted), rel=1e-6)  # files round
    assert said.partition(": ")[2] in (tmp_path / "out.csv").read_text()
    assert found != diagnosed("--store", "robots.db", "--robot-name", "arm_9")[0]


@pytest.mark.parametrize(
    "words",
    [("--robot-name", "arm_1"), (), ("--robot-name", "arm_9", "--calibration", "2.toml")],
)
def test_a_robot_with_its_own_calibration_keeps_it(fleet, diagnosed, words):
    """By the store, by its own profile, by the command."""
    found, told = diagnosed(*LEARNED, *words)
    assert "population" not in told
    assert found == diagnosed("--store", "robots.db", *words)[0]


def test_too_few_calibrations_are_no_population(fleet, diagnosed, tmp_path, armpi):
    few = ft.open_store(tmp_path / "few.db", create=True)
    for name in ("arm_0", "arm_1"):  # the same file twice
        few.keep_calibration(name, document(armpi, 1.0), name="c", protocol="P0c", profile=armpi)
    words = ("--store", "few.db", "--robot-name", "arm_9")
    found, told = diagnosed(*words, "--learned-priors")
    assert "1 calibrated robot (armpi_fpv), expected 2 or more; the profile's figures" in told
    assert found == diagnosed(*words)[0]
