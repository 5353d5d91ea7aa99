"""Runs to begin with: a log that comes with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def sample_log() -> Path:
    """Return the path of a CSV file with three runs of an ArmPi FPV: healthy, stuck, off target.

    Simulated with the physics engine and the imperfections of the bundled calibration (lost
    commands, late starts, sag, scatter). Tool position at 10 Hz. Commands in rad, positions in m in
    the base frame. Run 1 is run 160 of 250 healthy ones of seed 13.
    """
    return Path(str(files("failuretwin.data_knowledge") / "samples" / "armpi_fpv.csv"))
