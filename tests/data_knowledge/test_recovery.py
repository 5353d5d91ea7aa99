from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.io

from failuretwin import DigitalTwin, ReadOptions, read_runs
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.data_knowledge.ramp_fit import fit
from failuretwin.data_knowledge.readers.timed_log import Samples
from failuretwin.data_knowledge.recovery import published_time_bases, recover_movements
from failuretwin.digital_model.calibrated_robot import load_calibration

FROM_ZERO = np.linspace(0.0, 10.0, 1000)
FROM_FIRST_STEP = np.arange(1, 1001) * 0.01
SHORT = FROM_ZERO[:400]


def path_error(movements, desired, time, robot):
    """Return how far the path of movements is off the desired one at most, (run,) [m]."""
    off = DigitalTwin(robot).path(movements.reference(time)) - desired
    return np.linalg.norm(off, axis=-1).max(axis=1)


def names_of(desired):
    return [f"run_{i}" for i in range(len(desired))]


@pytest.fixture(scope="module")
def sample(data):
    """Desired paths of every ninth of the 90 published runs."""
    cells = scipy.io.loadmat(data / "processed_samples" / "cell_array_20241003.mat")["X_test_array"]
    return np.stack([cell[:, :3] for cell in cells[0][::9]])


@pytest.fixture(scope="module")
def truth(data):
    folder = data / "real_robot_b_20241003"
    return read_runs(folder, options=ReadOptions("published")).isel(run=slice(None, None, 9))


@pytest.fixture(scope="module")
def recovered(sample, armpi):
    """Movements of the published runs; their time grid is found too."""
    time, movements = recover_movements(sample, armpi, names=names_of(sample))
    np.testing.assert_array_equal(time, FROM_ZERO)
    return movements


@pytest.fixture(scope="module")
def simulated(armpi):
    """Movements of healthy runs of an imperfect robot: whole units, late starts."""
    plan = Plan(
        armpi,
        [Hypothesis.parse("healthy", armpi.motor_names)],
        3,
        seed=3,
        imperfections=load_calibration(None, armpi).imperfections,
    )
    return simulate_runs(plan, range(3)).movements


def movements(armpi, counts, start, ramp=0.8):
    """Movements of one run between poses in units (1 + movement, motor)."""
    angle = armpi.servo_units.to_rad(np.array(counts, dtype=float))
    ramps = np.broadcast_to(ramp, (len(counts) - 1, len(armpi.motors)))
    return Movements(angle[None, 0], angle[None, 1:], ramps[None], np.array([start], dtype=float))


def on_known_grid(desired, robot, time=FROM_ZERO, **options):
    grid, found = recover_movements(desired, robot, time=time, **options)
    np.testing.assert_array_equal(grid, time)
    return found


def recover_one(armpi, twin, wanted, time=FROM_ZERO, **options):
    desired = twin.path(wanted.reference(time))
    found = on_known_grid(desired, armpi, names=["only"], **options, time=time)
    assert path_error(found, desired, time, armpi).max() <= 1e-9
    return found


def settles(start, ramp, end):
    """Which movements end before the record does, (run, movement)."""
    return start + ramp.max(axis=-1) <= end


def test_published_runs_come_back_exactly(sample, recovered, armpi):
    assert sample.shape == (10, 1000, 3)
    assert path_error(recovered, sample, FROM_ZERO, armpi).max() <= 1e-12


def test_recovered_movements_are_those_of_the_raw_logs(recovered, truth):
    start, ramp = truth["movement_start"].values, truth["ramp_duration"].values
    seen = start < FROM_ZERO[-1]
    np.testing.assert_array_equal(recovered.exists, seen)
    np.testing.assert_allclose(recovered.start[seen], start[seen], rtol=0, atol=1e-9)
    np.testing.assert_allclose(recovered.initial, truth["command"].values[:, 0], atol=1e-9)

    whole = seen & settles(start, ramp, FROM_ZERO[-1])
    assert 40 < whole.sum() <= 50
    np.testing.assert_allclose(recovered.target[whole], truth["target"].values[whole], atol=1e-9)
    moved = np.abs(recovered.target - recovered.origin()) > 1e-6
    np.testing.assert_allclose(
        recovered.ramp_duration[whole & moved.all(-1)], ramp[whole & moved.all(-1)]
    )
    assert (recovered.ramp_duration[seen][~moved[seen]] == 0.0).all()


def test_targets_of_cut_off_ramps_are_whole_units_too(recovered, armpi):
    counts = armpi.servo_units.to_counts(recovered.target[recovered.exists])
    np.testing.assert_allclose(counts, counts.round(), atol=1e-6)


def test_simulated_runs_come_back_on_the_other_time_base(simulated, armpi, twin):
    time = FROM_FIRST_STEP
    desired = twin.path(simulated.reference(time))
    grid, found = recover_movements(desired, armpi, names=names_of(desired))
    np.testing.assert_array_equal(grid, time)
    assert path_error(found, desired, time, armpi).max() <= 1e-12
    seen = simulated.start < time[-1]
    np.testing.assert_array_equal(found.exists, seen)
    np.testing.assert_allclose(found.start[seen], simulated.start[seen], rtol=0, atol=1e-9)
    whole = settles(simulated.start, simulated.ramp_duration, time[-1])
    np.testing.assert_allclose(found.target[whole], simulated.target[whole], atol=1e-9)


def test_the_wrong_time_base_leaves_a_residual(simulated, armpi, twin):
    desired = twin.path(simulated.reference(FROM_ZERO[:300]))[:1]
    with pytest.raises(InputError, match="start and durations of the published kind"):
        on_known_grid(desired, armpi, names=names_of(desired), time=FROM_FIRST_STEP[:300])


def test_time_bases_are_the_published_ones():
    first, second = published_time_bases(1000)
    np.testing.assert_allclose(first, FROM_FIRST_STEP)
    np.testing.assert_array_equal(second, FROM_ZERO)


@pytest.mark.parametrize(
    "kind", ["noise", pytest.param("offset", marks=pytest.mark.slow), "glitch", "bump"]
)
def test_a_spoilt_path_is_refused_by_name(simulated, armpi, twin, kind):
    desired = twin.path(simulated.reference(SHORT))[:2]
    spoilt = np.zeros((400, 3))
    if kind == "noise":
        spoilt = 1e-3 * np.random.default_rng(0).standard_normal((400, 3))
    elif kind == "offset":
        spoilt[:, 0] = 1e-3
    elif kind == "glitch":
        spoilt[150, 2] = 1e-3
    else:
        ramp = SHORT[np.abs(SHORT - simulated.start[1, 1] - 0.3) < 0.1]
        spoilt[np.isin(SHORT, ramp), 1] = 1e-3
    desired[1] += spoilt
    with pytest.raises(InputError, match="run 'run_1'") as caught:
        on_known_grid(desired, armpi, names=names_of(desired), time=SHORT)
    assert "holds its commands" in str(caught.value)


def test_motor_1_is_found_where_the_tool_is_on_its_axis(armpi, twin):
    wanted = movements(
        armpi,
        [[610, 500, 500, 500], [350, 600, 400, 450], [480, 500, 500, 500], [700, 300, 600, 650]],
        [0.05, 2.08, 4.1],
        [[0.6, 0.8, 1.0, 0.8], [1.0, 0.6, 0.8, 0.6], [0.8, 1.0, 0.6, 0.6]],
    )
    found = recover_one(armpi, twin, wanted)
    np.testing.assert_allclose(found.initial, wanted.initial, atol=1e-9)
    np.testing.assert_allclose(found.target, wanted.target, atol=1e-9)
    # Motor 1 turns unseen once the others hold the tool on its axis; the next ramp shows where to.
    np.testing.assert_allclose(found.start, wanted.start, rtol=0, atol=1e-9)


def test_motors_that_stay_have_no_duration(armpi, twin):
    wanted = movements(
        armpi,
        [[450, 600, 400, 450], [450, 600, 400, 650], [300, 600, 400, 650], [300, 500, 450, 650]],
        [0.05, 2.08, 4.1],
    )
    found = recover_one(armpi, twin, wanted)
    np.testing.assert_allclose(found.target, wanted.target, atol=1e-9)
    np.testing.assert_array_equal(
        found.ramp_duration[0] > 0.0,
        [[False, False, False, True], [True, False, False, False], [False, True, True, False]],
    )


def test_a_run_without_movements_rests(armpi, twin):
    wanted = movements(armpi, [[450, 600, 400, 450]], [])
    found = recover_one(armpi, twin, wanted, SHORT)
    assert found.start.shape == (1, 0)
    np.testing.assert_allclose(found.initial, wanted.initial, atol=1e-9)


@pytest.mark.parametrize("seen_s", [0.004, 0.017, 0.05, 0.3, 0.55, 0.7, 0.9])
def test_a_cut_off_ramp_gives_what_is_seen_of_it(armpi, twin, seen_s):
    wanted = movements(
        armpi,
        [[500, 500, 500, 500], [400, 600, 400, 450], [701, 333, 587, 651]],
        [0.05, 10.0 - seen_s],
        [[0.8, 0.8, 0.8, 0.8], [0.6, 0.8, 1.0, 1.0]],
    )
    found = recover_one(armpi, twin, wanted)
    assert found.start.shape == (1, 2)
    if seen_s >= 0.9:
        np.testing.assert_allclose(found.target, wanted.target, atol=1e-9)


def test_a_movement_after_the_record_is_not_seen(armpi, twin):
    counts = [[500, 500, 500, 500], [400, 600, 400, 450], [701, 333, 587, 651]]
    found = recover_one(armpi, twin, movements(armpi, counts, [0.05, 10.3]))
    assert found.start.shape == (1, 1)


def test_a_first_ramp_under_way_at_the_first_sample_is_found(armpi, twin):
    counts = [[521, 488, 512, 497], [400, 600, 400, 450], [701, 333, 587, 651]]
    wanted = movements(armpi, counts, [0.004, 2.05], [[0.6, 0.8, 1.0, 0.8]] * 2)
    found = recover_one(armpi, twin, wanted, FROM_FIRST_STEP)
    np.testing.assert_allclose(found.initial, wanted.initial, atol=1e-9)
    np.testing.assert_allclose(found.start, wanted.start, rtol=0, atol=1e-9)


def test_a_start_outside_the_movements_range_is_found(armpi, twin):
    counts = [[450, 720, 400, 450], [300, 600, 450, 650]]
    found = recover_one(armpi, twin, movements(armpi, counts, [0.05]))
    np.testing.assert_allclose(armpi.servo_units.to_counts(found.initial), counts[:1], atol=1e-6)


def test_shorter_records_and_other_numbers_of_runs_work(armpi, twin, simulated):
    desired = twin.path(simulated.reference(SHORT))[:2]
    found = on_known_grid(desired, armpi, names=["a", "b"], time=SHORT)
    assert path_error(found, desired, SHORT, armpi).max() <= 1e-9


def turned(robot):
    """The robot mounted on its side, away from the base's origin."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    T[:3, 3] = [0.1, -0.2, 0.3]
    first, *others = robot.chain.joints
    joints = (replace(first, T_pj=T @ first.T_pj), *others)
    return replace(robot, chain=replace(robot.chain, joints=joints))


def skewed(robot):
    """The robot with its third axis turned away from the second."""
    first, second, third, fourth = robot.chain.joints
    third = replace(third, T_pj=third.T_pj @ np.array(_about_x(0.3)))
    return replace(robot, chain=replace(robot.chain, joints=(first, second, third, fourth)))


def _about_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return [[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]]


def physical(robot):
    """The robot with a sensor that sees the physical pose, motor 3 turning the other way."""
    return replace(robot, profile=replace(robot.profile, sensor_pose="physical"))


@pytest.mark.parametrize("change", [turned, physical])
def test_the_search_follows_the_chain(armpi, simulated, change):
    robot = change(armpi)
    desired = DigitalTwin(robot).path(simulated.reference(SHORT))[:2]
    found = on_known_grid(desired, robot, names=["a", "b"], time=SHORT)
    assert path_error(found, desired, SHORT, robot).max() <= 1e-12


def test_fit_of_a_ramp_finds_all_that_is_free(twin):
    rng = np.random.default_rng(2)
    initial, target = rng.uniform(-0.8, 0.8, (2, 1, 4))
    ramp, start = np.array([[[0.6, 0.8, 1.0, 0.7]]]), np.array([[0.2]])
    wanted = Movements(initial, target[:, None], ramp, start)
    time = np.linspace(0.0, 1.5, 60)
    part = Samples(time, twin.path(wanted.reference(time))[0])
    guess = Movements(initial, wanted.target + 0.01, ramp + 0.02, start + 0.01)
    found = fit(guess, part, twin, np.repeat([False, True, True], 4), steps=60)
    np.testing.assert_allclose(found.target, wanted.target, atol=1e-9)
    np.testing.assert_allclose(found.ramp_duration, ramp, atol=1e-9)
    np.testing.assert_allclose(found.start, start, atol=1e-9)


def test_another_kind_of_arm_comes_back_exactly_too(armpi, simulated):
    robot = skewed(armpi)
    desired = DigitalTwin(robot).path(simulated.reference(SHORT))[:2]
    found = on_known_grid(desired, robot, names=names_of(desired), time=SHORT)
    assert path_error(found, desired, SHORT, robot).max() <= 1e-9
    seen = found.start.shape[1]
    whole = settles(simulated.start[:2, :seen], simulated.ramp_duration[:2, :seen], SHORT[-1])
    np.testing.assert_allclose(found.target[whole], simulated.target[:2, :seen][whole], atol=1e-9)


def test_a_robot_without_servo_units_is_refused(armpi, simulated):
    robot = replace(armpi, profile=replace(armpi.profile, servo_units=None))
    desired = DigitalTwin(robot).path(simulated.reference(FROM_ZERO))[:1]
    with pytest.raises(InputError, match="the robot has no servo units"):
        on_known_grid(desired, robot, names=["a"])


@pytest.fixture(scope="module")
def between_units(simulated):
    """Movements of a run whose targets are no whole units."""
    chosen = [
        getattr(simulated, name)[:1] for name in ("initial", "target", "ramp_duration", "start")
    ]
    initial, target, ramp, start = chosen
    shift = np.random.default_rng(1).uniform(-0.002, 0.002, target.shape)
    return Movements(initial, target + shift, ramp, start)


def test_targets_between_units_are_refused(armpi, twin, between_units):
    desired = twin.path(between_units.reference(SHORT))
    names = names_of(desired)
    with pytest.raises(InputError, match=r"run 'run_0'.*holds its commands"):
        on_known_grid(desired, armpi, names=names, time=SHORT)
