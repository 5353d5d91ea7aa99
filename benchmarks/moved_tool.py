"""Diagnosis of real runs whose tool path was moved after the fact: a frame that nobody registered.

    python benchmarks/moved_tool.py FOLDER [--robot armpi_fpv] [--size 5]

The runs are those of the folder, with the calibration that the robot's profile names; positions are
shifted, turned, scaled or made noisy. Judged each by itself, and in folders of so many random runs
that share one frame (`--self-calibrate --calibration FILE`). The truth is looked at afterwards.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation
from telling import nats, right

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.calibrated_robot import calibrated

SURE = 0.9


def shifted(by_m: tuple[float, float, float], point: FloatArray) -> FloatArray:
    """Return positions shifted [m]."""
    return point + np.array(by_m)


def turned(axis: str, degrees: float, point: FloatArray) -> FloatArray:
    """Return positions turned about an axis of the base."""
    return np.asarray(point @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix().T)


def scaled(factor: float, point: FloatArray) -> FloatArray:
    """Return positions multiplied."""
    return factor * point


def noisy(noise_m: float, point: FloatArray) -> FloatArray:
    """Return positions with white noise [m]."""
    return point + noise_m * np.random.default_rng(0).standard_normal(point.shape)


MOVES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "nothing": partial(scaled, 1.0),
    "z + 3 mm": partial(shifted, (0.0, 0.0, 0.003)),
    "z + 5 mm": partial(shifted, (0.0, 0.0, 0.005)),
    "z + 10 mm": partial(shifted, (0.0, 0.0, 0.01)),
    "turned 1 deg about y": partial(turned, "y", 1.0),
    "turned 3 deg about y": partial(turned, "y", 3.0),
    "turned 1 deg about z": partial(turned, "z", 1.0),
    "scale + 1 %": partial(scaled, 1.01),
    "scale + 3 %": partial(scaled, 1.03),
    "2 mm of noise": partial(noisy, 0.002),
}


def told(found: list[Diagnosis]) -> str:
    """Return right ones, log score, and healthy runs that are surely called faulty."""
    healthy = [d for d in found if d.truth == "healthy"]
    false = sum(
        d.diagnosis not in (None, "healthy") and float(d.probability or 0.0) > SURE for d in healthy
    )
    score = nats(found).mean()
    return f"{int(right(found).sum()):3d} of {len(found)}, {score:.3f} nats, {false} surely faulty"


def in_folders(robot: ft.Robot, runs: xr.Dataset, size: int) -> list[Diagnosis]:
    """Return the runs judged in folders of so many random ones."""
    order = np.random.default_rng(0).permutation(runs.sizes["run"])
    together = ft.SelfCalibratingDiagnoser(robot, calibrated(robot).imperfections)
    found: list[Diagnosis] = []
    for first in range(0, len(order), size):
        found += together.diagnose(runs.isel(run=order[first : first + size]))
    return found


def main() -> None:
    """Print a line for each way of moving the tool."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--size", type=int, default=5)
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    runs = ft.read_runs(options.folder, robot, ft.ReadOptions(published_labels=True))
    seen = runs["measured"]
    for name, move in MOVES.items():
        moved = runs.assign(measured=(seen.dims, move(seen.values)))
        alone = told(ft.BayesDiagnoser(robot).diagnose(moved))
        folders = told(in_folders(robot, moved, options.size))
        print(f"{name:22} alone {alone};   folders {folders}", flush=True)


if __name__ == "__main__":
    main()
