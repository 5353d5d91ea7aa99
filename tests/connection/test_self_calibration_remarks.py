"""What is said of a robot that its own runs calibrate: how it was judged, where the sensor is."""

from __future__ import annotations

import numpy as np
import pytest

import failuretwin as ft


@pytest.fixture(scope="module")
def runs():
    return ft.simulate(
        ft.Plan("armpi_fpv", ["healthy", "motor_2:stuck"], 8, seed=11, imperfections="armpi_fpv")
    )


def turned(runs, about_y):
    """The runs as a sensor tells them that is turned about y [rad]."""
    cos, sin = np.cos(about_y), np.sin(about_y)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return runs.assign(measured=(runs["measured"].dims, runs["measured"].values @ turn.T))


def test_results_name_what_was_learned_not_the_kind(runs):
    found = ft.SelfCalibratingDiagnoser("armpi_fpv").learn(runs)
    assert found.calibration.imperfections.name == "armpi_fpv, self-calibrated"
    for diagnosis in found.diagnoses:
        assert diagnosis.protocol == "P1"
        assert diagnosis.method.endswith("healthy behaviour: armpi_fpv, self-calibrated")
    assert not any("sensor" in line for line in found.remarks)


def test_a_sensor_that_was_found_elsewhere_is_told_since_the_file_does_not_hold_it(runs):
    found = ft.SelfCalibratingDiagnoser("armpi_fpv").learn(turned(runs, np.deg2rad(3.0)))
    (line,) = (line for line in found.remarks if "sensor" in line)
    about = line.split("turned by (")[1].split(")")[0].split(", ")
    assert float(about[1]) == pytest.approx(3.0, abs=0.5)
    assert "robot fit" in line
