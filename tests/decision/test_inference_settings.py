"""By which lengths runs are read: of the bundled arm, of a noisy sensor, of a profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Readings
from failuretwin.inference.evidence import Evidence
from failuretwin.inference.settings import USUAL, InferenceSettings

COUNT_RAD = 0.24 * np.pi / 180.0


def noisy(noise_m):
    return replace(NO_IMPERFECTIONS, readings=Readings(10.0, noise_m=noise_m))


def with_table(robot, **table):
    return replace(robot, profile=replace(robot.profile, inference=table))


@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e", "panda", "so101"])
def test_a_sensor_of_a_millimetre_changes_nothing(name):
    """A millimetre is what one count of the ArmPi's servos moves its tool by."""
    found = InferenceSettings.of(load_robot(name), noisy(0.0006))
    assert found.moving_spread_m == 0.004
    assert found.nearly_still_m == 0.003
    assert found.same_place_m == 0.002
    assert found.unmoved_m == 0.02
    assert found.update_m == 0.0005
    assert found.path_roughness_m == 0.002


def test_rest_is_never_told_from_motion_by_less_than_the_noise():
    found = InferenceSettings.of(load_robot("ur5e"), noisy(0.01))
    assert found.moving_spread_m == found.nearly_still_m == pytest.approx(0.03)
    assert found.same_place_m == found.unmoved_m == pytest.approx(0.03)
    assert found.path_roughness_m == 0.002


def test_the_profile_has_the_last_word():
    robot = with_table(load_robot("ur5e"), moving_spread_m=0.05)
    assert InferenceSettings.of(robot, noisy(0.01)).moving_spread_m == 0.05
    assert InferenceSettings.of(robot).same_place_m == 0.002


@pytest.mark.parametrize(
    ("table", "match"),
    [({"still_m": 0.1}, "still_m"), ({"unmoved_m": -1.0}, "unmoved_m is -1, expected")],
)
def test_a_table_that_makes_no_sense_is_refused(table, match):
    with pytest.raises(InputError, match=match):
        InferenceSettings.of(with_table(load_robot("ur5e"), **table))


def test_errors_range_from_four_counts_to_the_papers_own():
    low, high = np.array(USUAL.error_ranges).T / COUNT_RAD
    np.testing.assert_allclose(low, [4.0, 7.0, 10.0])
    np.testing.assert_allclose(high, [20.0, 35.0, 50.0])


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
