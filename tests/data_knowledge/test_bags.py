from __future__ import annotations

import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.bag_file import is_bag
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.bags import read_bag
from failuretwin.data_knowledge.readers.raw_sessions import read_session
from failuretwin.data_knowledge.readers.timed_log import Targets, timed_run
from failuretwin.digital_model.calibrated_robot import load_calibration

pytest.importorskip("rosbags", reason="needs rosbags")

from bag_writers import (
    FORMATS,
    JOINT_STATE,
    MONITORING,
    POINT,
    POSE,
    TRAJECTORY,
    TRANSFORMS,
    entry,
    time_of,
    write_bag,
)

EVERY_FORMAT = pytest.mark.parametrize("form", FORMATS)
EPOCH_NS = 1_677_764_088_226_450_443
"""An odd epoch: nothing may be rounded on the way."""
JOINTS = ("joint1", "joint2", "joint3", "joint4")
ALL_JOINTS = ("r_joint", "joint4", "joint3", "joint2", "joint5", "joint1")
"""Joints of the arm in an order of no meaning, with two that cannot move the tool."""
OURS = [ALL_JOINTS.index(joint) for joint in JOINTS]
LOG_COLUMNS = [f"motor_{k}" for k in range(1, 7)]
SERVOS = (6, 5, 4, 3)
"""Servos of motors 1 to 4."""
STEP_NS = 100_000_000


def ns(seconds):
    return EPOCH_NS + round(seconds * 1e9)


def to_rad(counts):
    return np.deg2rad(120.0 - 0.24 * np.asarray(counts, dtype=float))


def counts_of(rng, rows):
    return rng.integers(200, 800, (rows, 6)).astype(float)


def monitoring(topic, seconds, position, temperature, names=LOG_COLUMNS, received=None):
    received_ns = None if received is None else ns(received)
    values = {"position": position, "temperature": temperature, "voltage": [7.4] * 6}
    return entry(topic, MONITORING, ns(seconds), received_ns, name=names, **values)


def state(seconds, position, topic="/joint_states", names=JOINTS, received=None):
    received_ns = None if received is None else ns(received)
    return entry(topic, JOINT_STATE, ns(seconds), received_ns, name=names, position=position)


def plan(seconds, points, topic="/arm_controller/joint_trajectory", names=JOINTS):
    """A trajectory of (time from start [s], positions [rad])."""
    listed = [
        {"positions": values, "time_from_start": time_of(round(due * 1e9))}
        for due, values in points
    ]
    return entry(topic, TRAJECTORY, ns(seconds), joint_names=names, points=listed)


def tool_point(seconds, xyz, topic="/tool"):
    return entry(topic, POINT, ns(seconds), point=dict(zip("xyz", xyz, strict=True)))


def readings(count=5, step=0.1):
    return [state(step * k, [0.01 * k] * 4) for k in range(count)]


def commands(topic="/position_monitoring"):
    return [
        monitoring(topic, 0.05 + 2 * k, [500.0 + 10 * k] * 6, [800.0] * 6, received=2.05 + 2 * k)
        for k in range(2)
    ]


@pytest.fixture
def read(tmp_path, armpi):
    """Write entries as a recording and read them back."""

    def make(entries, form="mcap", topics=None, **options):
        return read_bag(write_bag(tmp_path, form, entries, **options), armpi, topics)

    return make


@EVERY_FORMAT
def test_the_authors_messages_come_back(read, form):
    rng = np.random.default_rng(0)
    target, ramp_ms = counts_of(rng, 3), rng.choice([600.0, 800.0, 1000.0], (3, 6))
    reading = counts_of(rng, 40)
    entries = [
        monitoring("/condition_monitoring", 0.1 * k, reading[k], [30.0] * 6) for k in range(40)
    ]
    entries += [
        monitoring("/position_monitoring", 0.25 + k, target[k], ramp_ms[k], received=2.3 + k)
        for k in range(3)
    ]
    log = read(entries, form)

    ours = [servo - 1 for servo in SERVOS]
    assert log.name == "run"
    assert log.tool is None
    np.testing.assert_allclose(log.position.time, 0.1 * np.arange(40), rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.position.value, to_rad(reading[:, ours]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.time, [0.25, 1.25, 2.25], rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.target, to_rad(target[:, ours]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.command.duration, ramp_ms[:, ours] / 1000)


@EVERY_FORMAT
def test_joint_states_come_back(read, form):
    values = np.random.default_rng(1).normal(size=(2, 20, 6))
    entries = [state(0.1 * k, values[0, k], names=ALL_JOINTS) for k in range(20)]
    entries += [
        state(0.1 * k + 0.03, values[1, k], "/arm/joint_command", ALL_JOINTS) for k in range(20)
    ]
    log = read(entries, form)

    np.testing.assert_array_equal(log.position.value, values[0][:, OURS])
    np.testing.assert_array_equal(log.command.value, values[1][:, OURS])
    np.testing.assert_allclose(log.position.time, 0.1 * np.arange(20), rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.time, 0.1 * np.arange(20) + 0.03, rtol=0, atol=1e-12)


def transform(k, child, point, base="base_link"):
    header = {"stamp": time_of(ns(0.1 * k)), "frame_id": base}
    return {"header": header, "child_frame_id": child, "transform": {"translation": point}}


def test_transforms_that_joint_states_tell_are_no_tool(read):
    """A state publisher writes one for each joint: none leads from base to tool."""
    values = np.random.default_rng(1).normal(size=(20, 6))
    entries = [state(0.1 * k, values[k], names=ALL_JOINTS) for k in range(20)]
    entries += [
        entry("/tf", TRANSFORMS, ns(0.1 * k), transforms=[transform(k, "link5", {}, "link4")])
        for k in range(20)
    ]
    entries.append(plan(0.5, [(0.6, values[0])], names=ALL_JOINTS))
    log = read(entries, "mcap")

    assert log.tool is None
    np.testing.assert_array_equal(log.position.value, values[:, OURS])


@EVERY_FORMAT
@pytest.mark.parametrize("kind", [POINT, POSE, TRANSFORMS])
def test_tool_and_trajectories_come_back(read, form, kind):
    rng = np.random.default_rng(2)
    path, targets = rng.normal(size=(30, 3)), rng.normal(size=(3, 6))
    entries = []
    for k, xyz in enumerate(path):
        point = dict(zip("xyz", xyz, strict=True))
        content = {
            POINT: {"point": point},
            POSE: {"pose": {"position": point}},
            TRANSFORMS: {"transforms": [transform(k, "link5", point), transform(k, "lid", {})]},
        }
        entries.append(entry("/tracker/tool", kind, ns(0.1 * k), **content[kind]))
    entries.append(plan(0.5, [(0.6, targets[0]), (1.4, targets[1])], names=ALL_JOINTS))
    entries.append(plan(2.5, [(0.8, targets[2])], names=ALL_JOINTS))
    log = read(entries, form)

    assert log.position is None
    np.testing.assert_array_equal(log.tool.value, path)
    np.testing.assert_allclose(log.tool.time, 0.1 * np.arange(30), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.command.target, targets[:, OURS])
    np.testing.assert_allclose(log.command.time, [0.5, 1.1, 2.5], rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.duration, np.repeat([[0.6], [0.8], [0.8]], 4, axis=1))


@pytest.fixture(scope="module")
def real_session(data, armpi):
    (folder,) = (data / "real_robot_b_20241003" / "label_0").iterdir()
    return read_session(folder, armpi)


def session_entries(folder, labels):
    """The session as its robot published it: stamps of the CSV, commands two seconds late."""
    tables = [
        np.loadtxt(folder / f"trajectory_monitoring_{name}.csv", delimiter=",", skiprows=1)
        for name in ("cmd", "cmd_duration", "position")
    ]
    command, duration, position = tables
    entries = [
        entry(
            "/condition_monitoring",
            MONITORING,
            round(row[0] * 1e9),
            name=labels[0],
            position=row[1:],
            temperature=[32.0] * 6,
            voltage=[7400.0] * 6,
        )
        for row in position
    ]
    entries += [
        entry(
            "/position_monitoring",
            MONITORING,
            round(row[0] * 1e9),
            round((row[0] + 2.005) * 1e9),
            name=labels[1],
            position=row[1:],
            temperature=ramp[1:],
            voltage=[0.0],
        )
        for row, ramp in zip(command, duration, strict=True)
    ]
    return sorted(entries, key=lambda item: item.received_ns)


AUTHORS_LABELS = ["joint1", "joint2", "joint3", "joint4", "joint5", "r_joint"]


@pytest.mark.parametrize("form", ["ros1", "mcap"])
@pytest.mark.parametrize(
    "labels",
    [(AUTHORS_LABELS, ["Target value"]), (["motor position"], []), (LOG_COLUMNS, LOG_COLUMNS)],
    ids=["authors", "older program", "log columns"],
)
def test_a_real_session_comes_back_from_a_bag(read, armpi, real_session, form, labels):
    log = read(session_entries(real_session.folder, labels), form)

    zero = min(real_session.command_time[0], real_session.reading_time[0])
    at = {"rtol": 0, "atol": 5e-7}
    np.testing.assert_allclose(log.command.time, real_session.command_time - zero, **at)
    np.testing.assert_allclose(log.position.time, real_session.reading_time - zero, **at)
    np.testing.assert_array_equal(
        log.command.target, armpi.servo_units.to_rad(real_session.target_counts)
    )
    np.testing.assert_array_equal(log.command.duration, real_session.ramp_s)
    counts = real_session.reading_counts
    sound = armpi.servo_units.valid(counts)
    assert (~sound).any()
    np.testing.assert_array_equal(
        log.position.value, np.where(sound, armpi.servo_units.to_rad(counts), np.nan)
    )


def reference_entries(runs, run):
    """Trajectories that ask for the reference of a run: a point wherever a motor arrives."""
    command, time = runs["command"].values[run], runs["time"].values
    starts = runs["movement_start"].values[run]
    for start, ramps in zip(starts, runs["ramp_duration"].values[run], strict=True):
        due = np.unique(ramps)
        points = np.stack([np.interp(start + due, time, angle) for angle in command.T], axis=1)
        yield plan(start, list(zip(due, points, strict=True)))


@pytest.mark.parametrize("fault", ["healthy", "motor_2:stuck", "motor_3:steady_state_error"])
def test_a_simulated_run_gets_the_same_diagnosis_from_a_bag(read, armpi, twin, fault):
    hypothesis = Hypothesis.parse(fault, armpi.motor_names)
    known = load_calibration("none", armpi).imperfections
    runs = simulate(Plan(armpi, [hypothesis], 1, 3, known)).isel(run=[0])
    time = runs["time"].values
    entries = list(reference_entries(runs, 0))
    for at, angles, xyz in zip(
        time, runs["position"].values[0], runs["measured"].values[0], strict=True
    ):
        entries += [state(at, angles), tool_point(at, xyz)]
    back = timed_run(read(entries), armpi).to_dataset()

    np.testing.assert_allclose(back["command"], runs["command"], rtol=0, atol=2e-4)
    np.testing.assert_allclose(back["measured"], runs["measured"], rtol=0, atol=1e-12)
    (direct,), (recorded,) = (BayesDiagnoser(twin).diagnose(r) for r in (runs, back))
    assert recorded.diagnosis == direct.diagnosis == fault
    assert recorded.posterior == pytest.approx(direct.posterior, abs=1e-3)


@pytest.mark.parametrize(
    "names",
    [
        ["1", "2", "3", "4", "5", "6"],
        ["6", "1", "3", "5", "2", "4"],
        ["motor_4", "motor_6", "motor_1", "motor_3", "motor_5", "motor_2"],
    ],
)
def test_counts_belong_to_servos_whatever_their_order(read, names):
    servo = [int(name[-1]) for name in names]
    position = [500.0 + 10 * s for s in servo]
    entries = [monitoring("/condition_monitoring", 0.1 * k, position, [], names) for k in range(3)]
    log = read([*entries, *commands()])
    expected = to_rad([[500 + 10 * s for s in SERVOS]] * 3)
    np.testing.assert_allclose(log.position.value, expected, rtol=0, atol=1e-12)


def test_counts_by_joint_belong_to_joints(read):
    """Only the authors' own labels stand for servos; others mean what they say."""
    names, position = [*JOINTS[::-1], "joint5"], [400.0, 300.0, 200.0, 100.0, 0.0]
    entries = [monitoring("/condition_monitoring", 0.1 * k, position, [], names) for k in range(3)]
    log = read([*entries, *commands()])
    np.testing.assert_allclose(log.position.value[0], to_rad([100, 200, 300, 400]))


def test_angles_by_motor_are_not_taken_for_servos(read):
    entries = [state(0.1 * k, np.arange(6) / 10, names=LOG_COLUMNS) for k in range(3)]
    log = read([*entries, *commands()])
    np.testing.assert_array_equal(log.position.value, [[0.0, 0.1, 0.2, 0.3]] * 3)


def test_package_of_the_message_does_not_matter(tmp_path, armpi):
    text = "string note\nstd_msgs/Header header\nstring[] name\nfloat32[] position\n"
    text += "float64[6] temperature\nfloat64[] voltage\n"
    entries = [replace(item, type="lab/msg/Servos") for item in commands()]
    path = write_bag(tmp_path, "ros1", [*readings(), *entries], types={"lab/msg/Servos": text})
    log = read_bag(path, armpi)
    np.testing.assert_allclose(log.command.target, to_rad([[500] * 4, [510] * 4]), atol=1e-6)


@pytest.mark.parametrize("type_", ["cm/msg/msg_cm", JOINT_STATE])
def test_older_ros2_bags_hold_no_definitions(tmp_path, armpi, type_):
    entries = [*readings(), *commands()]
    if type_ == JOINT_STATE:
        entries = [*readings(), *(state(0.1 * k, [0.1] * 4, "/command") for k in range(3))]
    path = write_bag(tmp_path, "ros2", entries)
    whole = read_bag(path, armpi)
    database = sqlite3.connect(next(path.glob("*.db3")))
    database.execute("DROP TABLE message_definitions")
    database.execute("UPDATE schema SET schema_version = 3")
    database.commit()
    database.close()
    log = read_bag(path, armpi)
    np.testing.assert_array_equal(log.position.value, whole.position.value)
    if isinstance(log.command, Targets):
        np.testing.assert_array_equal(log.command.target, whole.command.target)
    else:
        np.testing.assert_array_equal(log.command.value, whole.command.value)


def test_a_strange_topic_spoils_no_other(read):
    odd = entry("/odd", "lab/msg/Odd", ns(0.2), position=[1.0])
    types = {"lab/msg/Odd": "std_msgs/Header header\nfloat64[] position\n"}
    with_it = read([*readings(), odd, *commands()], types=types)
    assert len(with_it.position.time) == 5


def test_a_type_that_makes_no_sense_spoils_no_other(tmp_path, armpi):
    path = tmp_path / "run.bag"
    sound = write_bag(tmp_path, "ros1", [*readings(), *commands()], name="sound")
    definition = b"float64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    spoilt = entry("/odd", "lab/msg/Odd", ns(0.2), position=[1.0])
    types = {"lab/msg/Odd": "std_msgs/Header header\n" + definition.decode()}
    both = write_bag(tmp_path, "ros1", [spoilt, *readings(), *commands()], "both", types)
    nonsense = definition.replace(b"float64[] effort", b"float64{} effort")
    path.write_bytes(both.read_bytes().replace(b"header\n" + definition, b"header\n" + nonsense))
    assert path.read_bytes() != both.read_bytes()
    log, expected = (read_bag(p, armpi) for p in (path, sound))
    np.testing.assert_array_equal(log.position.value, expected.position.value)


@EVERY_FORMAT
def test_topics_without_messages_do_not_count(read, form):
    declared = [("/tool", POINT), ("/other/joint_states", JOINT_STATE), ("/plan", TRAJECTORY)]
    log = read([*readings(), *commands()], form, declared=declared)
    assert log.tool is None
    assert len(log.position.time) == 5


@EVERY_FORMAT
def test_zero_stamps_fall_back_on_the_time_of_receipt(read, form):
    entries = [
        replace(item, content=item.content | {"header": {}})
        for item in [*readings(), plan(0.15, [(0.5, [0.1] * 4)])]
    ]
    log = read(entries, form)
    np.testing.assert_allclose(log.position.time, 0.1 * np.arange(5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.time, [0.15], rtol=0, atol=1e-12)


def test_messages_out_of_order_are_sorted(read):
    shuffled = [
        replace(item, received_ns=ns(10 + k))
        for k, item in enumerate(readings()[i] for i in (3, 0, 4, 1, 2))
    ]
    log = read([*commands()[::-1], *shuffled])
    np.testing.assert_allclose(log.position.value[:, 0], 0.01 * np.arange(5))
    np.testing.assert_allclose(log.position.time, 0.1 * np.arange(5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.command.time, [0.05, 2.05], rtol=0, atol=1e-12)


def test_of_two_messages_with_one_stamp_the_last_received_counts(read):
    again = state(0.2, [7.0] * 4, received=0.21)
    log = read([*readings(), again, *commands()])
    np.testing.assert_array_equal(log.position.value[:, 0], [0.0, 0.01, 7.0, 0.03, 0.04])


def test_joints_published_apart_with_one_stamp_are_put_together(read):
    entries = []
    for k in range(3):
        entries.append(state(0.1 * k, [1.0, 2.0], names=JOINTS[:2]))
        entries.append(state(0.1 * k, [3.0, 4.0, 9.0], names=[*JOINTS[2:], "r_joint"]))
        entries.append(state(0.1 * k + 0.05, [9.0], names=["r_joint"]))
    log = read([*entries, *commands()])
    np.testing.assert_array_equal(log.position.value, [[1.0, 2.0, 3.0, 4.0]] * 3)


def test_a_later_plan_replaces_the_rest_of_the_one_before(read):
    pose = [[0.1 * k] * 4 for k in range(6)]
    first = plan(0.0, [(1.0, pose[1]), (2.0, pose[2]), (3.0, pose[3])])
    gripper = plan(0.5, [(1.0, [9.0])], names=["r_joint"])
    log = read([*readings(40), first, gripper, plan(1.5, [(1.0, pose[4]), (2.0, pose[5])])])
    np.testing.assert_allclose(log.command.time, [0.0, 1.0, 1.5, 2.5], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.command.target, [pose[k] for k in (1, 2, 4, 5)])


@pytest.mark.parametrize("seen", [True, False])
def test_the_pose_that_a_plan_starts_from_is_no_movement(read, armpi, seen):
    pose = [[0.3] * 4, [0.8] * 4, [0.1] * 4]
    plans = [
        plan(0.5, [(0.0, pose[0]), (1.0, pose[1])]),
        plan(2.5, [(0.0, np.add(pose[1], 1e-3)), (1.0, pose[2])]),
    ]
    sources = [state(0.1 * k, [0.299] * 4) for k in range(50)]
    if not seen:
        sources = [tool_point(0.1 * k, [0.1, 0.0, 0.2]) for k in range(50)]
    log = read([*sources, *plans])
    run = timed_run(log, armpi)
    begin = 0.299 if seen else 0.3
    expected = np.interp(run.time, [0.5, 1.5, 2.5, 3.5], [begin, 0.8, 0.8, 0.1])
    np.testing.assert_allclose(run.command[0, :, 0], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(log.command.target[-2:], pose[1:])


def test_the_pose_that_a_plan_starts_from_counts_if_readings_begin_later(read, armpi):
    late = [state(0.6 + 0.1 * k, [0.299] * 4) for k in range(50)]
    log = read([*late, plan(0.5, [(0.0, [0.3] * 4), (1.0, [0.8] * 4)])])
    run = timed_run(log, armpi)
    expected = np.interp(run.time, [0.0, 1.0], [0.3, 0.8])
    np.testing.assert_allclose(run.command[0, :, 0], expected, rtol=0, atol=1e-6)


def test_a_plan_of_one_point_due_at_once_is_a_jump(read):
    log = read([*readings(40), plan(0.5, [(1.0, [0.1] * 4)]), plan(2.0, [(0.0, [0.5] * 4)])])
    np.testing.assert_array_equal(log.command.target[:, 0], [0.1, 0.5])
    np.testing.assert_array_equal(log.command.duration[:, 0], [1.0, 0.0])


def test_a_motor_that_a_plan_leaves_out_stays_where_it_was_sent(read):
    log = read(
        [
            *readings(40),
            plan(0.5, [(1.0, [0.1, 0.2, 0.3, 0.4])]),
            plan(2.0, [(0.5, [0.9])], names=["joint3"]),
        ]
    )
    np.testing.assert_array_equal(log.command.target[1], [0.1, 0.2, 0.9, 0.4])
    np.testing.assert_array_equal(log.command.duration[1], [0.5] * 4)


def test_readings_out_of_range_are_missing(read):
    position = np.full((3, 6), 500.0)
    position[1, 5] = -32503.0
    entries = [
        monitoring("/condition_monitoring", 0.1 * k, position[k], [30.0] * 6) for k in range(3)
    ]
    log = read([*entries, *commands()])
    np.testing.assert_array_equal(np.isnan(log.position.value[1]), [True, False, False, False])
    assert np.isfinite(log.position.value[[0, 2]]).all()


def test_positions_of_a_lost_tool_are_left_out(read):
    points = [tool_point(0.1 * k, [np.nan if k == 2 else k, 0, 0]) for k in range(5)]
    log = read([*points, *commands()])
    np.testing.assert_array_equal(log.tool.value[:, 0], [0, 1, 3, 4])


def test_topics_of_other_joints_do_not_count(read):
    wheels = [state(0.1 * k, [1.0, 2.0], "/base/joint_states", ["left", "right"]) for k in range(3)]
    gripper = plan(0.2, [(1.0, [0.5])], "/gripper/joint_trajectory", ["r_joint"])
    log = read([*wheels, gripper, *readings(), plan(0.1, [(1.0, [0.1] * 4)])])
    assert len(log.position.time) == 5
    np.testing.assert_array_equal(log.command.target, [[0.1] * 4])
    points = [tool_point(0.1 * k, [0, 0, 0.1 * k]) for k in range(5)]
    assert read([*wheels, *points, *commands()], name="tool").position is None


def test_wishes_are_no_readings(read):
    goal = tool_point(0.2, [1, 1, 1], "/goal_point")
    wish = state(0.2, [1.0] * 4, "/desired_joint_states")
    log = read([goal, wish, *readings(), *commands()])
    assert log.tool is None
    assert len(log.position.time) == 5


def test_topics_can_be_named(tmp_path, armpi):
    entries = [*readings(), *commands("/a/command"), *commands("/b/command")]
    entries.append(state(0.1, [0.5] * 4, "/wanted"))
    entries.append(state(0.2, [0.6] * 4, "/wanted"))
    path = write_bag(tmp_path, "mcap", entries)
    (tmp_path / "map.toml").write_text('[topics]\ncommand = "b/command"\nposition = "/wanted"\n')
    table = read_toml(tmp_path / "map.toml")["topics"]
    topics = from_table(BagTopics, table, "map.toml: topics")
    assert topics == BagTopics(command="b/command", position="/wanted")
    log = read_bag(path, armpi, topics)
    assert isinstance(log.command, Targets)
    np.testing.assert_array_equal(log.position.value[:, 0], [0.5, 0.6])


def refused(tmp_path, armpi, entries, topics=None, **options):
    path = write_bag(tmp_path, "mcap", entries, **options)
    with pytest.raises(InputError) as error:
        read_bag(path, armpi, topics)
    return str(error.value).replace(str(path), "BAG")


def test_several_commands_leave_a_choice_to_the_user(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), *commands("/a/cmd"), *commands("/b/cmd")])
    assert text == (
        "BAG: several topics could be the command: /a/cmd (cm/msg/msg_cm, 2 messages), /b/cmd "
        '(cm/msg/msg_cm, 2 messages). Name one, such as command = "/a/cmd", under [topics] in a '
        "TOML file for --columns or in BagTopics in Python."
    )


@pytest.mark.parametrize(
    ("more", "role"),
    [
        ([state(0.1, [0.0] * 4, "/other")], "position"),
        ([tool_point(0.1, [0, 0, 0], "/a"), tool_point(0.1, [0, 0, 0], "/b")], "tool"),
        ([plan(0.1, [(1.0, [0.1] * 4)])], "command"),
    ],
)
def test_any_choice_is_left_to_the_user(tmp_path, armpi, more, role):
    text = refused(tmp_path, armpi, [*readings(), *commands(), *more])
    assert f"several topics could be the {role}: " in text


def test_topic_that_does_not_exist(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), *commands()], BagTopics(command="joint_state"))
    assert text == (
        "BAG: unknown topic 'joint_state'. Did you mean '/joint_states'? "
        "Valid: /joint_states, /position_monitoring."
    )


def test_topic_that_cannot_be_what_it_is_named(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), *commands()], BagTopics(tool="/joint_states"))
    assert text == (
        "BAG: topic /joint_states (sensor_msgs/msg/JointState, 5 messages) cannot be the tool. "
        "Expected geometry_msgs/msg/PointStamped, geometry_msgs/msg/PoseStamped, "
        "tf2_msgs/msg/TFMessage."
    )


def test_a_missing_joint_is_named_with_those_that_are_there(tmp_path, armpi):
    names = ["joint1", "joint2", "joint4", "wrist"]
    text = refused(tmp_path, armpi, [state(0.1, [0.0] * 4, names=names), *commands()])
    assert text == (
        "BAG: topic /joint_states: values for joint3 are missing; it names joint1, joint2, joint4, "
        "wrist. Expected all motors of 'armpi_fpv' by one of these: joints joint1, joint2, joint3, "
        "joint4; motors motor_1, motor_2, motor_3, motor_4; log columns motor_6, motor_5, motor_4, "
        "motor_3; servo numbers 6, 5, 4, 3."
    )


def test_commands_of_another_robot_are_refused(tmp_path, armpi):
    wheels = plan(0.1, [(1.0, [1.0])], names=["wheel"])
    text = refused(tmp_path, armpi, [*readings(), wheels])
    assert "values for joint1, joint2, joint3, joint4 are missing; it names wheel." in text


def test_log_of_a_single_servo_is_refused(tmp_path, armpi):
    entries = [monitoring("/condition_monitoring", 0.1, [500.0], [30.0], ["motor_6"])]
    text = refused(tmp_path, armpi, [*entries, *commands()])
    assert "values for motor_5, motor_4, motor_3 are missing; it names motor_6." in text


def test_nothing_understood_lists_what_is_there(tmp_path, armpi):
    text = refused(
        tmp_path, armpi, [entry("/rosout", "std_msgs/msg/String", ns(0)) for _ in range(3)]
    )
    assert text == (
        "BAG: holds no messages that are understood. Expected messages with header, name, "
        "position, temperature and voltage, sensor_msgs/msg/JointState, "
        "trajectory_msgs/msg/JointTrajectory, geometry_msgs/msg/PointStamped, "
        "geometry_msgs/msg/PoseStamped, tf2_msgs/msg/TFMessage. "
        "Found: /rosout (std_msgs/msg/String, 3 messages)."
    )


def test_a_long_list_of_topics_is_cut(tmp_path, armpi):
    entries = [entry(f"/t{k:02d}", "std_msgs/msg/String", ns(0)) for k in range(25)]
    text = refused(tmp_path, armpi, entries)
    assert text.endswith("/t19 (std_msgs/msg/String, 1 messages), and 5 more.")


def test_an_empty_recording_says_so(tmp_path, armpi):
    assert refused(tmp_path, armpi, []).endswith("Found: no topics.")


def test_no_commands(tmp_path, armpi):
    text = refused(tmp_path, armpi, readings())
    assert text.startswith("BAG: holds no commands. Expected a JointTrajectory, or joint values on")
    assert text.endswith("Found: /joint_states (sensor_msgs/msg/JointState, 5 messages).")


def test_wishes_alone_are_no_commands(tmp_path, armpi):
    text = refused(tmp_path, armpi, [tool_point(0.2, [1, 1, 1], "/goal_point")])
    assert text.startswith("BAG: holds no commands.")


def test_topic_of_several_types_is_not_understood(tmp_path, armpi):
    mixed = entry("/joint_states", "std_msgs/msg/String", ns(0.3))
    path = write_bag(tmp_path, "ros1", [*readings(), mixed, *commands()])
    with pytest.raises(InputError) as error:
        read_bag(path, armpi)
    types = r"(sensor_msgs/msg/JointState or std_msgs/msg/String, 6 messages)"
    assert f"Found: /joint_states {types}" in str(error.value)


def test_a_named_topic_must_hold_messages(tmp_path, armpi):
    options = {"topics": BagTopics(tool="/tool"), "declared": [("/tool", POINT)]}
    text = refused(tmp_path, armpi, [*readings(), *commands()], **options)
    assert text == (
        "BAG: topic /tool (geometry_msgs/msg/PointStamped, 0 messages) is empty. Name another one "
        "as the tool."
    )


def test_neither_tool_nor_readings(tmp_path, armpi):
    text = refused(tmp_path, armpi, commands())
    assert text.startswith("BAG: holds neither tool positions nor motor readings. Expected a Point")


def test_readings_never_whole(tmp_path, armpi):
    halves = [state(0.1, [0.0] * 2, names=JOINTS[:2]), state(0.2, [0.0] * 2, names=JOINTS[2:])]
    text = refused(tmp_path, armpi, [*halves, *commands()])
    assert text.startswith(
        "BAG: topic /joint_states: no message holds sound readings of all motors, which the tool"
    )


def test_names_and_values_must_match(tmp_path, armpi):
    text = refused(tmp_path, armpi, [state(0.1, [0.0] * 3), *commands()])
    assert text == (
        "BAG: topic /joint_states: a message names 4 joints (joint1, joint2, joint3, joint4) but "
        "its field `position` holds 3 values. Expected one for each."
    )


def test_trajectories_without_positions_are_refused(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), plan(0.1, [(1.0, [])])])
    assert "names 4 joints" in text
    assert "its field `positions` holds 0 values" in text


def test_points_must_be_due_one_after_the_other(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), plan(0.1, [(1.0, [0] * 4), (0.5, [0] * 4)])])
    assert text == (
        "BAG: topic /arm_controller/joint_trajectory: a point of a trajectory is due after 0.5 s, "
        "the one before it after 1 s. Expected times that increase from 0."
    )


@pytest.mark.parametrize("duration", [-1.0, np.nan])
def test_durations_that_make_no_sense(tmp_path, armpi, duration):
    bad = monitoring("/position_monitoring", 0.1, [500.0] * 6, [800.0] * 5 + [duration])
    text = refused(tmp_path, armpi, [*readings(), bad])
    assert "the durations of a command (its field `temperature`) are [800.0, " in text
    assert text.endswith("ms, expected 0 or more.")


def test_a_motor_that_is_never_sent_anywhere(tmp_path, armpi):
    text = refused(tmp_path, armpi, [*readings(), plan(0.1, [(1.0, [0.0, np.nan, 0.0, 0.0])])])
    assert text.endswith("no command holds a value for motor_2. Record them.")


def test_stamps_of_two_clocks(tmp_path, armpi):
    late = [state(86400 + 0.1 * k, [0.0] * 4) for k in range(3)]
    text = refused(tmp_path, armpi, [*late, *commands()])
    assert text == (
        "BAG: its stamps lie 24.0 hours apart: topic /position_monitoring from "
        f"{ns(0.05) / 1e9:.3f} to {ns(2.05) / 1e9:.3f} s; topic /joint_states from "
        f"{ns(86400) / 1e9:.3f} to {ns(86400.2) / 1e9:.3f} s. Expected one run by one clock. Set "
        "the clocks before recording, or cut the recording."
    )


@EVERY_FORMAT
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_recording_that_was_cut_off_is_refused(tmp_path, armpi, form, share):
    path = write_bag(tmp_path, form, [*readings(200), *commands()])
    file = next(path.glob("*.db3")) if form == "ros2" else path
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    repair = {"ros1": "rosbag reindex", "ros2": "ros2 bag reindex", "mcap": "mcap recover"}[form]
    with pytest.raises(InputError) as error:
        read_bag(path, armpi)
    assert str(error.value).startswith(f"{path}: cannot be read as a ROS recording (")
    assert f"repair it with `{repair}`; else record or copy it again." in str(error.value)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_file_of_another_kind_is_refused(tmp_path, armpi, suffix):
    path = tmp_path / f"run{suffix}"
    path.write_text("timestamp,motor_1\n0.0,500\n" * 100)
    with pytest.raises(InputError, match="cannot be read as a ROS recording"):
        read_bag(path, armpi)


@pytest.mark.parametrize("text", ["", "a: 1", "rosbag2_bagfile_information: {version: 5}", "{["])
def test_a_folder_without_sound_metadata_is_refused(tmp_path, armpi, text):
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match="cannot be read as a ROS recording"):
        read_bag(tmp_path, armpi)


def test_bytes_gone_wrong_never_end_in_a_traceback(tmp_path, armpi):
    rng = np.random.default_rng(3)
    for form in ("ros1", "mcap"):
        path = write_bag(tmp_path, form, [*readings(20), *commands()])
        sound = path.read_bytes()
        for place in rng.integers(len(sound), size=10):
            path.write_bytes(sound[:place] + rng.bytes(4) + sound[place + 4 :])
            try:
                log = read_bag(path, armpi)
            except InputError as error:
                assert str(path) in str(error)
            else:
                assert log.name == "run"


def test_what_is_a_bag(tmp_path):
    entries = [*readings(), *commands()]
    for form in FORMATS:
        assert is_bag(write_bag(tmp_path, form, entries))
    assert is_bag(next((tmp_path / "run").glob("*.db3")))
    for name in ("run.csv", "bag"):
        (tmp_path / name).write_text("x")
        assert not is_bag(tmp_path / name)
    (tmp_path / "folder.bag").mkdir()
    assert not is_bag(tmp_path / "folder.bag")
    assert not is_bag(tmp_path / "missing.bag")


def test_database_of_a_ros2_bag_can_be_read_alone(tmp_path, armpi):
    folder = write_bag(tmp_path, "ros2", [*readings(), *commands()])
    whole, alone = (read_bag(p, armpi) for p in (folder, next(folder.glob("*.db3"))))
    np.testing.assert_array_equal(whole.position.value, alone.position.value)
    assert whole.name == "run"


def test_missing_package_says_how_to_install_it(tmp_path, armpi, monkeypatch):
    path = write_bag(tmp_path, "ros1", readings())
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(InputError) as error:
        read_bag(path, armpi)
    assert str(error.value).startswith(f"{path}: ROS bags need rosbags (")
    assert str(error.value).endswith("Install it: pip install 'failuretwin[files]'.")
