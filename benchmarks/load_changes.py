"""Healthy arms that pick up a load in mid-run: is a motor blamed?

    python benchmarks/load_changes.py [--robot armpi_fpv ur5e] [--mass 0.0 0.1 0.3 5.0]
        [--runs 30] [--faulty 4] [--at 5.9] [--seed 0]

Runs of the physics engine, judged by the arm's class and, of the ArmPi FPV, by its calibration.
`--faulty` runs of each motor and mode beside them pick up the load too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from telling import nats, right, share

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot, load_robot

SURE = 0.99


def carrying(truth: Imperfections, mass_kg: float) -> Imperfections:
    """Return healthy behaviour with a load at the tool."""
    assert truth.settling is not None
    return replace(truth, settling=replace(truth.settling, payload=mass_kg))


def picked_up(robot: Robot, mass_kg: float, at_s: float, plan: Plan) -> xr.Dataset:
    """Return runs of a plan that carry a load from some time on."""
    bare = simulate(plan)
    truth = carrying(calibrated(robot).imperfections, mass_kg)
    loaded = simulate(replace(plan, imperfections=truth))
    later = bare["time"].values[None, :, None] >= at_s
    measured = np.where(later, loaded["measured"].values, bare["measured"].values)
    return bare.assign(measured=(bare["measured"].dims, measured))


def line(found: Sequence[Diagnosis]) -> str:
    """Return how many are blamed, and how many for sure."""
    healthy = [d for d in found if d.truth == "healthy"]
    faulty = [d for d in found if d.truth != "healthy"]
    blamed = [d for d in healthy if d.diagnosis not in (None, "healthy")]
    sure = sum(max(d.posterior.values()) > SURE for d in blamed)
    text = f"healthy blamed {share(len(blamed), len(healthy))}, {sure} above {SURE:.0%}"
    if faulty:
        text += f"; faulty right {share(int(right(faulty).sum()), len(faulty))}"
    return f"{text}; {nats(found).mean():.3f} nats"


def main() -> None:
    """Judge every arm with every load."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", nargs="+", default=["armpi_fpv", "ur5e"])
    parser.add_argument("--mass", nargs="+", type=float, default=[0.0, 0.1, 0.3, 5.0])
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--faulty", type=int, default=4)
    parser.add_argument("--at", type=float, default=5.9)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for name in given.robot:
        robot = load_robot(name)
        truth = calibrated(robot).imperfections
        plans = [
            Plan(robot, hypotheses, count, given.seed, truth, engine="physics")
            for hypotheses, count in ((["healthy"], given.runs), (None, given.faulty))
            if count
        ]
        for mass in given.mass:
            made = [picked_up(robot, mass, given.at, plan) for plan in plans]
            for known in ("generic", None) if name == "armpi_fpv" else ("generic",):
                found = [d for runs in made for d in ft.diagnose(runs, robot, known)]
                print(f"{name} {mass:g} kg, {known or 'calibrated'}: {line(found)}", flush=True)


if __name__ == "__main__":
    main()
