"""LeRobot data sets (v2.1 and v3): commands and readings of the motors, frame by frame.

A data set is a folder with ``meta/info.json`` and parquet files below ``data/``: one for each
episode (v2.1) or several episodes in each (v3); a column ``episode_index`` tells them apart in
both. ``action`` holds the commands, ``observation.state`` the readings. The tool path is the
forward kinematics of the readings.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError, check_name, needs_extra
from failuretwin.core.foreign import check_size, files_below, read_text, reading
from failuretwin.core.types import BoolArray, FloatArray, as_floats
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
from failuretwin.data_knowledge.store import filling
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

INFO_FILE = Path("meta") / "info.json"
ACTION, STATE, EPISODE, FRAME = "action", "observation.state", "episode_index", "frame_index"
COLUMNS = [ACTION, STATE, EPISODE, FRAME]
NUMBER_BYTES = 40
"""Memory of a number of a list while it is read [bytes]."""


def is_lerobot(path: Path) -> bool:
    """Return whether a path is the folder of a LeRobot data set."""
    return (path / INFO_FILE).is_file()


def find_lerobot(folder: Path) -> list[Path]:
    """Return the LeRobot data sets at or below a folder, in order of their names."""
    infos = sorted(files_below(folder, INFO_FILE.name))
    return [file.parents[1] for file in infos if file.parent.name == INFO_FILE.parent.name]


@dataclass(frozen=True)
class LeRobotEpisodes:
    """Episodes of a LeRobot data set.

    Attributes:
        logs: One log for each episode.
        angles: Meaning of its numbers, complete.
        source: Version, unit and how the unit is known, in words.
        channels: Names of all channels of ``observation.state``.
        channel_of: Index of the channel of each motor, (motor,).
    """

    logs: list[TimedLog]
    angles: LeRobotAngles
    source: str
    channels: list[str]
    channel_of: list[int]


def read_lerobot(path: Path, robot: Robot, angles: LeRobotAngles | None = None) -> LeRobotEpisodes:
    """Read the episodes of a LeRobot data set, a folder, one log each.

    Channels of joints that the robot does not have are left out.

    Raises:
        InputError: If pyarrow is missing, or the data set cannot be read or lacks a joint.
    """
    known, info = angles or LeRobotAngles(), _read_info(path)
    known.check_motors(robot, f"{path}: the map")
    rate = info.get("fps")
    if not (isinstance(rate, int | float) and rate > 0):
        raise InputError(f"{path / INFO_FILE}: fps is {rate!r}, expected frames a second.")
    wanted = known.joints or [motor.joint for motor in robot.motors]
    channel_of = {name: _channels(path, info, name, wanted, robot) for name in (ACTION, STATE)}
    frames = _all_frames(path, channel_of)
    channels = _channel_names(info, STATE)
    names = [channels[i] for i in channel_of[STATE]]
    found, how = found_angles(info, names, frames[STATE], path, robot, known)
    version = info.get("codebase_version", "of unknown version")
    return LeRobotEpisodes(
        [_episode(frames, n, float(rate), found, path, robot) for n in np.unique(frames[EPISODE])],
        found,
        f"LeRobot {version}, angles in {found.unit} ({how}){_left_out(frames[ACTION], found)}",
        channels,
        channel_of[STATE],
    )


def _read_info(path: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of a data set."""
    with reading(path / INFO_FILE, "JSON"):
        info = json.loads(read_text(path / INFO_FILE, "JSON"))
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise InputError(f"{path / INFO_FILE}: has no features. Expected a LeRobot data set.")
    return info


def _channels(
    path: Path, info: Mapping[str, Any], feature: str, wanted: Sequence[str], robot: Robot
) -> list[int]:
    """Return which channel of a feature belongs to each motor, by the names `wanted`."""
    names = _channel_names(info, feature)
    if not names:
        raise InputError(
            f"{path}: {INFO_FILE} names no channels of {feature!r}. Expected one for each joint."
        )
    plain = [name.removesuffix(NAME_SUFFIX).removeprefix(NAME_PREFIX) for name in names]
    found = []
    for joint in wanted:
        hits = [i for i, both in enumerate(zip(names, plain, strict=True)) if joint in both]
        if len(hits) != 1:
            how_often = "no channel" if not hits else f"{len(hits)} channels"
            raise InputError(
                f"{path}: {feature!r} has {how_often} called {joint!r}. It has: "
                f"{', '.join(names)}. Its robot is {info.get('robot_type', 'not named')}: choose "
                f"the profile with --robot, here {robot.name}. Or name the channels of "
                f"{', '.join(robot.motor_names)} in this order as joints in the [lerobot] table of "
                "a map (--columns)."
            )
        found += hits
    return found


def _channel_names(info: Mapping[str, Any], feature: str) -> list[str]:
    """Return the names of a feature's channels; older data sets keep them as ``{"motors": []}``."""
    entry = info["features"].get(feature)
    names = entry.get("names") if isinstance(entry, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _all_frames(path: Path, channel_of: Mapping[str, list[int]]) -> dict[str, FloatArray]:
    """Return the columns of all frames in order of their episodes and their numbers.

    Numbers are (frame,), values of the features (frame, motor), as recorded.
    """
    with needs_extra("LeRobot data sets need pyarrow", "lerobot"):
        import pyarrow.parquet as pq

    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(
            f"{path}: no parquet files below data/. Fetch the whole data set, not its meta alone."
        )
    fix = f"Expected a number for each channel in {INFO_FILE}. Fetch the data set again."
    with reading(path / "data", "parquet", fix):
        metadata = [pq.read_metadata(file) for file in files]
        claims = sum(_claimed_bytes(one, len(channel_of[STATE])) for one in metadata)
        check_size(claims, path / "data", "its numbers")
        present = metadata[0].schema.to_arrow_schema().names
        for column in COLUMNS:
            check_name("column", column, present, f"{files[0]}: ")
        table = pq.read_table(files, columns=COLUMNS)
        table = table.sort_by([(EPISODE, "ascending"), (FRAME, "ascending")])
        if len(table) == 0:
            raise InputError(f"{path}: holds no frames. Record at least one episode.")
        columns = {name: as_floats(table[name]) for name in (EPISODE, FRAME)}
        if not np.isfinite([*columns.values()]).all():
            raise InputError(
                f"{path}: {EPISODE} and {FRAME} have rows without a number. Expected the number of "
                "the episode and of the frame in each row. Fetch the data set again."
            )
        for name, channels in channel_of.items():
            columns[name] = as_floats(np.stack(table[name].to_numpy())[:, channels])
        return columns


def _claimed_bytes(said: pq.FileMetaData, motors: int) -> int:
    """Return the memory of the numbers that a parquet file says to hold [bytes]."""
    groups = [said.row_group(i) for i in range(said.num_row_groups)]
    values = sum(g.column(i).num_values for g in groups for i in range(g.num_columns))
    return NUMBER_BYTES * max(values, said.num_rows * motors)


def _episode(
    frames: Mapping[str, FloatArray],
    number: float,
    rate_hz: float,
    known: LeRobotAngles,
    path: Path,
    robot: Robot,
) -> TimedLog:
    """Return one episode, without the readings of frames whose command is at the end of its range.

    Normalised commands are clipped there, and where such a motor rests is up to its end stop, or to
    the arm folded upon itself, and not to its servo.
    """
    rows = frames[EPISODE] == number
    frame, action, state = (frames[name][rows] for name in (FRAME, ACTION, STATE))
    time = as_floats((frame - frame[0]) / rate_hz)
    state = np.where(_at_an_end(action, known)[:, None], np.nan, state)
    return TimedLog(
        name=f"{path.resolve().name}/episode_{int(number):06d}",
        command=Samples(time, known.to_rad(action, robot)),
        position=Samples(time, known.to_rad(state, robot)),
    )


CLIPPED = "without the readings of"
"""Said of a data set whose commands end at the ends of a range."""


def _at_an_end(action: FloatArray, known: LeRobotAngles) -> BoolArray:
    """Return the frames in which a normalised command is at an end of its range, (frame,)."""
    at_end = np.any(np.abs(action) >= FULL_SCALE, axis=1)
    return np.asarray(at_end & (known.unit == NORMALISED))


def _left_out(action: FloatArray, known: LeRobotAngles) -> str:
    """Return how many frames are not read, in words; empty: none."""
    count = int(_at_an_end(action, known).sum())
    if not count:
        return ""
    return f", {CLIPPED} {count} of {len(action)} frames: a command is clipped at -100 or 100"


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
        channels=", ".join(found.channels),
        robot=robot.name,
        motors=", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors),
        source=found.source,
    )
    angles = found.angles
    content: dict[str, Any] = {"unit": angles.unit, "low": angles.low, "high": angles.high}
    return map_text(f"Map for the LeRobot data set {path.name}", hints, {"lerobot": content})


# Corrected copies: the readings of some joints shifted, all else the same.

NOTE_FILE = Path("meta") / "correction.json"
"""Notes of all corrections, a list."""
UNSHIFTED = ("std", "count")
"""Statistics that do not move with a constant."""
Change = Callable[["pa.Table"], "pa.Table"]


def check_copy(source: Path, out: Path) -> None:
    """Raise InputError unless `source` is a LeRobot data set and `out` free and outside of it."""
    if not is_lerobot(source):
        raise InputError(
            f"{source}: is no LeRobot data set. Expected a folder with {INFO_FILE}; only such data "
            "are copied. Leave out --correct."
        )
    if out.exists() or out.is_symlink():
        raise InputError(f"{out}: exists already. Expected a new folder: name another.")
    if source.resolve() in out.resolve().parents:
        raise InputError(f"{out}: lies in {source}. Expected a folder outside of the data set.")


def write_shifted(source: Path, out: Path, shift: FloatArray, note: Mapping[str, Any]) -> None:
    """Copy a data set, with a constant added to each channel of ``observation.state``.

    Statistics of that column move along. All other files and columns stay, and types do.

    Args:
        source: Folder of the data set.
        out: Folder to write, whole or not at all.
        shift: What is added, in the unit of the data set, (channel,).
        note: Record of the correction, appended to ``meta/correction.json``.

    Raises:
        InputError: If `check_copy` refuses, or a file cannot be read.
        OutputError: If the copy cannot be written; nothing is left behind.
    """
    check_copy(source, out)
    with filling(out) as partial:
        for file in files_below(source, "*"):
            copied = partial / file.relative_to(source)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copied)
        for file in files_below(partial / "data", "*.parquet"):
            _rewrite(file, lambda table: _with_shifted(table, STATE, shift))
        for file in files_below(partial / "meta" / "episodes", "*.parquet"):
            _rewrite(file, lambda table: _with_shifted_statistics(table, shift))
        _rewrite_json(partial / "meta", shift)
        noted = partial / NOTE_FILE
        before = json.loads(read_text(noted, "JSON")) if noted.is_file() else []
        noted.write_text(json.dumps([*before, note], indent=4) + "\n", encoding="utf-8")


def _rewrite(file: Path, change: Change) -> None:
    """Change the tables of a parquet file, row group by row group."""
    import pyarrow.parquet as pq

    with reading(file, "parquet"), pq.ParquetFile(file) as old:
        partial, groups = file.with_suffix(".new"), old.metadata.num_row_groups
        codec = old.metadata.row_group(0).column(0).compression if groups else "SNAPPY"
        codec = "NONE" if codec == "UNCOMPRESSED" else codec
        with pq.ParquetWriter(partial, old.schema_arrow, compression=codec) as new:
            for group in range(groups):
                new.write_table(change(old.read_row_group(group)))
    partial.replace(file)


def _with_shifted(table: pa.Table, name: str, shift: FloatArray) -> pa.Table:
    """Return a table with `shift` added to a column of vectors, whose type stays."""
    import pyarrow as pa

    place, kind = table.schema.get_field_index(name), table.schema.field(name).type
    values = np.stack(table[name].to_numpy()) + shift
    if pa.types.is_integer(kind.value_type):
        values = np.rint(values)
    rows = values.astype(kind.value_type.to_pandas_dtype())
    return table.set_column(place, table.schema.field(name), pa.array(list(rows), type=kind))


def _with_shifted_statistics(table: pa.Table, shift: FloatArray) -> pa.Table:
    start = f"stats/{STATE}/"
    for name in table.column_names:
        if name.startswith(start) and name.removeprefix(start) not in UNSHIFTED:
            table = _with_shifted(table, name, shift)
    return table


def _rewrite_json(meta: Path, shift: FloatArray) -> None:
    """Shift the statistics of the whole set, and of each episode (v2.1)."""
    whole, episodes = meta / "stats.json", meta / "episodes_stats.jsonl"
    if whole.is_file():
        with reading(whole, "JSON"):
            stats = _shifted_statistics(json.loads(read_text(whole, "JSON")), shift)
        whole.write_text(json.dumps(stats, indent=4), encoding="utf-8")
    if episodes.is_file():
        with reading(episodes, "JSON lines"):
            rows = [json.loads(line) for line in read_text(episodes, "JSON lines").splitlines()]
            rows = [row | {"stats": _shifted_statistics(row["stats"], shift)} for row in rows]
        episodes.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def _shifted_statistics(stats: dict[str, Any], shift: FloatArray) -> dict[str, Any]:
    told = {
        name: value if name in UNSHIFTED else (np.asarray(value) + shift).tolist()
        for name, value in stats.get(STATE, {}).items()
    }
    return stats | ({STATE: told} if told else {})
