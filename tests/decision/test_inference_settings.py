"""By which lengths runs are read: of the bundled arm, of a noisy sensor, of a profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.geometry import Geometry, seen_chain
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Readings
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.settings import InferenceSettings

COUNT_RAD = 0.24 * np.pi / 180.0


def noisy(noise_m):
    return replace(NO_IMPERFECTIONS, readings=Readings(10.0, noise_m=noise_m))


def with_reach(reach_m):
    """Return an arm of two links that are so long together."""
    arm = load_robot("ur5e")
    joints = [replace(j, T_pj=np.eye(4)) for j in arm.chain.joints]
    joints[1] = replace(joints[1], T_pj=moved(0.5 * reach_m))
    chain = replace(arm.chain, joints=tuple(joints), T_jt=moved(0.5 * reach_m))
    return replace(arm, chain=chain, loads=replace(arm.loads, chain=chain))


def moved(distance_m):
    pose = np.eye(4)
    pose[0, 3] = distance_m
    return pose


def with_table(robot, **table):
    return replace(robot, profile=replace(robot.profile, inference=table))


def with_fit(robot, noise_m):
    """Return a robot whose geometry was fitted up to a noise."""
    return replace(robot, profile=replace(robot.profile, geometry=Geometry(sensor_noise_m=noise_m)))


@pytest.mark.parametrize("noise_m", [0.0, 0.0006, 0.02])
def test_the_bundled_arm_states_its_own(noise_m):
    """A millimetre is what one count of the ArmPi's servos moves its tool by."""
    found = InferenceSettings.of(load_robot("armpi_fpv"), noisy(noise_m))
    assert found.moving_spread_m == 0.004
    assert found.nearly_still_m == 0.003
    assert found.same_place_m == 0.002
    assert found.unmoved_m == 0.02
    assert found.update_m == 0.0005
    assert found.path_roughness_m == 0.002
    assert found.least_noise_m == 0.0003


def test_an_arm_of_which_nothing_is_said_goes_by_sensor_and_reach():
    """A tracker of 0.1 mm and an arm of 1.3 m; what is known of a camera of 1 mm alone."""
    robot = with_reach(1.3)
    found = InferenceSettings.of(robot, noisy(0.0001))
    assert found.moving_spread_m == pytest.approx(4 * 2.5e-4 * 1.3)
    assert found.unmoved_m == pytest.approx(20 * 2.5e-4 * 1.3)
    assert found.path_roughness_m == pytest.approx(0.0091)
    assert found.least_noise_m == pytest.approx(0.00026)
    assert InferenceSettings.of(robot, noisy(0.001)).same_place_m == pytest.approx(0.003)
    counted = replace(NO_IMPERFECTIONS, readings=Readings(10.0, whole_counts=True))
    small = InferenceSettings.of(with_reach(0.05), counted)
    assert small.moving_spread_m == pytest.approx(5e-5)
    assert InferenceSettings.of(with_reach(0.05)).moving_spread_m == 0.004


def test_rest_is_never_told_from_motion_by_less_than_the_noise():
    found = InferenceSettings.of(load_robot("ur5e"), noisy(0.01))
    assert found.moving_spread_m == pytest.approx(0.04)
    assert found.nearly_still_m == found.same_place_m == pytest.approx(0.03)
    assert found.unmoved_m == pytest.approx(0.2)


def test_a_sensor_that_nobody_has_measured_may_be_a_camera_of_a_millimetre():
    """Calibrated motors say nothing of it: a reading in 34 lies beyond three deviations."""
    unmeasured = InferenceSettings.of(load_robot("so101"), noisy(0.0))
    assert unmeasured.moving_spread_m == unmeasured.nearly_still_m == pytest.approx(0.003)
    assert unmeasured.same_place_m < 0.001
    fitted = InferenceSettings.of(with_fit(load_robot("so101"), 0.002), noisy(0.0))
    assert fitted.moving_spread_m == pytest.approx(0.006)


def test_the_profile_has_the_last_word():
    robot = with_table(load_robot("ur5e"), moving_spread_m=0.05)
    assert InferenceSettings.of(robot, noisy(0.01)).moving_spread_m == 0.05
    assert InferenceSettings.of(robot).same_place_m == 0.002


def test_a_fit_of_the_geometry_says_the_noise_of_the_tool():
    """A motor of half a metre that scatters by 0.4 mrad moves the tool by 0.2 mm on one axis."""
    robot = with_fit(load_robot("ur5e"), 0.0004)
    assert InferenceSettings.of(robot, noisy(0.0)).least_noise_m == 0.0002
    assert InferenceSettings.of(with_table(robot, least_noise_m=0.001)).least_noise_m == 0.001
    for scatter, noise_m in ((0.0, 0.0004), (0.05, 0.0002)):
        settling = replace(Settling.ideal(5), scatter=(scatter,) * 5)
        model = HealthyModel.of(robot, replace(noisy(0.0), settling=settling))
        assert model.path_noise == pytest.approx(noise_m)


def test_what_motors_scatter_counts_once():
    """Noise and scatter together are as wide as what the fit left, in the median pose."""
    robot = with_fit(load_robot("ur5e"), 0.001)
    settling = replace(Settling.ideal(5), scatter=(0.001, 0.001, 0.0, 0.0, 0.0))
    model = HealthyModel.of(robot, replace(noisy(0.0), settling=settling))
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(0).uniform(low, high, (500, 5))
    tips = [model.twin.path(pose + 0.001 * np.eye(5)[k]) - model.twin.path(pose) for k in range(2)]
    variance = np.median(np.sum(np.square(tips), axis=(0, 2))) / 3.0
    assert variance > 0.1 * 0.001**2
    assert model.path_noise**2 + variance == pytest.approx(0.001**2, rel=1e-3)


def test_the_reach_is_that_of_the_arm_wherever_the_sensor_stands():
    robot = load_robot("ur5e")
    far = replace(robot, chain=seen_chain(robot.chain, (5.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert far.reach == robot.reach


@pytest.mark.parametrize(
    ("table", "match"),
    [({"still_m": 0.1}, "still_m"), ({"unmoved_m": -1.0}, "unmoved_m is -1, expected")],
)
def test_a_table_that_makes_no_sense_is_refused(table, match):
    with pytest.raises(InputError, match=match):
        InferenceSettings.of(with_table(load_robot("ur5e"), **table))


def test_errors_range_up_to_the_papers_own_in_even_steps_of_their_logarithm():
    low, high = np.array(InferenceSettings.of(load_robot("armpi_fpv")).error_ranges).T / COUNT_RAD
    np.testing.assert_allclose(low, np.geomspace(3.0, 10.0, 4), rtol=0.02)
    np.testing.assert_allclose(high, np.geomspace(15.0, 50.0, 4), rtol=0.02)


def test_a_noisy_tool_rests_by_the_settings_of_its_sensor():
    """A tool at rest whose sensor scatters by 5 mm moves for eyes that expect 1 mm."""
    time = np.arange(300) * 0.01
    command = np.clip(time - 0.1, 0.0, 0.8)[None, :, None] * np.ones(2)
    runs = RunTable(
        run=["run"],
        motor=("motor_1", "motor_2"),
        time=time,
        command=command,
        measured=np.random.default_rng(1).normal(0.0, 0.005, (1, len(time), 3)),
        measured_rate_hz=100.0,
    ).to_dataset()
    assert Evidence(runs).settled.moving.tolist() == [[True]]
    settings = InferenceSettings.of(load_robot("ur5e"), noisy(0.005))
    assert Evidence(runs, settings).settled.usable.tolist() == [[True]]
