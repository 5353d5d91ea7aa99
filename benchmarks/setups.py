"""Wrong set-ups told from broken motors: real runs relabelled with one mistake, or two.

    FAILURETWIN_DATA=DATA python benchmarks/setups.py [--arm armpi_fpv|ur10|ur5] [--size 1]
        [--folders 10] [--only PART_OF_A_NAME ...]
    python benchmarks/setups.py --simulated 1000

The measurements stay; what the log claims is changed by the correction that undoes each mistake,
the other way round. Runs are judged in folders of --size, drawn at random: named is how many are
said to be set up so, sure is how many runs are blamed on another motor above 90 %. The ArmPi has
the 90 runs of DATA/real_robot_b_20241003 and its bundled calibration (in sample); UR10 and UR5 have
the runs of benchmarks/real_arms.py and the calibration of other poses. With --simulated N, so many
healthy and so many faulty simulated runs, set up as told and judged one by one: how many are
called wrong above 90 %, and what it costs beside never asking.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from real_arms import POSES, _calibrated, _data, _reading, _relabelled
from scipy.spatial.transform import Rotation

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
from failuretwin.digital_model.profile_text import profile_text
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.urdf.check import check_urdf
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.set_ups import mistakes

if TYPE_CHECKING:
    import xarray as xr

SURE = 0.9
PROGRESS = 200
"""Runs after which a row is printed."""


@dataclass(frozen=True)
class Truth:
    """A mistake that is made.

    Attributes:
        name: What it is.
        words: What naming it says; empty: nothing may be said.
        made: What makes such a log of one that fits.
    """

    name: str
    words: tuple[str, ...]
    made: LogCorrection


def main() -> None:
    """Print a row for each mistake."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", default="armpi_fpv", choices=["armpi_fpv", *POSES])
    parser.add_argument("--size", type=int, default=1, help="runs a folder")
    parser.add_argument("--folders", type=int, default=10)
    parser.add_argument("--only", nargs="+", default=[""], help="parts of names of mistakes")
    parser.add_argument("--simulated", type=int, default=0, help="so many simulated runs instead")
    options = parser.parse_args()
    if options.simulated:
        _print_simulated(options.simulated)
        return
    with tempfile.TemporaryDirectory() as folder:
        runs, diagnoser = _armpi() if options.arm == "armpi_fpv" else _ur(options.arm, Path(folder))
    order = np.random.default_rng(1).permutation(runs.sizes["run"])
    folders = [
        np.sort(order[first : first + options.size])
        for first in range(0, len(order) - options.size + 1, options.size)
    ][: options.folders]
    print("mistake | folders | named | right | nats | sure of another motor | no verdict | s a run")
    for truth in _truths(diagnoser.twin.robot):
        if any(part in truth.name for part in options.only):
            print(_row(truth, runs, folders, diagnoser), flush=True)


def _armpi() -> tuple[xr.Dataset, ft.BayesDiagnoser]:
    poses = _data()
    logs = poses.parent / "real_robot_b_20241003"
    runs = read_runs(logs, options=ReadOptions(published_labels=True))
    return runs, ft.BayesDiagnoser("armpi_fpv")


def _ur(arm: str, folder: Path) -> tuple[xr.Dataset, ft.BayesDiagnoser]:
    poses = _data()
    made = _relabelled(poses / POSES[arm], arm, 0, (1, 30), folder / "runs")
    profile = made / "arm.toml"
    profile.write_text(profile_text(check_urdf(made / "arm.urdf"), profile), encoding="utf-8")
    robot = load_robot(profile)
    runs = read_runs(made / "test.csv", robot, _reading(made, robot))
    with (made / "truth.csv").open(encoding="utf-8") as file:
        truths = {row["run"]: row["truth"] for row in csv.DictReader(file)}
    names = [truths[str(name).rpartition("/")[2]] for name in runs["run"].values]
    return runs.assign(fault=("run", names)), ft.BayesDiagnoser(robot, _calibrated(made, robot))


def _print_simulated(count: int) -> None:
    """Print what asking for set-ups does to runs that are set up as told."""
    asking = ft.BayesDiagnoser("armpi_fpv")
    never = replace(asking.priors, setup=replace(asking.priors.setup, wrong_rate=(0.0, 0.0)))
    trusting = ft.BayesDiagnoser("armpi_fpv", priors=never)
    robot = asking.twin.robot
    names = [str(one) for one in asking.hypothesis_set]
    print("runs | called wrong above 90 % | may be wrong | nats | nats where it is never asked")
    for kind, truths in (("healthy", names[:1]), ("faulty", names[1:])):
        each, wrong, may_be = -(-count // len(truths)), 0, 0
        plan = Plan(robot, truths, each, 1, "armpi_fpv", RandomMovements())
        runs, nats = simulate(plan), []
        for row in range(runs.sizes["run"]):
            says = [d.diagnose(runs.isel(run=[row]))[0] for d in (asking, trusting)]
            told = [line for line in says[0].quality if "fit the profile" in line]
            wrong += any("does not fit" in line for line in told)
            may_be += any("may not fit" in line for line in told)
            nats.append([-np.log(max(d.posterior[d.truth or ""], 1e-9)) for d in says])
            if (row + 1) % PROGRESS == 0 or row + 1 == runs.sizes["run"]:
                asked, trusted = np.mean(nats, axis=0)
                cells = f"{row + 1} {kind}", str(wrong), str(may_be), f"{asked:.4f}"
                print(" | ".join((*cells, f"{trusted:.4f}")), flush=True)


def _truths(robot: Robot) -> Iterator[Truth]:
    none, one = LogCorrection.none(len(robot.motors)), np.eye(len(robot.motors))
    yield Truth("nothing", (), none)
    known = {m.what: m.correction.inverse for m in mistakes(robot) if m.kind != "axes"}
    known |= {m.what: m.correction.inverse for m in mistakes(robot) if m.what[:2] in ("x ", "y ")}
    for what, made in known.items():
        # an arm is its own mirror image: x mirrored is motor 1 reversed
        same = ("motor 1 turns the other way",) if what.startswith("x of") else ()
        yield Truth(what, (what, *same), made)
    for k in range(len(one)):
        words = (f"motor {k + 1} stands", "in a frame turned", "not seem to stand")
        yield Truth(f"zero of motor {k + 1}", words, replace(none, z=-np.deg2rad(5.0) * one[k]))
    turn = Rotation.from_euler("xyz", [20.0, -30.0, 140.0], degrees=True).as_matrix()
    frame = replace(none, M=turn, t=np.array([0.3, 0.4, 0.3]))
    yield Truth("camera frame", ("in a frame turned",), frame)
    yield Truth("z + 5 mm", ("not seem to stand",), replace(none, t=np.array([0.0, 0.0, 0.005])))
    for late in (0.5, -0.2):
        yield Truth(f"clock {late:+} s", ("clock",), replace(none, late_s=-late))
    swapped = next(w for w in known if w.startswith("the commands of motor 3 and motor 4"))
    two = known["motor 2 turns the other way"].after(known[swapped])
    yield Truth("motor 2 reversed, motors 3 and 4 swapped", ("motor 2 turns", swapped), two)


def _row(
    truth: Truth, runs: xr.Dataset, folders: list[np.ndarray], diagnoser: ft.BayesDiagnoser
) -> str:
    logs, begun = truth.made.runs(runs), time.process_time()
    found = [diagnoser.diagnose(logs.isel(run=rows)) for rows in folders]
    spent = time.process_time() - begun
    judged = [d for some in found for d in some]
    told = [d for d in judged if not d.undecided]
    nats = [-np.log(max(d.posterior[d.truth or ""], 1e-9)) for d in told]
    named = sum(_named(truth, some[0]) for some in found)
    right = sum(d.diagnosis == d.truth for d in told)
    sure = sum(_sure_of_another(d) for d in told)
    cells = (
        truth.name,
        str(len(folders)),
        str(named),
        f"{right} of {len(judged)}",
        f"{np.mean(nats):.3f}" if nats else "-",
        str(sure),
        str(len(judged) - len(told)),
        f"{spent / len(judged):.2f}",
    )
    return " | ".join(cells)


def _named(truth: Truth, diagnosis: Diagnosis) -> bool:
    """Return whether the mistake is named; of nothing wrong, whether nothing is named."""
    said = " ".join(line for line in diagnosis.quality if "profile" in line)
    return any(word in said for word in truth.words) if truth.words else "does not" not in said


def _sure_of_another(diagnosis: Diagnosis) -> bool:
    best = max(diagnosis.posterior, key=lambda name: diagnosis.posterior[name])
    return best not in (diagnosis.truth, "healthy") and diagnosis.posterior[best] > SURE


if __name__ == "__main__":
    main()
