"""Runs to begin with: a log that comes with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def sample_log() -> Path:
    """Return the path of a CSV of three runs of an ArmPi FPV, one of them healthy.

    They are simulated: physics engine, with the imperfections that the bundled calibration of the
    real arm states (lost commands, late starts, sag, scatter); tool position at 10 Hz. Commands in
    rad, positions in m in the base frame.
    """
    return Path(str(files("failuretwin.data_knowledge") / "samples" / "armpi_fpv.csv"))
