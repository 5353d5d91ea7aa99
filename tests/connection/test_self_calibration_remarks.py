"""What is said of a robot that its own runs calibrate: how it was judged, where the sensor is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import failuretwin as ft
from failuretwin.digital_model.geometry import SensorFrame
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.random_movements import RandomMovements

FEW = ("healthy", "motor_2:stuck", "motor_3:steady_state_error")
"""Where what is learned does not depend on what else is offered."""


@pytest.fixture(scope="module")
def runs():
    return ft.simulate(
        ft.Plan("armpi_fpv", ["healthy", "motor_2:stuck"], 4, seed=11, imperfections="armpi_fpv")
    )


def turned(runs, about_y):
    """The runs as a sensor tells them that is turned about y [rad]."""
    cos, sin = np.cos(about_y), np.sin(about_y)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return runs.assign(measured=(runs["measured"].dims, runs["measured"].values @ turn.T))


def test_results_name_what_was_learned_not_the_kind(runs):
    found = ft.SelfCalibratingDiagnoser("armpi_fpv", hypotheses=FEW).learn(runs)
    assert found.calibration.imperfections.name == "armpi_fpv, self-calibrated"
    for diagnosis in found.diagnoses:
        assert diagnosis.protocol == "P1"
        assert diagnosis.method.endswith("healthy behaviour: armpi_fpv, self-calibrated")
    assert not any("sensor" in line for line in found.remarks)


def test_a_sensor_that_was_found_elsewhere_is_told_and_written(runs, tmp_path):
    """Three degrees about y: the file alone then diagnoses as well as the learning did."""
    robot, path = ft.load_robot("armpi_fpv"), tmp_path / "mine.toml"
    seen = turned(runs, np.deg2rad(3.0))
    found = ft.SelfCalibratingDiagnoser("armpi_fpv", hypotheses=FEW).learn(seen)
    (line,) = (line for line in found.remarks if "sensor" in line)
    about = line.split("turned by (")[1].split(")")[0].split(", ")
    assert float(about[1]) == pytest.approx(3.0, abs=0.5)
    ft.save_calibration(found.calibration, robot, path)
    there = ft.load_calibration(path, robot)
    pose = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 4))
    cos, sin = np.cos(np.deg2rad(3.0)), np.sin(np.deg2rad(3.0))
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    away = there.twin.path(pose) - ft.DigitalTwin(robot).path(pose) @ turn.T
    assert np.linalg.norm(away, axis=1).mean() < 0.0015
    again = ft.BayesDiagnoser("armpi_fpv", path, hypotheses=FEW).diagnose(seen)
    told, kept = (
        np.mean([-np.log(d.posterior[d.truth]) for d in each]) for each in (found.diagnoses, again)
    )
    assert kept < told + 0.05
    assert not any("sensor" in remark for d in again for remark in d.quality)
    # Learning from the file once more does not turn it twice.
    once_more = ft.SelfCalibratingDiagnoser(there.robot, path, hypotheses=FEW).learn(seen)
    twice = once_more.calibration.applied_to(robot).twin.path(pose) - there.twin.path(pose)
    assert np.linalg.norm(twice, axis=1).mean() < 0.001


def test_frames_follow_each_other():
    first = SensorFrame((0.1, -0.2, 0.3, 0.2, -0.1, 0.4), 1.02)
    then = SensorFrame((-0.3, 0.1, 0.0, -0.5, 0.3, 0.1), 0.97)
    robot, pose = ft.load_robot("armpi_fpv"), np.array([[0.3, -0.4, 0.5, 0.1]])
    point = ft.DigitalTwin(robot).path(pose)
    for frame in (first, then):
        turn = Rotation.from_euler("xyz", frame.xyz_rpy[3:]).as_matrix()
        point = frame.scale * point @ turn.T + frame.xyz_rpy[:3]
    both = robot.seen_from(then.after(first))
    np.testing.assert_allclose(ft.DigitalTwin(both).path(pose), point, atol=1e-12)
    assert both.seen_from(then.after(first)) is both
    np.testing.assert_allclose(both.seen_from(None).chain.T_jt, robot.chain.T_jt)


def test_few_short_runs_are_judged_no_worse_together_than_alone():
    """Robots of a fleet that is two deviations off its class, two runs of three movements each."""
    off = Settling((0.012, -0.012, 0.01, -0.01), (0.0, 0.15, 0.2, 0.45), (0.012,) * 4, (0.004,) * 4)
    known, together, alone = Imperfections("off", "test", settling=off), [], []
    faults = ("motor_1:stuck", "motor_3:steady_state_error", "motor_4:stuck")
    offered = [*FEW, *(fault for fault in faults if fault not in FEW)]
    for seed, fault in enumerate(faults):
        plan = ft.Plan(
            ft.load_robot("armpi_fpv"), ["healthy", fault], 1, seed, known, RandomMovements(count=3)
        )
        runs = ft.simulate(plan)
        together += ft.SelfCalibratingDiagnoser("armpi_fpv", hypotheses=offered).diagnose(runs)
        alone += ft.BayesDiagnoser("armpi_fpv", "generic", hypotheses=offered).diagnose(runs)
    both, each = (
        np.mean([-np.log(d.posterior[d.truth]) for d in found]) for found in (together, alone)
    )
    assert both < each + 0.03
