"""Diagnosis of real arms that nobody has tuned anything for: relabelled runs of UR10 and UR5.

    FAILURETWIN_DATA=DATA python benchmarks/real_arms.py [--arms ur10 ur5] [--seeds 0]
        [--per-cell 6] [--healthy 60] [--raw]

DATA/real_arms holds measured poses of healthy arms (docs/data.md). relabel.py makes runs with known
faults of them ("relabelled real": the measurements stay, the claimed commands change). Each arm has
the profile that `failuretwin robot init` writes, untouched. Its runs are judged without a
calibration, in folders of fifty that calibrate themselves, with the calibration that `failuretwin
calibrate` learns from other poses, and with the one that it learns with the geometry that
`failuretwin robot fit` finds from those poses; the UR10 also judges healthy runs of the same robot
four months before. With --raw positions stay in the frame of the tracker, and `failuretwin robot
fit` on 40 poses comes first.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import relabel

import failuretwin as ft
from failuretwin.connection.registration.fit import fit_registration
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.readers.column_map import read_column_map
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.profile_text import fitted_text, profile_text
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.urdf.check import check_urdf

if TYPE_CHECKING:
    import xarray as xr

POSES = {"ur10": "ur10_series_c.csv", "ur5": "ur5.csv"}
EARLIER = {"ur10": "ur10_series_a.csv"}
"""Poses of the same robot at another time and place."""
SURE = 0.99
FOLDER_RUNS = 50
FIRST_RUNS = 8
"""Runs of five poses from which the frame of a tracker is found."""


@dataclass(frozen=True)
class Scored:
    """A run that was judged.

    Attributes:
        group: Healthy, stuck, or the size of its errors [deg].
        diagnosis: What was said of it.
        truth: What was true.
    """

    group: str
    diagnosis: Diagnosis
    truth: str

    @property
    def right(self) -> bool:
        """Whether the verdict is the truth."""
        return not self.diagnosis.undecided and self.diagnosis.diagnosis == self.truth

    @property
    def surely_wrong(self) -> bool:
        """Whether the verdict is wrong and claims to be sure."""
        most = max(self.diagnosis.posterior.values())
        return not self.right and not self.diagnosis.undecided and most > SURE


def main() -> None:
    """Print a table for each arm and seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arms", nargs="+", choices=POSES, default=list(POSES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--per-cell", type=int, default=6, help="runs a motor and size")
    parser.add_argument("--healthy", type=int, default=60, help="healthy runs")
    parser.add_argument("--raw", action="store_true", help="positions in the tracker's own frame")
    options = parser.parse_args()
    poses = _data()
    for arm in options.arms:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                out, counts = Path(folder), (options.per_cell, options.healthy)
                if options.raw:
                    _raw_arm(poses, arm, seed, counts, out)
                else:
                    _arm(poses, arm, seed, counts, out)


def _data() -> Path:
    """Return the folder with measured poses."""
    poses = Path(os.environ.get("FAILURETWIN_DATA", "data")) / "real_arms"
    if not poses.is_dir():
        sys.exit(
            f"{poses} is not there. Set FAILURETWIN_DATA to the folder that holds real_arms with "
            "measured poses, filled as docs/data.md says."
        )
    return poses


def _arm(poses: Path, arm: str, seed: int, counts: tuple[int, int], folder: Path) -> None:
    """Judge the runs of one arm and print the tables."""
    runs = _relabelled(poses / POSES[arm], arm, seed, counts, folder / "runs")
    robot = _initial(runs)
    _table(f"{arm}, seed {seed}, plain", _judged(runs, robot, None))
    _table(f"{arm}, seed {seed}, self-calibrated by {FOLDER_RUNS} runs", _together(runs, robot))
    known = _calibrated(runs, robot)
    fitted = _fitted(runs, robot, "fitted.toml")
    exact = _calibrated(runs, fitted)
    _table(f"{arm}, seed {seed}, calibrated", _judged(runs, robot, known))
    _table(f"{arm}, seed {seed}, calibrated with geometry", _judged(runs, fitted, exact))
    if arm in EARLIER:
        months = (poses / EARLIER[arm], arm, seed, (0, counts[1]), folder / "earlier")
        older = _relabelled(*months)
        _table(f"{arm}, seed {seed}, months before", _judged(older, robot, known))
        _table(f"{arm}, seed {seed}, months before, geometry of now", _judged(older, fitted, exact))
        placed = _fitted(older, robot, "then.toml")
        title = f"{arm}, seed {seed}, months before, geometry of then, calibration of now"
        _table(title, _judged(older, placed, exact))


def _raw_arm(poses: Path, arm: str, seed: int, counts: tuple[int, int], folder: Path) -> None:
    """Judge the runs of one arm in the frame of the tracker and print the tables."""
    runs = _relabelled(poses / POSES[arm], arm, seed, counts, folder / "runs", "--raw")
    placed = _fitted(runs, _initial(runs), "placed.toml", FIRST_RUNS)
    _table(f"{arm}, seed {seed}, raw, fitted to 40 poses", _judged(runs, placed, None))
    known = _calibrated(runs, placed)
    _table(f"{arm}, seed {seed}, raw, fitted, calibrated", _judged(runs, placed, known))
    exact = _fitted(runs, placed, "exact.toml")
    title = f"{arm}, seed {seed}, raw, calibrated with geometry"
    _table(title, _judged(runs, exact, _calibrated(runs, exact)))


def _initial(runs: Path) -> Robot:
    """Return the robot by the profile that `failuretwin robot init` writes."""
    profile = runs / "arm.toml"
    profile.write_text(profile_text(check_urdf(runs / "arm.urdf"), profile), encoding="utf-8")
    return load_robot(profile)


def _calibrated(runs: Path, robot: Robot) -> Imperfections:
    return ft.calibrate(_healthy_logs(runs, robot), robot).imperfections


def _fitted(runs: Path, robot: Robot, name: str, count: int | None = None) -> Robot:
    """Return the robot by the profile that `failuretwin robot fit` writes from healthy logs.

    Args:
        runs: Their folder.
        robot: The robot before.
        name: Name of the profile.
        count: How many of the runs are used; None: all.
    """
    healthy = _healthy_logs(runs, robot).isel(run=slice(count))
    found = fit_registration(healthy, robot).profile
    text = robot.source.read_text(encoding="utf-8")
    profile = robot.folder / name
    profile.write_text(fitted_text(text, robot.source, profile, found), encoding="utf-8")
    return load_robot(profile)


def _healthy_logs(runs: Path, robot: Robot) -> xr.Dataset:
    return ft.read_runs([*sorted(runs.glob("calibration_*.csv"))], robot, _reading(runs, robot))


def _reading(runs: Path, robot: Robot) -> ft.ReadOptions:
    return ft.ReadOptions(columns=read_column_map(runs / "map.toml", robot))


def _judged(runs: Path, robot: Robot, known: Imperfections | None) -> list[Scored]:
    """Return the runs of a folder judged by a robot and its calibration; None: by generic ones."""
    test = ft.read_runs(runs / "test.csv", robot, _reading(runs, robot))
    return _scored(ft.BayesDiagnoser(robot, known).diagnose(test), runs / "truth.csv")


def _together(runs: Path, robot: Robot) -> list[Scored]:
    """Return the runs of a folder judged in folders of their own, which calibrate themselves."""
    test = ft.read_runs(runs / "test.csv", robot, _reading(runs, robot))
    order, found = np.random.default_rng(0).permutation(test.sizes["run"]), []
    for first in range(0, len(order), FOLDER_RUNS):
        some = test.isel(run=order[first : first + FOLDER_RUNS])
        found += ft.SelfCalibratingDiagnoser(robot).diagnose(some)
    return _scored(found, runs / "truth.csv")


def _relabelled(
    poses: Path,
    arm: str,
    seed: int,
    counts: tuple[int, int],
    out: Path,
    *more: str,
) -> Path:
    """Return the folder of runs made of measured poses.

    Args:
        poses: The measured poses.
        arm: Name of the arm.
        seed: Seed of what is drawn.
        counts: Runs of each motor and size, healthy runs.
        out: That folder.
        more: Further options.
    """
    per_cell, healthy = (str(count) for count in counts)
    options = ["--seed", str(seed), "--per-cell", per_cell, "--healthy", healthy, *more]
    with contextlib.redirect_stdout(None):
        relabel.main([str(poses), arm, str(out), *options])
    return out


def _scored(found: Sequence[Diagnosis], truths: Path) -> list[Scored]:
    with truths.open(encoding="utf-8") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    scored = []
    for diagnosis in found:
        row = rows[diagnosis.run.rpartition("/")[2]]
        mode = row["truth"].partition(":")[2]
        group = f"error {float(row['size_deg']):g} deg" if row["size_deg"] else mode or "healthy"
        scored.append(Scored(group, diagnosis, row["truth"]))
    return scored


def _table(title: str, scored: Sequence[Scored]) -> None:
    """Print how many of each group are right, by joint where that matters."""
    print(f"\n{title}")
    print(f"{'':16s}    right  wrong, above {SURE:.0%} sure   right of each motor")
    for group in dict.fromkeys(one.group for one in scored):
        some = [one for one in scored if one.group == group]
        right, sure = sum(one.right for one in some), sum(one.surely_wrong for one in some)
        line = f"{group:16s} {right:4d} /{len(some):4d} {sure:4d}"
        print(f"{line:50s} {_by_motor(some)}".rstrip())
    right, sure = sum(one.right for one in scored), sum(one.surely_wrong for one in scored)
    print(f"{'all':16s} {right:4d} /{len(scored):4d} {sure:4d}", flush=True)


def _by_motor(some: Sequence[Scored]) -> str:
    motors = sorted({one.truth.partition(":")[0] for one in some})
    if motors == ["healthy"]:
        return ""
    return " ".join(
        str(sum(one.right for one in some if one.truth.startswith(motor + ":"))) for motor in motors
    )


if __name__ == "__main__":
    main()
