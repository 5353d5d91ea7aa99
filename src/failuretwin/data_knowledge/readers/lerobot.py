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
from failuretwin.data_knowledge.readers.column_map import check_entries, map_text
from failuretwin.data_knowledge.readers.timed_log import Samples, TimedLog
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pyarrow.parquet as pq

INFO_FILE = Path("meta") / "info.json"
ACTION, STATE, EPISODE, FRAME = "action", "observation.state", "episode_index", "frame_index"
COLUMNS = [ACTION, STATE, EPISODE, FRAME]
DEG, RAD, NORMALISED = "deg", "rad", "normalised"
NUMBER_BYTES = 40
"""Memory of a number of a list while it is read [bytes]."""
FULL_SCALE = 100.0
"""Ends of a normalised joint's range: -100 and 100."""
NAME_PREFIX, NAME_SUFFIX = "main_", ".pos"
"""Text that recorders put around the name of a joint: ``main_elbow_flex``, ``elbow_flex.pos``."""


@dataclass(frozen=True)
class LeRobotAngles:
    """Numbers of a LeRobot data set, commands and readings alike.

    Attributes:
        unit: deg, rad or normalised: -100 to 100 over the range that the arm was calibrated with.
        joints: Names of the channels in chain order; empty: those called like the robot's joints.
        low: For normalised numbers: angle of each motor at -100 [deg].
        high: Angle of each motor at 100 [deg].
        sign: 1 or -1 for each motor, where the data set turns the other way; empty: all 1.
        zero: Angle of each motor in the data set that the robot calls 0 [deg]; empty: all 0.
    """

    unit: str = DEG
    joints: tuple[str, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    sign: tuple[float, ...] = ()
    zero: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_name("unit", self.unit, (DEG, RAD, NORMALISED))
        if self.unit == NORMALISED and not (self.low and self.high):
            raise InputError(
                "normalised angles need low and high: the angles [deg] that -100 and 100 stand for."
            )

    def check_motors(self, robot: Robot, where: str) -> None:
        """Raise InputError unless every list has one entry for each motor."""
        for name in ("joints", "low", "high", "sign", "zero"):
            check_entries(name, len(getattr(self, name)) or len(robot.motors), robot, where)

    def to_rad(self, values: FloatArray) -> FloatArray:
        """Return angles in the robot's sense [rad] of `values` (frame, motor)."""
        angle = values if self.unit == RAD else np.deg2rad(values)
        if self.unit == NORMALISED:
            low, high = np.deg2rad(self.low), np.deg2rad(self.high)
            angle = low + (values + FULL_SCALE) / (2.0 * FULL_SCALE) * (high - low)
        return as_floats((angle - np.deg2rad(self.zero or 0.0)) * np.asarray(self.sign or 1.0))


def is_lerobot(path: Path) -> bool:
    """Return whether a path is the folder of a LeRobot data set."""
    return (path / INFO_FILE).is_file()


def read_lerobot(path: Path, robot: Robot, angles: LeRobotAngles | None = None) -> list[TimedLog]:
    """Read the episodes of a LeRobot data set, one log each.

    Args:
        path: Its folder.
        robot: The robot it is of; channels of joints that it does not have are left out.
        angles: Unit and sense of the numbers; None: degrees, unless they cannot be.

    Raises:
        InputError: If pyarrow is missing, the data set cannot be read, lacks a joint, or holds
            angles that cannot be degrees and no unit is given.
    """
    known, info = angles or LeRobotAngles(), _info(path)
    known.check_motors(robot, f"{path}: the map")
    frames = _all_frames(path, info, known, robot)
    unit, reason = _likely_unit(frames)
    if angles is None and unit != DEG:
        raise InputError(
            f"{path}: its angles are not degrees, it seems: {reason}. Say what they are: add "
            "--columns MAP.toml; if that file does not exist, a guess is written there for you to "
            "check."
        )
    rate = info.get("fps")
    if not (isinstance(rate, int | float) and rate > 0):
        raise InputError(f"{path / INFO_FILE}: fps is {rate!r}, expected frames a second.")
    numbers = np.unique(frames.episode)
    return [_episode(frames, int(number), float(rate), known, path) for number in numbers]


def lerobot_version(path: Path) -> str:
    """Return the version of the format that a data set says it has, such as ``v3.0``."""
    return str(_info(path).get("codebase_version", "of unknown version"))


@dataclass(frozen=True)
class _Frames:
    """Frames of all episodes: numbers (frame,), values as recorded (frame, motor)."""

    episode: IntArray
    frame: IntArray
    action: FloatArray
    state: FloatArray


def _info(path: Path) -> dict[str, Any]:
    with reading(path / INFO_FILE, "JSON"):
        info = json.loads(read_text(path / INFO_FILE, "JSON"))
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise InputError(f"{path / INFO_FILE}: has no features. Expected a LeRobot data set.")
    return info


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


def _likely_unit(frames: _Frames) -> tuple[str, str]:
    """Return the unit of the values, which the data set itself never says, and why."""
    values = np.concatenate([frames.action, frames.state])
    size = float(np.nanmax(np.abs(values)))
    if size == FULL_SCALE:
        return NORMALISED, "the largest is exactly 100, as where they are clipped to -100..100"
    if size <= 2.0 * np.pi:
        return RAD, f"none is larger than {size:.2f}"
    return DEG, ""


def _episode(
    frames: _Frames, number: int, rate_hz: float, known: LeRobotAngles, path: Path
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
        command=Samples(time, known.to_rad(action)),
        position=Samples(time, known.to_rad(state)),
    )


HINTS = """\
Channels of the data set: {channels}
Motors of {robot}, in this order: {motors}
unit is deg, rad, or normalised (-100 to 100, the older default).
joints = []   channels in the order of the motors, where names do not tell
For normalised numbers, low and high are what -100 and 100 stand for [deg], from the middle of each
joint's range. Here: the limits of the URDF. Better: range_min and range_max of the arm's own
calibration file; half their difference times 360/4096, below and above zero.
sign = []     1 or -1 for each motor, where the data set turns the other way
zero = []     angle of the data set that the robot calls 0 [deg]"""


def lerobot_map_text(path: Path, robot: Robot) -> str:
    """Return a commented map for a data set, ready to be corrected.

    The range of a normalised joint is that of the robot's URDF: recorders take that range by
    moving each joint from end to end by hand.
    """
    info = _info(path)
    unit, _ = _likely_unit(_all_frames(path, info, LeRobotAngles(), robot))
    hints = HINTS.format(
        channels=", ".join(channel_names(info, STATE)),
        robot=robot.name,
        motors=", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors),
    )
    content: dict[str, Any] = {"unit": unit}
    if unit == NORMALISED:
        limits = np.rad2deg([(joint.low, joint.high) for joint in robot.chain.joints])
        ends = np.clip(limits, -180.0, 180.0).round(1).T.tolist()
        content |= {"low": ends[0], "high": ends[1]}
    return map_text(f"Map for the LeRobot data set {path.name}", hints, {"lerobot": content})
