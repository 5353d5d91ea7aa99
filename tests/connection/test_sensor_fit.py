"""Constant errors, mounts and noise of sensors, from healthy simulated runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import failuretwin as ft
from failuretwin.connection.calibration.sensor_fit import fit_sensors
from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.inference.observation.healthy_model import HealthyModel

BIAS = {"accelerometer": (0.3, -0.2, 0.1), "orientation": (0.02, -0.01, 0.03), "wire": (0.004,)}
NOISE = {"accelerometer": 0.08, "orientation": 0.005, "wire": 0.001}


@pytest.fixture(scope="module")
def known():
    return load_calibration("armpi_fpv", ft.load_robot("armpi_fpv"))


@pytest.fixture(scope="module")
def runs(known):
    sensors = [SensorProfile(k, noise=NOISE[k], bias=BIAS[k], doubt=0.0) for k in BIAS]
    sensors.append(SensorProfile("gyroscope", bias=(0.02, 0.0, -0.03), doubt=0.0))
    off = replace(known.imperfections, sensors=tuple(sensors), variation=None)
    return ft.simulate(ft.Plan(known.robot, ["healthy"], 12, 4, off, sensors=[*BIAS, "gyroscope"]))


def by_kind(fits):
    return {fit.profile.kind: fit.profile for fit in fits}


def test_constant_errors_and_noise_are_found(runs, known):
    found = by_kind(fit_sensors(runs, HealthyModel.of(known.twin, known.imperfections)))
    assert set(found) == {*BIAS, "gyroscope"}
    for kind, bias in BIAS.items():
        off = np.abs(np.subtract(found[kind].bias, bias)).max()
        assert off < 4.0 * found[kind].doubt, kind
        assert found[kind].doubt < max(np.abs(bias)) / 3.0, kind
        assert found[kind].noise == pytest.approx(NOISE[kind], rel=0.25), kind
    np.testing.assert_allclose(found["gyroscope"].bias, (0.02, 0.0, -0.03), atol=2e-3)


def test_a_mount_in_doubt_is_found_where_gravity_turns(known):
    """Noise-free poses all over: a sensor that is turned about the tilting axis reads so."""
    turned = SensorProfile("accelerometer", rpy=(0.05, 0.0, 0.0), doubt=0.0, noise=0.02)
    off = replace(known.imperfections, sensors=(turned,), variation=None)
    seen = ft.simulate(ft.Plan(known.robot, ["healthy"], 12, 4, off, sensors=["accelerometer"]))
    told = SensorProfile("accelerometer", turn_doubt=0.1)
    model = HealthyModel.of(known.twin, replace(known.imperfections, sensors=(told,)))
    found = by_kind(fit_sensors(seen, model))["accelerometer"]
    away = Rotation.from_euler("xyz", found.rpy).as_matrix() @ [0.0, 0.0, 1.0]
    true = Rotation.from_euler("xyz", turned.rpy).as_matrix() @ [0.0, 0.0, 1.0]
    assert np.arccos(away @ true) < 0.02
    assert found.turn_doubt < 0.1


def test_without_a_tool_position_the_sensors_alone_are_calibrated(runs, known, tmp_path):
    blind = runs.assign(measured=np.nan * runs["measured"])
    found = ft.calibrate(blind, name="imu")
    assert found.imperfections.settling == known.imperfections.settling
    assert any("nobody watched the tool's position" in remark for remark in found.remarks)
    ft.save_calibration(found, known.robot, tmp_path / "imu.toml")
    again = ft.load_calibration(tmp_path / "imu.toml", known.robot).imperfections
    fitted = by_kind_of(again)["accelerometer"]
    np.testing.assert_allclose(fitted.bias, BIAS["accelerometer"], atol=0.05)
    bad = ft.diagnose(runs, sensing="accelerometer")
    good = ft.diagnose(runs, calibration=tmp_path / "imu.toml", sensing="accelerometer")
    healthy = [np.mean([d.posterior["healthy"] for d in one]) for one in (bad, good)]
    assert healthy[1] > healthy[0]


def by_kind_of(imperfections):
    return {sensor.kind: sensor for sensor in imperfections.sensors}


def test_too_little_rest_is_refused(runs):
    blind = runs.assign(measured=np.nan * runs["measured"]).isel(run=[0], time=slice(0, 200))
    with pytest.raises(InputError, match="nobody watched the tool's position"):
        ft.calibrate(blind)
