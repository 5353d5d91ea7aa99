"""LeRobot data sets from end to end: units, diagnosis, lives, corrected copies, live."""

from __future__ import annotations

import json
import re
import sys
import types
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.connection.joint_offsets import joint_offsets
from lerobot_writers import (
    NAMES,
    RANGES,
    V2,
    V3,
    in_unit,
    simulated_counts,
    write_calibration,
    write_episodes,
)

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: extra lerobot")
import pyarrow.parquet as pq  # noqa: E402

DEG_PER_COUNT = 360.0 / 4096.0
STATE = "observation.state"
ROOT = Path(__file__).parents[2]
SO101 = ("--robot", "so101", "--hypotheses", "healthy,motor_2:stuck")
"""Where what is offered does not matter: offsets are not found by the diagnosis."""


@pytest.fixture(scope="module")
def healthy():
    return simulated_counts()


@pytest.fixture(scope="module")
def so101():
    return ft.load_calibration(None, "so101")


def with_offset(episodes, motor, degrees):
    """Return episodes in which a motor, from 0, reads so much too high."""
    shift = np.zeros(6)
    shift[motor] = np.rint(degrees / DEG_PER_COUNT)
    return [(action, state + shift) for action, state in episodes]


def written(folder, episodes, unit="deg", version=V3, dtype="float32"):
    told = [tuple(in_unit(part, unit) for part in episode) for episode in episodes]
    return write_episodes(folder, told, version, dtype)


@pytest.mark.parametrize(
    ("unit", "dtype", "how"),
    [
        ("deg", "float32", "by the encoder steps of 0.08789"),
        ("rad", "float32", "by the encoder steps of 0.001534"),
        ("servo", "float32", "by the encoder steps of 1)"),
        ("servo", "int64", "whole numbers by their type"),
        ("normalised", "float32", "which differ from joint to joint; range by the encoder steps"),
    ],
)
def test_every_unit_is_found_from_the_data_set(tmp_path, healthy, unit, dtype, how):
    runs = ft.read_runs(written(tmp_path / "pick", healthy, unit, dtype=dtype), "so101")

    degrees = (healthy[0][1][:, :5] - 2048.0) * DEG_PER_COUNT
    position = np.rad2deg(runs["position"].values[0])
    seen = position[np.isfinite(position).all(axis=1)]
    np.testing.assert_allclose(seen, degrees[: len(seen)], atol=0.06)
    assert f"angles in {unit} (" in runs.attrs["source"]
    assert how in runs.attrs["source"]
    assert "guessed" not in runs.attrs["source"]


def test_the_older_recorder_knows_degrees_only(tmp_path, healthy):
    runs = ft.read_runs(written(tmp_path / "pick", healthy, version=V2), "so101")

    assert "angles in deg (names of a recorder that knows degrees only)" in runs.attrs["source"]


@pytest.mark.parametrize("named", [False, True])
def test_a_calibration_file_gives_the_ranges(failuretwin, tmp_path, healthy, named):
    coarse = [(np.round(a / 7) * 7, np.round(s / 7) * 7) for a, s in healthy]  # no single counts
    folder = written(tmp_path / "pick", coarse, "normalised")
    file = write_calibration((tmp_path if named else folder / "meta") / "follower.json", RANGES)
    map_file = ["--columns", tmp_path / "map.toml"]
    (tmp_path / "map.toml").write_text(
        f'[lerobot]\nunit = "normalised"\ncalibration = "{file.name}"\n'
        if named
        else '[lerobot]\nunit = "normalised"\n'
    )

    done = failuretwin("import", folder, "--robot", "so101", *map_file, "--out", tmp_path / "r.nc")

    assert done.returncode == 0, done.stderr
    runs = ft.read_runs(tmp_path / "r.nc", "so101")
    assert "range of follower.json" in runs.attrs["source"]
    position = np.rad2deg(runs["position"].values[0])
    seen = position[np.isfinite(position).all(axis=1)]
    degrees = (coarse[0][1][:, :5] - 2048.0) * DEG_PER_COUNT
    np.testing.assert_allclose(seen, degrees[: len(seen)], atol=0.06)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "no calibration of LeRobot. Expected for each joint range_min and range_max"),
        ('{"elbow": {"range_min": 1, "range_max": 2}}', "lacks a joint of 'so101'"),
        (None, "Expected counts, range_min the smaller one"),
    ],
)
def test_a_wrong_calibration_file_is_explained(failuretwin, tmp_path, healthy, content, message):
    folder, file = written(tmp_path / "pick", healthy), tmp_path / "arm.json"
    if content is None:
        write_calibration(file, [(9, 1)] * 6)
    else:
        file.write_text(content)

    done = failuretwin("diagnose", folder, "--robot", "so101", "--columns", file)

    assert done.returncode == 2
    assert message in done.stderr


def test_the_calibration_of_another_arm_is_refused(failuretwin, tmp_path, healthy):
    folder = written(tmp_path / "pick", healthy, "normalised")
    write_calibration(folder / "leader.json", [(low - 50, high + 50) for low, high in RANGES])

    done = failuretwin("diagnose", folder, "--robot", "so101")

    assert done.returncode == 2
    assert "Expected the calibration of the follower" in done.stderr


def test_two_calibration_files_are_ambiguous(failuretwin, tmp_path, healthy):
    folder = written(tmp_path / "pick", healthy)
    for name in ("leader.json", "follower.json"):
        write_calibration(folder / name, RANGES)

    done = failuretwin("diagnose", folder, "--robot", "so101")

    assert done.returncode == 2
    assert "2 calibration files: follower.json, leader.json" in done.stderr


def test_a_guess_is_said_and_one_option_settles_it(failuretwin, tmp_path, healthy):
    degrees = [tuple(in_unit(part, "deg") for part in episode) for episode in healthy]
    rough = [(action, state + 0.04 * np.sin(state)) for action, state in degrees]  # no counts
    folder = write_episodes(tmp_path / "pick", rough, V3)
    (tmp_path / "map.toml").write_text('[lerobot]\nunit = "deg"\n')

    guess = failuretwin("diagnose", folder, *SO101)
    told = failuretwin("diagnose", folder, *SO101, "--columns", tmp_path / "map.toml")

    assert guess.returncode == told.returncode == 0, guess.stderr + told.stderr
    assert re.search(r"note: LeRobot v3.0, angles in deg \(guessed: .*--columns", guess.stderr)
    assert "note" not in told.stderr
    assert "joint offsets: none found; 5 of 5 joints follow their commands" in told.stdout


def test_a_joint_that_does_not_follow_its_commands_is_named(failuretwin, tmp_path, healthy):
    frozen = [(action, np.array(state)) for action, state in healthy]
    for _, state in frozen:
        state[:, 4] = state[0, 4]
    told = failuretwin("diagnose", written(tmp_path / "pick", frozen), *SO101)
    assert "4 of 5 joints follow their commands and stop often enough" in told.stdout
    assert "not motor 5 (wrist roll)" in told.stdout


def test_episodes_are_diagnosed_alone_and_as_a_life(failuretwin, tmp_path):
    stuck = simulated_counts(4, seed=3, hypothesis="motor_2:stuck")
    folder = written(tmp_path / "pick", stuck)
    told = ("--json", tmp_path / "found.jsonl")

    alone = failuretwin("diagnose", folder, "--robot", "so101", *told)
    records = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    life = failuretwin(
        "diagnose", folder, *SO101, *told, "--track", "--out", tmp_path / "mine.toml"
    )

    assert alone.returncode == life.returncode == 0, alone.stderr + life.stderr
    assert [one["run"] for one in records] == [f"pick/episode_{k:06d}" for k in range(4)]
    assert sum(one["diagnosis"] == "motor_2:stuck" for one in records) >= 3
    assert "tracked: " in life.stdout
    assert (tmp_path / "mine.history.jsonl").read_text().count("\n") == 5  # a head, too
    assert "joint offset: motor 2" not in alone.stdout  # stuck, not displaced


# Offsets.


@pytest.mark.parametrize("degrees", [1.0, 2.0, 5.0, -5.0])
@pytest.mark.parametrize("motor", range(5))
def test_offsets_of_simulated_arms_lie_in_their_intervals(tmp_path, healthy, so101, motor, degrees):
    folder = written(tmp_path / "pick", with_offset(healthy, motor, degrees), "normalised")

    found = joint_offsets(ft.read_runs(folder, "so101"), so101.robot, so101.imperfections)

    low, high = np.rad2deg(found[motor].interval_90)
    assert low < degrees < high
    assert found[motor].found == (abs(degrees) == 5.0) or abs(degrees) == 2.0
    assert not any(one.found for one in found if one.motor != f"motor_{motor + 1}")


def test_simulated_healthy_arms_have_no_offset(tmp_path, so101):
    for seed in range(3):
        folder = written(tmp_path / f"pick_{seed}", simulated_counts(2, seed))

        found = joint_offsets(ft.read_runs(folder, "so101"), so101.robot, so101.imperfections)

        assert len(found) == 5
        assert not any(one.found for one in found)


def test_an_offset_that_begins_half_way_is_no_constant_one(tmp_path, healthy, so101):
    twice = [*healthy, *with_offset(healthy, 1, 6.0)]

    runs = ft.read_runs(written(tmp_path / "pick", twice), "so101")

    found = joint_offsets(runs, so101.robot, so101.imperfections)
    assert not any(one.found for one in found)


@pytest.fixture(scope="module")
def teleoperated(data):
    """Four episodes of a healthy SO-101, teleoperated."""
    folder = data / "so101"
    if not folder.is_dir():
        pytest.skip(f"no {folder}: the real SO-101 log is not part of the project")
    return folder


@pytest.fixture(scope="module")
def real_runs(teleoperated):
    return ft.read_runs(teleoperated, "so101")


def test_a_real_healthy_arm_has_no_offset(real_runs, so101):
    found = joint_offsets(real_runs, so101.robot, so101.imperfections)

    assert [one.stops for one in found] == [8, 8, 10, 10, 17]
    assert not any(one.found for one in found)


@pytest.mark.parametrize("degrees", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("motor", range(5))
def test_offsets_of_relabelled_real_logs_lie_in_their_intervals(real_runs, so101, motor, degrees):
    runs = real_runs.copy(deep=True)
    runs["position"][..., motor] += np.deg2rad(degrees)

    found = joint_offsets(runs, so101.robot, so101.imperfections)

    low, high = np.rad2deg(found[motor].interval_90)
    assert low < degrees < high
    if degrees == 5.0 and motor != 2:  # the elbow always bears its load: sag looks like an offset
        assert found[motor].found


# Corrected copies.


def tables(folder):
    return {
        str(file.relative_to(folder)): pq.read_table(file)
        for file in sorted((folder / "data").rglob("*.parquet"))
    }


def files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("version", "unit", "dtype"),
    [(V2, "deg", "float32"), (V3, "normalised", "float32"), (V3, "servo", "int64")],
)
def test_the_copy_differs_in_the_joint_that_is_displaced_alone(
    failuretwin, tmp_path, healthy, version, unit, dtype
):
    source = written(tmp_path / "pick", with_offset(healthy, 3, 5.0), unit, version, dtype)
    out = tmp_path / "fixed"

    done = failuretwin("diagnose", source, *SO101, "--correct", out)

    assert done.returncode == 0, done.stderr
    assert "joint offset: motor 4 (wrist flex) reads +" in done.stdout
    assert files(out) == files(source) | {"meta/correction.json"}
    for name in ("meta/info.json", "videos/front.mp4"):
        assert (out / name).read_bytes() == (source / name).read_bytes()
    note = json.loads((out / "meta" / "correction.json").read_text())[0]
    (joint,) = note["joints"]
    assert note["column"] == STATE
    assert joint["motor"] == "motor_4"
    assert joint["offset_90_deg"][0] < 5.0 < joint["offset_90_deg"][1]
    for name, before in tables(source).items():
        after = tables(out)[name]
        assert after.schema.equals(before.schema, check_metadata=True)
        assert after.drop_columns([STATE]).equals(before.drop_columns([STATE]))
        moved = np.stack(after[STATE].to_numpy()) - np.stack(before[STATE].to_numpy())
        expected = np.zeros(6)
        expected[3] = np.rint(joint["added"]) if dtype == "int64" else joint["added"]
        np.testing.assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=2e-5)

    again = failuretwin("diagnose", out, *SO101, "--correct", tmp_path / "more")

    assert again.returncode == 2
    assert "nothing to correct: no joint offset has a probability of 95 %" in again.stderr
    assert "joint offset" not in again.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fixed", "pick"]


@pytest.mark.parametrize("version", [V2, V3])
def test_statistics_move_along(failuretwin, tmp_path, healthy, version):
    source = written(tmp_path / "pick", with_offset(healthy, 0, -5.0), version=version)
    out = tmp_path / "fixed"

    assert failuretwin("diagnose", source, *SO101, "--correct", out).returncode == 0

    state = [np.stack(table[STATE].to_numpy()) for table in tables(out).values()]
    whole = json.loads((out / "meta" / "stats.json").read_text())
    assert whole["timestamp"] == {"min": [0.0]}
    for kind in ("min", "max", "mean", "std"):
        expected = getattr(np.concatenate(state).astype(float), kind)(axis=0)
        np.testing.assert_allclose(whole[STATE][kind], expected, atol=1e-4)
    if version == V2:
        lines = (out / "meta" / "episodes_stats.jsonl").read_text().splitlines()
        highest = [json.loads(line)["stats"][STATE]["max"] for line in lines]
    else:
        told = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
        highest = told[f"stats/{STATE}/max"].to_pylist()
        state = np.split(state[0], len(highest))
    np.testing.assert_allclose(highest, [one.max(axis=0) for one in state], atol=1e-4)


def test_a_stuck_motor_is_not_corrected(failuretwin, tmp_path):
    source = written(tmp_path / "pick", simulated_counts(3, 3, "motor_2:stuck"))

    done = failuretwin("diagnose", source, *SO101, "--correct", tmp_path / "fixed")

    assert done.returncode == 2
    assert "nothing to correct" in done.stderr
    assert not (tmp_path / "fixed").exists()


def test_wrong_calls_are_refused_before_any_work(failuretwin, tmp_path, healthy):
    source = written(tmp_path / "pick", healthy)
    (tmp_path / "there").mkdir()
    for logs, out, message in (
        ([source], tmp_path / "there", "exists already. Expected a new folder"),
        ([source], source / "fixed", "Expected a folder outside of the data set"),
        ([ft.sample_log()], tmp_path / "new", "is no LeRobot data set. Expected a folder with"),
        ([source, source], tmp_path / "new", "2 logs given, expected one LeRobot data set"),
    ):
        done = failuretwin("diagnose", *logs, "--robot", "so101", "--correct", out)

        assert done.returncode == 2
        assert message in done.stderr
        assert not done.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pick", "there"]
    assert not list((tmp_path / "there").iterdir())


def test_a_full_disk_leaves_nothing_behind(failuretwin, tmp_path, healthy):
    source = written(tmp_path / "pick", with_offset(healthy, 3, 5.0))

    done = failuretwin("diagnose", source, *SO101, "--correct", tmp_path / "fixed", disk_full=True)

    assert done.returncode == 2
    assert [p.name for p in tmp_path.iterdir()] == ["pick"]


def test_a_real_log_is_corrected_and_read_again(failuretwin, tmp_path, teleoperated, so101):
    from failuretwin.data_knowledge.readers.lerobot import write_shifted

    shift = np.zeros(6)
    shift[3] = 5.0  # about 5 deg of a range of 201
    write_shifted(teleoperated, tmp_path / "off", shift, {"made": "by hand"})

    done = failuretwin("diagnose", tmp_path / "off", *SO101, "--correct", tmp_path / "fixed")

    assert done.returncode == 0, done.stderr
    notes = json.loads((tmp_path / "fixed" / "meta" / "correction.json").read_text())
    low, high = notes[1]["joints"][0]["offset_90_deg"]
    assert low < 5.025 < high
    before, after = tables(teleoperated), tables(tmp_path / "fixed")
    assert after.keys() == before.keys()
    left = joint_offsets(
        ft.read_runs(tmp_path / "fixed", "so101"), so101.robot, so101.imperfections
    )
    assert not any(one.found for one in left)


# Live.


@pytest.fixture
def source_file(tmp_path, monkeypatch):
    """The source of the tutorial, as a module of the working folder."""
    page = (ROOT / "docs" / "tutorials" / "live.md").read_text("utf-8")
    code = re.search(r"Save this as `my_so101.py`:\n\n```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "my_so101.py").write_text(code[1])
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_so101", raising=False)
    return tmp_path


def test_the_source_of_the_tutorial_watches_a_real_log(failuretwin, source_file, teleoperated):
    done = failuretwin(
        *("watch", f"my_so101:So101:{teleoperated}", "--robot", "so101", "--speed", 0),
        folder=source_file,
    )

    assert done.returncode == 0, done.stderr
    assert "last answer: OK: healthy" in done.stdout


def test_the_source_of_the_tutorial_teleoperates(source_file, healthy, so101, monkeypatch):
    action, state = (in_unit(part, "deg") for part in healthy[0])
    sent = []

    def played(rows):
        left = iter(rows)
        return lambda self: dict(zip([f"{n}.pos" for n in NAMES], next(left), strict=True))

    def send(self, values):
        sent.append(values)
        return values

    both = {"connect": lambda self: None, "__init__": lambda self, config: None}
    leader = type("SO101Leader", (), both | {"get_action": played(action)})
    follower = type(
        "SO101Follower", (), both | {"get_observation": played(state), "send_action": send}
    )
    for module, kind in (
        ("robots.so101_follower", follower),
        ("teleoperators.so101_leader", leader),
    ):
        fake = types.ModuleType(f"lerobot.{module}")
        setattr(fake, kind.__name__, kind)
        setattr(fake, f"{kind.__name__}Config", lambda port, use_degrees: port)
        monkeypatch.setitem(sys.modules, fake.__name__, fake)
    import my_so101

    with my_so101.So101(so101.robot, "leader,follower") as source:
        events = [source.poll(0.1) for _ in range(20)]

    assert len(sent) == 10
    assert source.counts.received == 20
    commands, readings = events[::2], events[1::2]
    np.testing.assert_allclose([c.target for c in commands], np.deg2rad(action[:10, :5]))
    np.testing.assert_allclose([r.position for r in readings], np.deg2rad(state[:10, :5]))
    assert all(one.time <= two.time for one, two in pairwise(events))
