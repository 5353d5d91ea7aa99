from __future__ import annotations

import sys

import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin import DigitalTwin, ReadOptions, diagnose, load_robot, read_runs
from failuretwin.app.cli import cli
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.lerobot import read_lerobot
from failuretwin.data_knowledge.readers.lerobot_units import LeRobotAngles
from lerobot_writers import NAMES, write_info, write_table

WIDE = {"low": (-110.0, -100.0, -97.0, -95.0, -180.0), "high": (110.0, 100.0, 97.0, 95.0, 180.0)}


def frames(count, scale=1.0):
    """Return commands and readings of some frames, (frame, channel): a ramp and what trails it."""
    ramp = np.clip(np.arange(count) / 30.0 - 0.5, 0.0, 1.0)
    action = np.outer(ramp, [20.0, -30.0, 25.0, 10.0, 5.0, 50.0]) * scale
    return action, np.concatenate([action[:1], action[:-1]])


def write_v2(folder, scale=1.0):
    write_info(folder, "v2.1", {"motors": [f"main_{name}" for name in NAMES]})
    for number, count in enumerate((60, 90)):
        episode = {number: frames(count, scale)}
        write_table(folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet", episode)
    (folder / "meta" / "episodes.jsonl").write_text('{"episode_index": 0, "length": 60}\n')
    return folder


def write_v3(folder, scale=1.0, clip=np.inf):
    write_info(folder, "v3.0", [f"{name}.pos" for name in NAMES])
    episodes = {k: np.clip(frames(n, scale), -clip, clip) for k, n in enumerate((60, 90))}
    write_table(folder / "data" / "chunk-000" / "file-000.parquet", episodes)
    return folder


@pytest.mark.parametrize("write", [write_v2, write_v3])
def test_episodes_become_runs_with_commands_and_readings_in_radians(tmp_path, write):
    runs = read_runs(write(tmp_path / "pick"), "so101")

    assert runs["run"].values.tolist() == ["pick/episode_000000", "pick/episode_000001"]
    assert runs.attrs["measured_rate_hz"] == pytest.approx(30.0)
    np.testing.assert_allclose(runs["duration"], [59 / 30, 89 / 30], atol=0.011)
    last = [0.34906585, -0.52359878, 0.43633231, 0.17453293, 0.08726646]  # 20, -30, 25, 10, 5 deg
    np.testing.assert_allclose(runs["command"][1, -1], last, atol=1e-6)
    position = runs["position"].values[1]
    seen = np.isfinite(position).all(axis=1)
    assert seen.sum() == 90
    np.testing.assert_allclose(position[seen][-1], last, atol=1e-6)
    half_way = 29  # read at frame 30 what was told at frame 29: 20 deg of 30/29 parts
    np.testing.assert_allclose(
        np.rad2deg(position[seen][30, 0]), 20.0 * (half_way / 30.0 - 0.5), atol=1e-4
    )


def test_the_tool_path_is_the_forward_kinematics_of_the_readings(tmp_path):
    runs = read_runs(write_v3(tmp_path / "pick"), "so101")

    robot = load_robot("so101")
    position, measured = runs["position"].values[0], runs["measured"].values[0]
    seen = np.isfinite(position).all(axis=1)
    np.testing.assert_allclose(measured[seen], DigitalTwin(robot).path(position[seen]), atol=1e-12)
    assert np.isnan(measured[~seen]).all()
    assert runs.attrs["source"] == (
        "LeRobot v3.0, angles in deg (guessed: -100 to 100 is possible too); "
        "tool path = forward kinematics of the readings"
    )


def test_normalised_angles_span_the_range_that_the_map_gives(tmp_path):
    folder = write_v3(tmp_path / "pick", scale=4.0, clip=100.0)

    runs = read_runs(folder, "so101", ReadOptions(lerobot=LeRobotAngles("normalised", **WIDE)))

    # 80 of 100 of 110 deg, -100 of 100 deg (clipped), 100 of 97, 40 of 95, 20 of 180
    np.testing.assert_allclose(
        np.rad2deg(runs["command"][0, -1]), [88.0, -100.0, 97.0, 38.0, 36.0], atol=1e-4
    )
    assert runs.attrs["source"].startswith(
        "LeRobot v3.0, angles in normalised (stated), without the readings of "
    )


def test_where_a_command_is_clipped_nothing_is_read(tmp_path):
    """The lift is told -120 times the share of its ramp: -100 from 5/6 of it on, frame 40 of 60."""
    folder = write_v3(tmp_path / "pick", scale=4.0, clip=100.0)

    runs = read_runs(folder, "so101", ReadOptions(lerobot=LeRobotAngles("normalised", **WIDE)))

    seen = np.flatnonzero(np.isfinite(runs["position"].values[0]).all(axis=1))
    assert len(seen) == 40
    left_out = "70 of 150 frames: a command is clipped at -100 or 100"
    assert f"(stated), without the readings of {left_out}" in runs.attrs["source"]
    assert runs["time"].values[seen[-1]] == pytest.approx(39 / 30, abs=0.006)


def test_sign_and_zero_turn_and_shift_joints(tmp_path):
    angles = LeRobotAngles("deg", sign=(1, 1, -1, 1, 1), zero=(2.0, 0.0, 5.0, 0.0, 0.0))

    runs = read_runs(write_v3(tmp_path / "pick"), "so101", ReadOptions(lerobot=angles))

    np.testing.assert_allclose(
        np.rad2deg(runs["command"][0, -1]), [18.0, -30.0, -20.0, 10.0, 5.0], atol=1e-4
    )


@pytest.mark.parametrize(
    ("scale", "clip", "unit", "why"),
    [
        (4.0, 100.0, "normalised", "the largest is exactly 100; range guessed from the limits"),
        (0.1, np.inf, "rad", "none is larger than 3.00"),
        (5.0, np.inf, "deg", "the largest is 150"),
    ],
)
def test_a_unit_that_nothing_states_is_guessed_by_size_and_said(tmp_path, scale, clip, unit, why):
    runs = read_runs(write_v3(tmp_path / "pick", scale, clip), "so101")

    assert runs.attrs["source"].startswith(f"LeRobot v3.0, angles in {unit} (guessed: {why}")


def test_the_guessed_map_leads_to_a_verdict(tmp_path, monkeypatch):
    write_v3(tmp_path / "pick", scale=4.0, clip=100.0)
    monkeypatch.chdir(tmp_path)
    command = ["diagnose", "pick", "--robot", "so101"]
    command += ["--columns", "map.toml", "--hypotheses", "healthy,motor_2:stuck"]

    guess, result = (CliRunner().invoke(cli, command) for _ in range(2))

    assert isinstance(guess.exception, InputError)
    assert "low = [-110.0079, -99.9811, -96.8299, -94.9964, -159.8552]" in guess.output
    assert result.exception is None
    assert "pick/episode_000000" in result.output


def test_a_joint_that_the_data_set_lacks_is_told_with_what_it_has(tmp_path):
    with pytest.raises(
        InputError,
        match=r"'shoulder_pan_joint'.*shoulder_pan\..*so101_follower.*--robot, here ur5e",
    ):
        read_runs(write_v3(tmp_path / "pick"), "ur5e")


def test_joints_of_the_map_name_channels_of_other_names(tmp_path):
    angles = LeRobotAngles(joints=("wrist_roll.pos", *[f"{n}.pos" for n in NAMES[1:5]]))

    runs = read_runs(write_v3(tmp_path / "pick"), "so101", ReadOptions(lerobot=angles))

    np.testing.assert_allclose(np.rad2deg(runs["command"][0, -1, 0]), 5.0, atol=1e-4)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"unit": "degrees"}, "unknown unit 'degrees'"),
        ({"unit": "normalised", "low": (1.0,)}, "low has 1 entries and high 0"),
    ],
)
def test_a_wrong_map_is_explained(told, message):
    with pytest.raises(InputError, match=message):
        LeRobotAngles(**told)


def test_without_pyarrow_it_says_what_to_install(tmp_path, monkeypatch):
    write_info(tmp_path, "v3.0", [f"{name}.pos" for name in NAMES])
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "file-000.parquet").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "pyarrow", None)

    with pytest.raises(InputError, match=r"pip install 'failuretwin\[lerobot\]'"):
        read_runs(tmp_path, "so101")


def test_a_data_set_without_data_says_so(tmp_path):
    write_info(tmp_path, "v3.0", [f"{name}.pos" for name in NAMES])

    with pytest.raises(InputError, match="no parquet files below data/"):
        read_runs(tmp_path, "so101")


def test_a_frame_without_the_number_of_its_episode_is_refused(tmp_path):
    import pyarrow.parquet as pq

    folder = write_v3(tmp_path / "pick")
    (file,) = (folder / "data").rglob("*.parquet")
    table = pq.read_table(file)
    place = table.schema.get_field_index("episode_index")
    numbers = [None, *table["episode_index"].to_pylist()[1:]]
    pq.write_table(table.set_column(place, "episode_index", [numbers]), file)

    with pytest.raises(InputError, match="episode_index and frame_index have rows without"):
        read_runs(folder, "so101")


@pytest.fixture(scope="module")
def teleoperated(data):
    """Four episodes of a healthy arm, normalised: its elbow is clipped at exactly 100."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: extra lerobot")
    folder = data / "so101"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    return folder


def test_a_real_data_set_shows_unit_and_ranges_by_its_encoder_steps(teleoperated):
    """Ranges of 2549, 2303, 2205, 2287 and 3835 counts: whole numbers, as they were calibrated."""
    found = read_lerobot(teleoperated, load_robot("so101"))

    assert "normalised (by the encoder steps" in found.source
    counts = np.array([2549, 2303, 2205, 2287, 3835])
    np.testing.assert_allclose(found.angles.high, counts / 2 * 360 / 4096, rtol=1e-6)


def test_a_real_data_set_is_read_whole(teleoperated):
    runs = read_runs(teleoperated, "so101", ReadOptions(lerobot=LeRobotAngles("deg")))

    seen = np.isfinite(runs["position"].values).all(axis=2).sum(axis=1)
    assert seen.tolist() == [373, 374, 372, 373]
    assert runs["run"].values[3] == "so101/episode_000003"
    np.testing.assert_allclose(runs["duration"], [12.4, 12.43, 12.37, 12.4], atol=0.011)


@pytest.mark.parametrize(
    "episodes", [[0], pytest.param([0, 1, 2, 3], marks=pytest.mark.slow)], ids=["one", "all"]
)
def test_a_real_teleoperated_arm_that_hardly_rests_is_not_blamed(teleoperated, episodes):
    """The healthy arm rests folded alone, its elbow told to go to the very end of its range."""
    runs = read_runs(teleoperated, "so101").isel(run=episodes)
    found = diagnose(runs, robot="so101")

    assert all(d.verdict.startswith("cannot tell yet") for d in found)
    assert max(p for d in found for name, p in d.posterior.items() if name != "healthy") < 0.65
