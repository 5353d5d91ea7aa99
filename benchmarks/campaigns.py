"""Does a calibration carry over? Learned in one campaign, judged on another robot or month.

    python benchmarks/campaigns.py DATA

DATA holds `real_robot_b_20241003` and `healthy_logs`. For each pair: robust size of the settled
error (1.48 times its median size, all movements together) in servo counts, by motor, and how much
better the calibration predicts settled tool positions than the generic figures of an uncalibrated
robot do.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.calibration.cross_validation import predict, robust_scale
from failuretwin.connection.calibration.result import mean_gain
from failuretwin.data_knowledge.readers.raw_sessions import find_sessions
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

OCTOBER, MAY, ROBOT_A = "robot b, October 2024", "robot b, May 2024", "robot a, spring 2024"
FAULTY_LABELS = tuple(f"label_{k}" for k in range(5, 9))


def campaigns(folder: Path, robot: Robot) -> dict[str, xr.Dataset]:
    """Return the healthy runs of each campaign."""
    folders = {
        OCTOBER: folder / "real_robot_b_20241003",
        MAY: folder / "healthy_logs" / "robot_b",
        ROBOT_A: folder / "healthy_logs" / "robot_a",
    }
    found = {}
    for name, place in folders.items():
        healthy = [s for s in find_sessions(place) if not s.name.endswith(FAULTY_LABELS)]
        found[name] = ft.read_runs(healthy, robot)
    return found


def row(learned: xr.Dataset, judged: xr.Dataset | None, robot: Robot) -> str:
    """Return sizes and gain; without `judged` runs, of each session by a fit to the others."""
    found = fit_calibration(learned, robot, "trial", "campaigns", judged=judged)
    told = predict(found, learned if judged is None else judged, robot)
    kept = told.counts.all(axis=1)
    count = abs(robot.servo_units.rad_per_count)
    sizes = robust_scale((told.error - told.expected)[kept]) / count
    gain, half = mean_gain(found.held_out)
    cells = " ".join(f"{size:5.2f}" for size in sizes)
    return f"{int(kept.sum()):4d} {cells}   {gain:+.2f} +- {half:.2f}"


def main() -> None:
    """Print a row for each pair of campaigns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    logs = campaigns(options.folder, robot)
    print(f"{'learned from':24s} {'judged on':24s} movements, counts (motors 1-4), gain [nats]")
    for source, learned in logs.items():
        for target, runs in logs.items():
            same = source == target
            told = row(learned, None if same else runs, robot)
            print(f"{source:24s} {'its sessions in turn' if same else target:24s} {told}")


if __name__ == "__main__":
    main()
