from __future__ import annotations

import numpy as np
import pytest

from failuretwin import ReadOptions, diagnose, read_runs
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.column_map import (
    AngleColumns,
    ColumnMap,
    CommandColumns,
    TimeColumn,
)

HEADER = (
    "timestamp target_q_0 target_q_1 target_q_2 target_q_3 target_q_4 target_q_5 "
    "actual_q_0 actual_q_1 actual_q_2 actual_q_3 actual_q_4 actual_q_5 "
    "actual_TCP_pose_0 actual_TCP_pose_1 actual_TCP_pose_2 "
    "actual_TCP_pose_3 actual_TCP_pose_4 actual_TCP_pose_5"
)
# A UR5e stretched out along -x, as its Denavit-Hartenberg table says: a2 + a3 = -0.8172 m,
# d4 + d6 = 0.2329 m, d1 - d5 = 0.0628 m.
ZERO = "0 0 0 0 0 0"
TCP = "-0.8172 -0.2329 0.0628 1.5708 0 0"
ROWS = [f"{1000 + 0.002 * k:.3f} {ZERO} {ZERO} {TCP}" for k in range(50)]


def write(folder, header=HEADER, rows=ROWS, name="robot_data.csv"):
    (folder / name).write_text("\n".join([header, *rows]) + "\n")
    return folder / name


@pytest.mark.parametrize("name", ["robot_data.csv", "recording.txt"])
def test_a_recording_is_known_by_its_header(tmp_path, name):
    runs = read_runs(write(tmp_path, name=name), "ur5e")

    assert runs.sizes["motor"] == 5
    np.testing.assert_allclose(runs["time"].values[:3], [0.0, 0.002, 0.004], atol=1e-9)
    np.testing.assert_allclose(runs["measured"][0, 7], [-0.8172, -0.2329, 0.0628])
    assert runs.attrs["measured_rate_hz"] == pytest.approx(500.0)
    assert "computed by the controller from its encoders" in runs.attrs["source"]


def test_commas_may_stand_between_the_columns(tmp_path):
    rows = [row.replace(" ", ",") for row in ROWS]
    runs = read_runs(write(tmp_path, HEADER.replace(" ", ","), rows), "ur5e")
    np.testing.assert_allclose(runs["measured"][0, 7], [-0.8172, -0.2329, 0.0628])


@pytest.mark.parametrize(("wrist_3", "kept"), [(0.0, True), (0.02, False)])
def test_an_accelerometer_that_a_joint_without_motor_turns_is_left_out(tmp_path, wrist_3, kept):
    """Wrist 3 of the bundled arm moves no tool point, but it turns the flange."""
    header = HEADER + "".join(f" actual_tool_accelerometer_{k}" for k in range(3))
    told = [f"0 0 0 0 0 {wrist_3 * k:.2f}" for k in range(20)]
    rows = [f"{0.1 * k:.1f} {q} {ZERO} {TCP} 0 -9.8 0" for k, q in enumerate(told)]
    assert ("accelerometer" in read_runs(write(tmp_path, header, rows), "ur5e")) == kept


def test_every_joint_goes_to_its_motor(tmp_path):
    moved = [
        f"{0.1 * k:.1f} {' '.join(str(0.01 * (j + 1) * k) for j in range(6))} {ZERO} {TCP}"
        for k in range(20)
    ]

    runs = read_runs(write(tmp_path, rows=moved), "ur5e")

    np.testing.assert_allclose(runs["command"][0, -1], [0.19, 0.38, 0.57, 0.76, 0.95], atol=1e-9)
    np.testing.assert_allclose(runs["position"].values[0][np.arange(0, 191, 10)], 0.0)


def test_without_a_tcp_the_path_comes_from_the_encoders(tmp_path):
    header = HEADER.partition(" actual_TCP")[0]
    rows = [row.partition(" -0.8172")[0] for row in ROWS]

    runs = read_runs(write(tmp_path, header, rows), "ur5e")

    np.testing.assert_allclose(runs["measured"][0, 3], [-0.8172, -0.2329, 0.0628], atol=1e-9)
    assert runs.attrs["source"].endswith("tool path = forward kinematics of the readings")


def test_an_accelerometer_is_enough(tmp_path):
    force = " ".join(f"actual_tool_accelerometer_{i}" for i in range(3))
    header = f"timestamp {' '.join(f'target_q_{i}' for i in range(6))} {force}"
    rows = [f"{1000 + 0.002 * k:.3f} {ZERO} 0 0 9.81" for k in range(50)]
    runs = read_runs(write(tmp_path, header, rows), "ur5e")
    np.testing.assert_allclose(runs["accelerometer"][0, 7], [0.0, 0.0, 9.81])
    assert not np.isfinite(runs["measured"]).any()


def test_a_map_wins_over_the_header(tmp_path):
    names = tuple(f"actual_q_{k}" for k in range(5))
    mapping = ColumnMap(
        TimeColumn("timestamp"), CommandColumns(names), position=AngleColumns(names), separator=" "
    )

    runs = read_runs(write(tmp_path), "ur5e", ReadOptions(columns=mapping))

    assert runs.attrs["source"].startswith("CSV with a column map")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("target_q_3", "target_qd_3"), "without target_q_3"),
        (
            lambda text: text.replace("actual_", "other_"),
            "neither actual_TCP_pose nor actual_q",
        ),
    ],
)
def test_a_recipe_that_lacks_something_is_told(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_runs(write(tmp_path, change(HEADER)), "ur5e")


def test_a_tcp_elsewhere_is_not_taken_for_the_flange(tmp_path):
    rows = [row.replace("-0.2329", "-0.3829") for row in ROWS]  # a gripper of 150 mm

    with pytest.raises(InputError, match=r"TCP lies 150 mm from the tool point.*tool_xyz"):
        read_runs(write(tmp_path, rows=rows), "ur5e")


def test_another_arm_is_not_forced_on_a_recording(tmp_path):
    with pytest.raises(InputError, match=r"an RTDE recording has the joints shoulder_pan, .*so101"):
        read_runs(write(tmp_path), "so101")


def test_a_recording_gets_a_verdict(tmp_path):
    """Four movements of all joints, a ramp of 1 s and a rest of 1 s each; motor 2 stays."""
    time = np.arange(0.0, 8.0, 0.02)
    share = np.interp(time, range(9), [0, 0.6, 0.6, -0.4, -0.4, 0.5, 0.5, -0.6, -0.6])
    middle = np.array([0.0, -1.2, 0.4, -0.6, 0.0, 0.0])
    target = middle + np.outer(share, [0.5, 0.6, -0.5, 0.7, 0.4, 0.0])
    actual = target.copy()
    actual[:, 1] = -1.2
    table = np.column_stack([time, target, actual])
    rows = [" ".join(f"{value:.6f}" for value in row) for row in table]

    found = diagnose(write(tmp_path, HEADER.partition(" actual_TCP")[0], rows), robot="ur5e")

    assert found[0].diagnosis == "motor_2:stuck"
