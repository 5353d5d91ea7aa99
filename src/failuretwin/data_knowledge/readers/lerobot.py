"""LeRobot data sets (v2.1 and v3): commands and readings of the motors, frame by frame.

A data set is a folder with ``meta/info.json`` and parquet files below ``data/``: one for each
episode (v2.1) or several episodes in each (v3); a column ``episode_index`` tells them apart in
both. ``action`` holds the commands, ``observation.state`` the readings. The tool path is the
forward kinematics of the readings.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError, check_name, needs_extra
from failuretwin.core.foreign import check_size, read_text, reading
from failuretwin.core.types import FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.readers.column_map import map_text
from failuretwin.data_knowledge.readers.lerobot_units import (
    FULL_SCALE,
    NAME_PREFIX,
    NAME_SUFFIX,
    NORMALISED,
    LeRobotAngles,
    found_angles,
)
from failuretwin.data_knowledge.readers.timed_log import Samples, TimedLog
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pyarrow.parquet as pq

INFO_FILE = Path("meta") / "info.json"
ACTION, STATE, EPISODE, FRAME = "action", "observation.state", "episode_index", "frame_index"
COLUMNS = [ACTION, STATE, EPISODE, FRAME]
NUMBER_BYTES = 40
"""Memory of a number of a list while it is read [bytes]."""


def is_lerobot(path: Path) -> bool:
    """Return whether a path is the folder of a LeRobot data set."""
    return (path / INFO_FILE).is_file()


@dataclass(frozen=True)
class LeRobotEpisodes:
    """Episodes of a LeRobot data set.

    Attributes:
        logs: One log for each episode.
        angles: Meaning of its numbers, complete.
        source: Version, unit and how the unit is known, in words.
    """

    logs: list[TimedLog]
    angles: LeRobotAngles
    source: str


def read_lerobot(path: Path, robot: Robot, angles: LeRobotAngles | None = None) -> LeRobotEpisodes:
    """Read the episodes of a LeRobot data set, one log each.

    Args:
        path: Its folder.
        robot: The robot it is of; channels of joints that it does not have are left out.
        angles: What is known of the unit and sense of the numbers; None: nothing.

    Raises:
        InputError: If pyarrow is missing, or the data set cannot be read or lacks a joint.
    """
    known, info = angles or LeRobotAngles(), lerobot_info(path)
    known.check_motors(robot, f"{path}: the map")
    rate = info.get("fps")
    if not (isinstance(rate, int | float) and rate > 0):
        raise InputError(f"{path / INFO_FILE}: fps is {rate!r}, expected frames a second.")
    frames = _all_frames(path, info, known, robot)
    named = channel_names(info, STATE)
    names = [named[i] for i in state_channels(path, info, known, robot)]
    found, how = found_angles(info, names, frames.state, path, robot, known)
    version = info.get("codebase_version", "of unknown version")
    numbers = np.unique(frames.episode)
    logs = [_episode(frames, int(n), float(rate), found, path, robot) for n in numbers]
    return LeRobotEpisodes(logs, found, f"LeRobot {version}, angles in {found.unit} ({how})")


@dataclass(frozen=True)
class _Frames:
    """Frames of all episodes: numbers (frame,), values as recorded (frame, motor)."""

    episode: IntArray
    frame: IntArray
    action: FloatArray
    state: FloatArray


def lerobot_info(path: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of a data set.

    Raises:
        InputError: If it cannot be read or describes no features.
    """
    with reading(path / INFO_FILE, "JSON"):
        info = json.loads(read_text(path / INFO_FILE, "JSON"))
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise InputError(f"{path / INFO_FILE}: has no features. Expected a LeRobot data set.")
    return info


def state_channels(
    path: Path, info: Mapping[str, Any], known: LeRobotAngles, robot: Robot
) -> list[int]:
    """Return which channel of ``observation.state`` belongs to each motor."""
    return _channels(info, STATE, known, robot, path)


def _channels(
    info: Mapping[str, Any], feature: str, known: LeRobotAngles, robot: Robot, path: Path
) -> list[int]:
    """Return which channel of a feature belongs to each motor."""
    names = channel_names(info, feature)
    if not names:
        raise InputError(
            f"{path}: {INFO_FILE} names no channels of {feature!r}. Expected one for each joint."
        )
    plain = [name.removesuffix(NAME_SUFFIX).removeprefix(NAME_PREFIX) for name in names]
    found = []
    for wanted in known.joints or [motor.joint for motor in robot.motors]:
        hits = [i for i, both in enumerate(zip(names, plain, strict=True)) if wanted in both]
        if len(hits) != 1:
            how_often = "no channel" if not hits else f"{len(hits)} channels"
            raise InputError(
                f"{path}: {feature!r} has {how_often} called {wanted!r}. It has: "
                f"{', '.join(names)}. Name those of {', '.join(robot.motor_names)} in this order "
                "as joints in the [lerobot] table of a map (--columns)."
            )
        found += hits
    return found


def channel_names(info: Mapping[str, Any], feature: str) -> list[str]:
    """Return the names of a feature's channels; older data sets keep them as ``{"motors": []}``."""
    entry = info["features"].get(feature)
    names = entry.get("names") if isinstance(entry, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _all_frames(path: Path, info: Mapping[str, Any], known: LeRobotAngles, robot: Robot) -> _Frames:
    """Return all frames in order of their episodes and their numbers."""
    with needs_extra("LeRobot data sets need pyarrow", "lerobot"):
        import pyarrow.parquet as pq

    action, state = (_channels(info, feature, known, robot, path) for feature in (ACTION, STATE))
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(
            f"{path}: no parquet files below data/. Fetch the whole data set, not its meta alone."
        )
    fix = f"Expected a number for each channel in {INFO_FILE}. Fetch the data set again."
    with reading(path / "data", "parquet", fix):
        metadata = [pq.read_metadata(file) for file in files]
        claims = sum(_claimed_bytes(one, len(robot.motors)) for one in metadata)
        check_size(claims, path / "data", "its numbers")
        for column in COLUMNS:
            check_name(
                "column", column, metadata[0].schema.to_arrow_schema().names, f"{files[0]}: "
            )
        table = pq.read_table(files, columns=COLUMNS)
        table = table.sort_by([(EPISODE, "ascending"), (FRAME, "ascending")])
        if len(table) == 0:
            raise InputError(f"{path}: holds no frames. Record at least one episode.")
        return _Frames(
            episode=np.asarray(table[EPISODE], dtype=np.int64),
            frame=np.asarray(table[FRAME], dtype=np.int64),
            action=as_floats(np.stack(table[ACTION].to_numpy())[:, action]),
            state=as_floats(np.stack(table[STATE].to_numpy())[:, state]),
        )


def _claimed_bytes(said: pq.FileMetaData, motors: int) -> int:
    """Return the memory of the numbers that a parquet file says to hold [bytes]."""
    groups = [said.row_group(i) for i in range(said.num_row_groups)]
    values = sum(g.column(i).num_values for g in groups for i in range(g.num_columns))
    return NUMBER_BYTES * max(values, said.num_rows * motors)


def _episode(
    frames: _Frames, number: int, rate_hz: float, known: LeRobotAngles, path: Path, robot: Robot
) -> TimedLog:
    """Return one episode, without the readings of frames whose command is at the end of its range.

    Normalised commands are clipped there, and where such a motor rests is up to its end stop, or to
    the arm folded upon itself, and not to its servo.
    """
    rows = frames.episode == number
    time = as_floats((frames.frame[rows] - frames.frame[rows][0]) / rate_hz)
    action, state = frames.action[rows], frames.state[rows]
    if known.unit == NORMALISED:
        free = np.all(np.abs(action) < FULL_SCALE, axis=1, keepdims=True)
        state = np.where(free, state, np.nan)
    return TimedLog(
        name=f"{path.resolve().name}/episode_{number:06d}",
        command=Samples(time, known.to_rad(action, robot)),
        position=Samples(time, known.to_rad(state, robot)),
    )


HINTS = """\
Channels of the data set: {channels}
Motors of {robot}, in this order: {motors}
unit is deg, rad, servo (encoder counts), or normalised (-100 to 100). Here: {source}
joints = []   channels in the order of the motors, where names do not tell
For normalised numbers, low and high are what -100 and 100 stand for [deg], from the middle of each
joint's range; calibration = "FILE.json" takes them from the arm's own calibration file instead.
sign = []     1 or -1 for each motor, where the data set turns the other way
zero = []     angle of the data set that the robot calls 0 [deg]"""


def lerobot_map_text(path: Path, robot: Robot) -> str:
    """Return a commented map for a data set, ready to be corrected."""
    found = read_lerobot(path, robot)
    hints = HINTS.format(
        channels=", ".join(channel_names(lerobot_info(path), STATE)),
        robot=robot.name,
        motors=", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors),
        source=found.source,
    )
    angles = found.angles
    content: dict[str, Any] = {"unit": angles.unit, "low": angles.low, "high": angles.high}
    return map_text(f"Map for the LeRobot data set {path.name}", hints, {"lerobot": content})
