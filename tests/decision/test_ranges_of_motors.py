"""What is believed of each motor: where it may be held, by how much it may be off, in its unit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from small_arms import GANTRY, SCARA, small_twin

from failuretwin import BayesDiagnoser, load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Readings
from failuretwin.digital_model.robot import shown_unit
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import size_words
from failuretwin.inference.faults.priors import Priors, priors_of
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import commands_beyond

SCATTER = 2e-4
SHARP = replace(
    NO_IMPERFECTIONS,
    settling=replace(Settling.ideal(3), scatter=(SCATTER,) * 3),
    readings=Readings(10.0, noise_m=1e-4),
)
TURNING = [
    ("revolute", "0 0 0.2", "0 0 1", (-1.0, 1.0)),
    ("revolute", "0.4 0 0", "0 1 0", (-1.0, 1.0)),
    ("revolute", "0.3 0 0", "0 1 0", (-1.0, 1.0)),
]


@pytest.fixture
def gantry(tmp_path):
    return small_twin(tmp_path, "gantry", GANTRY)


def with_limits(twin, low, high):
    """Return the robot of a twin with other limits of all joints."""
    robot = twin.robot
    joints = tuple(replace(joint, low=low, high=high) for joint in robot.chain.joints)
    return replace(robot, chain=replace(robot.chain, joints=joints))


def test_motors_may_stand_within_the_limits_of_their_joints(tmp_path):
    twin = small_twin(tmp_path, "scara", SCARA, "0.2 0 0")
    expected = [(-0.1, 0.46), (-3.22, 3.22), (-2.5, 2.5)]
    expected[1] = (-np.pi, np.pi)  # its limits allow more than a full turn
    np.testing.assert_allclose(twin.robot.travel, expected)
    endless = with_limits(twin, -np.inf, np.inf).travel
    np.testing.assert_allclose(endless, [(0.0, 0.3), (-np.pi, np.pi), (-np.pi, np.pi)])


def test_the_bundled_arm_states_where_its_motors_may_stand(armpi):
    np.testing.assert_allclose(np.rad2deg(armpi.travel[:, 1]), [80.0, 50.0, 50.0, 50.0])


def test_limits_are_told_in_the_sense_of_commands(armpi):
    third = armpi.chain.joints[2]
    assert armpi.sense[2] == -1.0
    np.testing.assert_allclose(armpi.limits[2], [-third.high, -third.low])


def runs_of(twin, poses, seen):
    """Return a run whose movements go from pose to pose in a second, each 3 s after the other."""
    time = np.arange(0.0, 3.0 * len(poses), 0.1)
    at, share = (time // 3.0).astype(int), np.clip(time % 3.0, 0.0, 1.0)[:, None]
    before = np.vstack([poses[:1], poses[:-1]])
    return RunTable(
        run=["run"],
        motor=tuple(twin.robot.motor_names),
        time=time,
        command=(before[at] + share * (poses - before)[at])[None],
        measured=np.where((time % 3.0 < 1.0)[:, None], np.nan, twin.path(seen[at]))[None],
        measured_rate_hz=10.0,
    ).to_dataset()


@pytest.mark.parametrize("held", [0.4, 2.4, -2.9, 3.6])
def test_a_motor_stuck_anywhere_in_its_travel_is_found(tmp_path, held):
    """Commands lie within +-1 rad of that, at times beyond its limits, movement_range is 1 rad."""
    twin = small_twin(tmp_path, "turning", TURNING, "0.3 0 0")
    twin = replace(twin, robot=with_limits(twin, -np.pi, np.pi))
    rng = np.random.default_rng(0)
    poses = rng.uniform(-0.9, 0.9, (6, 3))
    poses[:, 0] += held
    seen = poses + rng.normal(0.0, SCATTER, poses.shape)
    poses[0, 0] = seen[:, 0] = held
    (found,) = BayesDiagnoser(twin, SHARP).diagnose(runs_of(twin, poses, seen))
    assert found.diagnosis == "motor_1:stuck"
    assert found.probability > 0.99
    assert found.magnitude == pytest.approx(held, abs=0.002)


def test_sizes_of_errors_begin_at_what_a_motor_shows(gantry):
    """A slide shows its own scatter and the noise of the sensor, whatever the others do."""
    model = HealthyModel(gantry, SHARP)
    noise = np.hypot(1e-4, 2e-4 * gantry.robot.reach)
    np.testing.assert_allclose(model.least_visible, np.hypot(SCATTER, noise), rtol=1e-6)
    ranges = Priors().sizes_of(MODES["steady_state_error"], model, 0).ranges
    assert ranges[0][0] == pytest.approx(0.5 * model.least_visible[0])
    assert ranges[-1][1] == pytest.approx(0.9 * 0.92 / np.pi)
    for (low, high), (following, _) in pairwise(ranges):
        assert high == pytest.approx(5.0 * low)
        assert 1.0 < following / low <= 2.5
    bias = Priors().sizes_of(MODES["encoder_bias"], model, 0).ranges
    assert bias[0] == pytest.approx(ranges[0])
    drift = Priors().sizes_of(MODES["drift"], model, 0).ranges
    assert drift[0][0] == pytest.approx(0.1 * ranges[0][0])
    assert Priors().sizes_of(MODES["encoder_scale"], model, 0).ranges == ((0.03, 0.75),)


@pytest.mark.parametrize(("mode", "within"), [("steady_state_error", 1.0), ("drift", 0.1)])
def test_sizes_within_what_a_day_changes_are_improbable(tmp_path, mode, within):
    """An arm exact to 0.1 mrad whose class differs by 1 mrad from day to day."""
    twin = small_twin(tmp_path, "scara", SCARA, "0.2 0 0")
    profile = replace(twin.robot.profile, arm_class="industrial", inference={"least_noise_m": 2e-5})
    exact = replace(SHARP.settling, scatter=(1e-5,) * 3)
    sharp = replace(SHARP, settling=exact, readings=Readings(10.0, noise_m=2e-5))
    model = HealthyModel(DigitalTwin(replace(twin.robot, profile=profile)), sharp)

    sizes = Priors().sizes_of(MODES[mode], model, 1)

    small = [low < 0.999e-3 * within for low, _ in sizes.ranges]
    assert sizes.ranges[0][0] == pytest.approx(0.5 * within * model.least_visible[1])
    assert sum(sizes.shares) == pytest.approx(1.0)
    assert sum(np.array(sizes.shares)[small]) == pytest.approx(0.02)
    assert min(low for low, _ in sizes.ranges if low >= 0.999e-3 * within) == pytest.approx(
        1e-3 * within
    )


@pytest.mark.parametrize("mode", ["encoder_bias", "drift", "backlash"])
def test_the_bundled_arm_has_the_sizes_of_the_modes(twin, mode):
    said = Priors().sizes_of(MODES[mode], HealthyModel.of(twin), 1).ranges
    assert said == (MODES[mode].considered,)


@pytest.mark.parametrize(
    ("unit", "low", "high"),
    [("deg", np.deg2rad(0.5), np.deg2rad(2.0)), ("rad", 0.5, 2.0), ("percent", 0.025, 0.1)],
)
def test_errors_of_turning_motors_in_any_unit(tmp_path, unit, low, high):
    robot = small_twin(tmp_path, "scara", SCARA, "0.2 0 0").robot
    found = priors_of(robot, None, None, (0.5, 2.0, unit)).error_ranges
    assert found["motor_3"][0] == pytest.approx((low, high))
    assert ("motor_1" in found) == (unit == "percent")


def test_errors_of_slides_in_millimetres(gantry):
    found = priors_of(gantry.robot, None, None, (0.5, 2.0, "mm")).error_ranges
    assert found["motor_2"][0] == pytest.approx((0.0005, 0.002))
    model = HealthyModel(gantry, SHARP)
    priors = Priors(error_ranges=found)
    assert priors.sizes_of(MODES["steady_state_error"], model, 1).ranges == found["motor_2"]


@pytest.mark.parametrize(
    ("error_range", "counts", "match"),
    [
        ((1, 2, "inch"), None, "inch"),
        ((2, 1, "deg"), None, "--error-range is 2 1, expected 0 <= LOW < HIGH"),
        ((1, 2, "mm"), None, "all motors of 'armpi_fpv' turn. Expected deg, rad"),
        ((1, 500, "deg"), None, "turn through 160 deg"),
        ((1, 101, "percent"), None, "up to 100"),
        ((1, 2, "deg"), (4, 20), "say the same"),
    ],
)
def test_a_range_that_makes_no_sense_is_refused(armpi, error_range, counts, match):
    with pytest.raises(InputError, match=match):
        priors_of(armpi, counts, None, error_range)


def test_counts_need_servo_units():
    with pytest.raises(InputError, match="no servo units"):
        priors_of(load_robot("ur5e"), None, None, (1, 2, "counts"))


def movements_to(*targets):
    count = len(targets)
    return Movements(
        np.zeros((1, 3)), np.array([targets]), np.ones((1, count, 3)), 2.0 * np.arange(count)[None]
    )


def test_commands_beyond_the_profile_are_remarked(tmp_path):
    twin = small_twin(tmp_path, "turning", TURNING, "0.3 0 0")
    robot = with_limits(twin, -2.0, 2.0)
    assert commands_beyond(robot, movements_to([1.0, -1.0, 0.5]), 0) == []
    limits, usual = commands_beyond(robot, movements_to([0.0, 2.2, 0.0], [-1.5, 0.0, 0.0]), 0)
    assert limits.startswith(
        "commands go beyond the limits of their joints: motor 2 from 0 to 126 deg "
        "(expected -115 to 115)"
    )
    assert "motor 1 from -86 to 0 deg (expected -57 to 57)" in usual


def test_slides_are_told_in_millimetres(gantry, armpi):
    fault = Fault("motor_1", "steady_state_error")
    unit = gantry.robot.own_unit("motor_1", "rad")
    assert size_words(fault, 0.022, unit) == " by about 22.0 mm"
    assert size_words(fault, 0.022, armpi.own_unit("motor_1", "rad")) == " by about 1.3 deg"
    assert shown_unit("rad", gantry.robot, "motor_1") == (1000.0, "mm")
    assert gantry.robot.own_unit("motor_1+motor_2", "share") == "share"
    assert shown_unit("share", gantry.robot, "motor_1+motor_2") == (1.0, "share")
    assert shown_unit("rad/s", gantry.robot, "motor_1") == (1000.0, "mm/s")


def test_a_slide_that_misses_its_targets_is_off_by_millimetres(gantry):
    rng = np.random.default_rng(1)
    poses = rng.uniform([-0.2, -0.1, 0.1], [0.2, 0.3, 0.4], (6, 3))
    seen = poses + rng.normal(0.0, SCATTER, poses.shape)
    seen[1:, 1] += np.array([1.0, -1.0, 1.0, -1.0, -1.0]) * 0.022
    (found,) = BayesDiagnoser(gantry, SHARP).diagnose(runs_of(gantry, poses, seen))
    assert found.diagnosis == "motor_2:steady_state_error"
    assert found.magnitude_unit == "m"
    assert found.magnitude == pytest.approx(0.022, rel=0.1)  # nodes of the size stand so far apart
    assert "misses its targets by about 2" in found.verdict
    assert " mm" in found.verdict
