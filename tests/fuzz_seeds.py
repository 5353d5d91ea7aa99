"""Sound little files of every kind that is read, and who reads them: what a fuzzer starts from."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from bag_writers import JOINT_STATE, MONITORING, POINT, TRAJECTORY, entry, time_of, write_bag
from failuretwin import load_robot, read_runs
from failuretwin.connection.links.ros_messages import load_topics
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.hypothesis import parse_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.column_map import read_column_map
from failuretwin.data_knowledge.readers.lerobot_units import LeRobotAngles
from failuretwin.data_knowledge.readers.matlab import export_runs
from failuretwin.data_knowledge.readers.read import ReadOptions
from failuretwin.data_knowledge.step_tests import read_step_test
from failuretwin.data_knowledge.store import save_run_set
from failuretwin.decision.results import read_results
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections, Schedule
from failuretwin.digital_model.robot import bundled_folder
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.digital_model.urdf.check import check_urdf
from failuretwin.failure_behavior.registry import load_modes


@dataclass(frozen=True)
class Seed:
    """A kind of file.

    Attributes:
        make: Writes a sound one into a folder and returns its path.
        read: Reads it as a user's command would.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], Any]


ARMPI, UR5E, SO101 = (load_robot(name) for name in ("armpi_fpv", "ur5e", "so101"))
TIME = np.arange(0.0, 4.0, 0.02)
SESSION = ("trajectory_monitoring_cmd", "trajectory_monitoring_cmd_duration")
LOG_COLUMNS = [f"motor_{k}" for k in range(6, 2, -1)]


def runs_of_two():
    hypotheses = parse_hypotheses(["healthy", "motor_2:stuck"], ARMPI.motor_names)
    whole = Imperfections("whole", "counts", schedule=Schedule(whole_counts=True))
    return simulate(Plan(ARMPI, hypotheses, 1, 3, whole))


def as_runs(path, robot=ARMPI, **options):
    return read_runs(path, robot, ReadOptions(**options))


def session(folder):
    folder = folder / "session"
    folder.mkdir()
    rng = np.random.default_rng(0)
    targets = rng.integers(300, 700, (5, 6)).astype(float)
    start, at = 2.0 * np.arange(5), np.arange(-0.55, 10.0, 0.1)
    knots = np.stack([start, start + 0.8], axis=1).ravel()
    values = np.repeat(np.vstack([[500.0] * 6, targets]), 2, axis=0)[1:-1]
    readings = np.stack([np.interp(at, knots, v) for v in values.T], axis=-1).round()
    tables = {
        "trajectory_monitoring_cmd": (start, targets),
        "trajectory_monitoring_cmd_duration": (start, np.full((5, 6), 800.0)),
        "trajectory_monitoring_position": (at, readings),
    }
    for name, (time, rows) in tables.items():
        lines = ["timestamp,motor_1,motor_2,motor_3,motor_4,motor_5,motor_6"]
        lines += [",".join(map(str, [t + 1.7e9, *r])) for t, r in zip(time, rows, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def path_and_command(count=4):
    command = 0.3 * np.sin(0.8 * TIME)[:, None] * np.ones(count)
    return DigitalTwin(ARMPI).path(command), command


def csv(folder, unit="rad"):
    path_m, command = path_and_command()
    names = ["time_s", *(f"command_motor_{k}_{unit}" for k in range(1, 5))]
    names += ["tool_x_m", "tool_y_m", "tool_z_m"]
    rows = np.column_stack([TIME, command, path_m])
    lines = [",".join(names), *(",".join(f"{v:.6f}" for v in row) for row in rows)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder / "log.csv"


def rtde(folder):
    names = ["timestamp", *(f"{w}_q_{k}" for w in ("target", "actual") for k in range(6))]
    names += [f"actual_TCP_pose_{k}" for k in range(6)]
    tail = "-0.8172 -0.2329 0.0628 1.5708 0 0"
    rows = [f"{1000 + 0.02 * k:.3f} {'0 ' * 12}{tail}" for k in range(60)]
    (folder / "robot.txt").write_text("\n".join([" ".join(names), *rows]) + "\n")
    return folder / "robot.txt"


def run_set(suffix):
    def make(folder):
        save_run_set(runs_of_two(), folder / f"runs{suffix}")
        return folder / f"runs{suffix}"

    return make


def matlab_pair(folder):
    export_runs(runs_of_two().isel(run=[0]), folder / "pairs", DigitalTwin(ARMPI))
    return next((folder / "pairs").iterdir())


def matlab_cells(folder):
    export_runs(runs_of_two().isel(run=[0]), folder / "cells.mat", DigitalTwin(ARMPI))
    return folder / "cells.mat"


def bag_entries():
    """Return commands, readings and tool positions of two messages a second."""
    zero, items = 1_700_000_000 * 10**9, []
    for k in range(8):
        stamp = zero + k * 5 * 10**8
        counts = [500.0 + 20.0 * k] * 4
        items += [
            entry("/commands", MONITORING, stamp, name=LOG_COLUMNS, position=counts,
                  temperature=[400.0] * 4, voltage=[0.0] * 4),
            entry("/tool", POINT, stamp + 10**7, point={"x": 0.01 * k, "y": 0.0, "z": 0.3}),
        ]  # fmt: skip
    return items


def trajectory_entries():
    zero, items = 1_700_000_000 * 10**9, []
    names = [motor.joint for motor in ARMPI.motors]
    for k in range(8):
        stamp = zero + k * 5 * 10**8
        point = {"positions": [0.05 * k] * 4, "time_from_start": time_of(4 * 10**8)}
        items += [
            entry("/arm", TRAJECTORY, stamp, joint_names=names, points=[point]),
            entry("/joint_states", JOINT_STATE, stamp + 10**7, name=names, position=[0.05 * k] * 4),
        ]
    return items


def bag(form, entries=bag_entries):
    return lambda folder: write_bag(folder, form, entries())


def lerobot(folder):
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder = folder / "pick"
    names = [f"{n}.pos" for n in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex")]
    names += ["wrist_roll.pos", "gripper.pos"]
    feature = {"dtype": "float32", "shape": [6], "names": names}
    info = {"codebase_version": "v3.0", "fps": 30}
    info |= {"features": {"action": feature, "observation.state": feature}}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rows = np.outer(np.linspace(0.0, 1.0, 60), [20.0, -30.0, 25.0, 10.0, 5.0, 50.0])
    vector = pa.list_(pa.float32(), 6)
    columns = {
        "action": pa.array(rows.tolist(), vector),
        "observation.state": pa.array(rows.tolist(), vector),
        "frame_index": pa.array(range(60)),
        "episode_index": pa.array([0] * 60),
    }
    (folder / "data").mkdir()
    pq.write_table(pa.table(columns), folder / "data" / "file-000.parquet")
    return folder


def profile(folder):
    for name in ("armpi_fpv.toml", "armpi_fpv.urdf"):
        (folder / name).write_bytes((bundled_folder() / name).read_bytes())
    table = tomllib.loads((folder / "armpi_fpv.toml").read_text())
    table = {k: v for k, v in table.items() if k not in ("imperfections", "physics")}
    (folder / "armpi_fpv.toml").write_text(tomli_w.dumps(table))
    return folder / "armpi_fpv.toml"


def use_profile(path):
    robot = load_robot(path)
    twin = DigitalTwin(robot)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    twin.path(twin.respond(np.linspace(low, high, 50), 0.02 * np.arange(50)))
    load_calibration(None, robot)
    return robot


def urdf(folder):
    (folder / "arm.urdf").write_bytes((bundled_folder() / "ur5e.urdf").read_bytes())
    return folder / "arm.urdf"


def calibration(folder):
    source = ARMPI.imperfections_file
    (folder / "cal.toml").write_text(tomli_w.dumps(tomllib.loads(source.read_text())))
    return folder / "cal.toml"


def use_calibration(path):
    known = load_calibration(path, ARMPI)
    hypotheses = parse_hypotheses(["healthy"], ARMPI.motor_names)
    return simulate(Plan(known.robot, hypotheses, 1, 0, known.imperfections))


def text(name, content):
    def make(folder):
        (folder / name).write_text(content)
        return folder / name

    return make


COLUMN_MAP = """\
separator = ","
[time]
column = "time_s"
[command]
columns = ["a", "b", "c", "d"]
kind = "target"
unit = "deg"
duration_s = 0.8
sign = [1, 1, -1, 1]
[tool]
columns = ["x", "y", "z"]
unit = "mm"
"""
RESULT = {
    "run": "run_1",
    "truth": "healthy",
    "diagnosis": "motor_1:stuck",
    "probability": 0.7,
    "posterior": {"healthy": 0.3, "motor_1:stuck": 0.7},
    "onset_s": 0.5,
    "onset_90": [0.1, 0.9],
    "magnitude": -0.2,
    "magnitude_unit": "rad",
    "verdict": "motor 1 stuck",
}
RESULTS = "".join(json.dumps(RESULT | {"run": f"run_{k}"}) + "\n" for k in range(5))
MODES = """\
# How faults come about, for the fuzzer.
[stuck]
onset_s = [0.5, 2.0]
[drift]
magnitude = [0.01, 0.05]
onset_s = [0.0, 5.0]
profiles = ['step']
"""
LEROBOT_MAP = "unit = 'normalised'\nlow = [-90, -90, -90, -90, -90]\nhigh = [90, 90, 90, 90, 90]\n"
ROS_TOPICS = 'command = "/arm"\ncommand_type = "trajectory_msgs/JointTrajectory"\n'


def step_test(folder):
    from step_writers import step_rows, write_step_test

    loop = ARMPI.motors[0].loop
    rows = step_rows(np.random.default_rng(0), (loop.P, loop.I, loop.filter_s, 5.0), [50], 0.05)
    write_step_test(folder / "step.csv", rows)
    return folder / "step.csv"


def network(folder):
    from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser
    from failuretwin.decision.learned.moment_encoder import MomentEncoder
    from failuretwin.decision.learned.storage import save_network

    encoder = MomentEncoder(ARMPI, NO_IMPERFECTIONS)
    hypotheses = parse_hypotheses(["healthy", "motor_1:stuck"], ARMPI.motor_names)
    diagnoser = MotorwiseDiagnoser(encoder, iterations=1, random_state=1)
    diagnoser.fit(simulate(Plan(ARMPI, hypotheses, 4, 2)))
    save_network(diagnoser, folder / "network.npz")
    return folder / "network.npz"


def read_network(path):
    from failuretwin.decision.learned.storage import load_network

    return load_network(path, ARMPI)


def table_of(cls):
    return lambda path: from_table(cls, read_toml(path), str(path))


SEEDS: dict[str, Seed] = {
    "session": Seed(session, as_runs),
    "csv": Seed(csv, as_runs),
    "rtde": Seed(rtde, lambda path: as_runs(path, UR5E)),
    "netcdf": Seed(run_set(".nc"), as_runs),
    "zarr": Seed(run_set(".zarr"), as_runs),
    "matlab pair": Seed(matlab_pair, as_runs),
    "matlab cells": Seed(matlab_cells, as_runs),
    "ros1": Seed(bag("ros1"), as_runs),
    "ros2": Seed(bag("ros2"), as_runs),
    "mcap": Seed(bag("mcap"), as_runs),
    "trajectories": Seed(bag("mcap", trajectory_entries), as_runs),
    "profile": Seed(profile, use_profile),
    "urdf": Seed(urdf, check_urdf),
    "calibration": Seed(calibration, use_calibration),
    "column map": Seed(text("map.toml", COLUMN_MAP), lambda path: read_column_map(path, ARMPI)),
    "bag map": Seed(text("map.toml", "command = '/a'\ntool = '/b'\n"), table_of(BagTopics)),
    "lerobot map": Seed(text("map.toml", LEROBOT_MAP), table_of(LeRobotAngles)),
    "topics": Seed(text("topics.toml", ROS_TOPICS), load_topics),
    "modes": Seed(text("modes.toml", MODES), load_modes),
    "results": Seed(text("results.jsonl", RESULTS), read_results),
    "step test": Seed(step_test, lambda path: read_step_test(path, ARMPI)),
}
if find_spec("pyarrow"):
    SEEDS["lerobot"] = Seed(lerobot, lambda path: as_runs(path, SO101))
if find_spec("torch") and find_spec("sklearn"):
    SEEDS["network"] = Seed(network, read_network)
