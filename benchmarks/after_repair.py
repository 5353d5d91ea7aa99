"""What became of a life, and of a calibration, once a motor was repaired or replaced.

    python benchmarks/after_repair.py [--runs 10] [--off-deg 4] [--motor 3]

A simulated ArmPi FPV, 20 healthy runs and 4 with the motor stuck, are tracked from nothing. Then
come healthy runs with the motor's zero where it was, and the same with a zero that is off. Both are
judged by the life so far, by a life that begins anew, and by a calibration made of themselves.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import failuretwin as ft
from failuretwin.data_knowledge.store import save_run_set

BEFORE, BROKEN = 20, 4


def save(
    path: Path, state: str, count: int, seed: int, motor: int = 0, off_rad: float = 0.0
) -> None:
    """Simulate runs whose motor `motor` (from 0) stands off by `off_rad`, and write them."""
    plan = ft.Plan("armpi_fpv", [state], count, seed=seed, imperfections="armpi_fpv")
    runs = ft.simulate(plan)
    command = runs["command"].values.copy()
    command[..., motor] += off_rad
    names = [f"{path.stem}_{number}" for number in range(runs.sizes["run"])]
    runs = runs.drop_vars(["target", "ramp_duration", "movement_start"])
    moved = {"command": (runs["command"].dims, command)}
    save_run_set(runs.assign(moved).assign_coords(run=names), path)


def call(folder: Path, *words: str) -> None:
    """Run a command of failuretwin in a folder."""
    line = [sys.executable, "-m", "failuretwin", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run(line, cwd=folder, check=True, capture_output=True, env=environment)


def judged(folder: Path, *words: str) -> str:
    """Return how many runs a command calls healthy, faulty and neither."""
    call(folder, "diagnose", *words, "--json", "said.jsonl")
    lines = (folder / "said.jsonl").read_text().splitlines()
    said = [json.loads(line)["diagnosis"] for line in lines]
    healthy, open_ = said.count("healthy"), said.count(None)
    return f"{healthy} healthy, {len(said) - healthy - open_} faulty, {open_} cannot tell"


def main() -> None:
    """Judge healthy runs after a repair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--off-deg", type=float, default=4.0)
    parser.add_argument("--motor", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save(folder / "before.nc", "healthy", BEFORE, 1)
        save(folder / "broken.nc", f"motor_{given.motor}:stuck", BROKEN, 2)
        for log in ("before.nc", "broken.nc"):
            call(folder, "diagnose", log, "--track", "--out", "life.toml")
        for off_deg in (0.0, given.off_deg):
            save(
                folder / "after.nc", "healthy", given.runs, 3, given.motor - 1, np.radians(off_deg)
            )
            for kept in folder.glob("life.*"):
                shutil.copy(kept, folder / kept.name.replace("life", "on"))
            for made in [*folder.glob("new.*"), *folder.glob("cal.*")]:
                made.unlink()
            call(folder, "calibrate", "after.nc", "--out", "cal.toml")
            print(f"zero off by {off_deg:g} deg")
            print("  life so far:    ", judged(folder, "after.nc", "--track", "--out", "on.toml"))
            print("  new life:       ", judged(folder, "after.nc", "--track", "--out", "new.toml"))
            print("  new calibration:", judged(folder, "after.nc", "--calibration", "cal.toml"))


if __name__ == "__main__":
    main()
