"""Calibrations as TOML files: the imperfections, which the twin reads, and how they were found."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from failuretwin import __version__
from failuretwin.connection.calibration.calibration import (
    Calibration,
    HeldOut,
    LeftOut,
    LoopFit,
    Parameter,
)
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import check_writable, replacing
from failuretwin.digital_model.imperfections import CALIBRATION_TABLE, load_imperfections
from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class _Record:
    """The table beside the imperfections: how they were found."""

    robot: str
    failuretwin_version: str
    sessions: tuple[str, ...]
    runs: int
    movements: int
    used_readings: bool
    parameters: tuple[Parameter, ...]
    left_out: tuple[LeftOut, ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    remarks: tuple[str, ...] = ()
    loops: tuple[LoopFit, ...] = ()


def save_calibration(calibration: Calibration, robot: Robot, path: Path) -> None:
    """Write a calibration; a file of that name is replaced at the end, all at once.

    Raises:
        OutputError: If it cannot be written; the old file is as before.
    """
    import tomli_w

    record = _Record(
        robot=robot.name,
        failuretwin_version=__version__,
        sessions=calibration.sessions,
        runs=calibration.runs,
        movements=calibration.movements,
        used_readings=calibration.used_readings,
        parameters=calibration.parameters,
        left_out=calibration.left_out,
        held_out=calibration.held_out,
        remarks=calibration.remarks,
        loops=calibration.loops,
    )
    table = {**_plain(calibration.imperfections), CALIBRATION_TABLE: _plain(record)}
    text = (
        "# What a healthy robot does that the published twin does not, learned from its logs by\n"
        "# `failuretwin calibrate`. Angles in rad in the sense of the logs, times in s.\n"
        f"{tomli_w.dumps(table)}"
    )
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def check_calibration_file(path: Path) -> None:
    """Raise an error unless a calibration can be written to `path`: worth asking before work."""
    if path.suffix != ".toml":
        raise InputError(f"{path}: a calibration ends in .toml.")
    check_writable(path)


def load_calibration(path: Path, robot: Robot) -> Calibration:
    """Read what `save_calibration` wrote.

    Raises:
        InputError: If the file is no calibration, or one of another robot.
    """
    imperfections = load_imperfections(str(path), robot)
    table = read_toml(path).get(CALIBRATION_TABLE)
    if not isinstance(table, dict):
        raise InputError(
            f"{path}: holds imperfections without a calibration. Expected a file written by "
            "`failuretwin calibrate`."
        )
    record = from_table(_Record, table, f"{path}: {CALIBRATION_TABLE}")
    return Calibration(
        imperfections=imperfections,
        parameters=record.parameters,
        sessions=record.sessions,
        runs=record.runs,
        movements=record.movements,
        used_readings=record.used_readings,
        left_out=record.left_out,
        held_out=record.held_out,
        remarks=record.remarks,
        loops=record.loops,
    )


def _plain(value: Any) -> Any:
    """Return a dataclass as TOML values: no None, lists for tuples, numbers with few digits."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
        return {name: _plain(item) for name, item in named.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}")
    return value
