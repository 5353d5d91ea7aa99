"""All that a calibration file holds, also what only people read."""

from __future__ import annotations

from dataclasses import replace

from failuretwin.connection.calibration.result import ORIGIN, Calibration
from failuretwin.core.config import from_table, read_toml
from failuretwin.digital_model.calibrated_robot import CALIBRATION_TABLE, load_calibration


def read_calibration(path, robot):
    """Return what `save_calibration` wrote."""
    imperfections = load_calibration(path, robot).imperfections
    table = read_toml(path)
    record = table.pop(CALIBRATION_TABLE)
    told = {name: value for name, value in record.items() if name not in ORIGIN}
    found = from_table(Calibration, {**told, "imperfections": table}, str(path))
    return replace(found, imperfections=imperfections)
