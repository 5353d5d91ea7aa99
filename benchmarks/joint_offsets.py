"""Joint offsets added to the readings of an SO-101: how often they are found, and sized rightly.

    python benchmarks/joint_offsets.py [LEROBOT_FOLDER] [--robots 100]

Offsets of 1, 2 and 5 deg: of simulated robots of the class, two episodes each, one joint at a time,
and, given a data set of a healthy arm, of each of its joints in both directions.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

import failuretwin as ft
from failuretwin.connection.joint_offsets import JointOffset, joint_offsets
from failuretwin.digital_model.nonidealities import vary

SIZES_DEG = (1.0, 2.0, 5.0)
KNOWN = ft.load_calibration(None, "so101")


def offset_of(runs: xr.Dataset, motor: int, degrees: float) -> JointOffset:
    """Return what is found of a motor whose readings are moved."""
    moved = runs.copy(deep=True)
    moved["position"][..., motor] += np.deg2rad(degrees)
    return joint_offsets(moved, KNOWN.robot, KNOWN.imperfections)[motor]


def simulated(count: int) -> Iterator[tuple[xr.Dataset, int, int]]:
    """Yield runs of healthy robots with a motor and a direction."""
    for seed in range(count):
        robot = vary(KNOWN.imperfections, np.random.default_rng(1000 + seed))
        plan = ft.Plan("so101", ["healthy"], runs_per_class=2, seed=seed, imperfections=robot)
        yield ft.simulate(plan), seed % 5, 1 if seed % 2 else -1


def show(name: str, cases: list[tuple[xr.Dataset, int, int]]) -> None:
    """Print a line for each size."""
    healthy = {id(runs): runs for runs, _, _ in cases}.values()
    judged = [joint_offsets(runs, KNOWN.robot, KNOWN.imperfections) for runs in healthy]
    false, joints = sum(one.found for found in judged for one in found), 5 * len(judged)
    print(f"{name}: {false} of {joints} healthy joints displaced")
    for size in SIZES_DEG:
        found = [(offset_of(runs, motor, sign * size), sign * size) for runs, motor, sign in cases]
        inside = sum(o.interval_90[0] <= np.deg2rad(d) <= o.interval_90[1] for o, d in found)
        rms = np.sqrt(np.mean([(np.rad2deg(o.size) - d) ** 2 for o, d in found]))
        seen = sum(o.found for o, _ in found)
        print(f"  {size:g} deg: {seen} found, {inside} inside, of {len(found)}; rms {rms:.2f} deg")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--robots", type=int, default=100)
    given = parser.parse_args()
    show("simulated", list(simulated(given.robots)))
    if given.folder is not None:
        real = ft.read_runs(given.folder, "so101")
        show("real", [(real, motor, sign) for motor in range(5) for sign in (1, -1)])
