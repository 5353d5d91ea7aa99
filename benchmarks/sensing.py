"""What each sensor shows of a simulated ArmPi FPV with the imperfections of the real one.

    python benchmarks/sensing.py [--runs-per-class 30] [--per-size 8] [--seed 0] [SENSING ...]

For each set of sensors: accuracy over the nine classes and nats a run, how many are wrong and
surely so, the right group (what the sensor cannot tell apart counts as one) and the smallest
steady-state error found of each motor: from which three quarters of the runs show a fault, and
name its motor (with half of the probability).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from telling import nats, right, share

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES

ROBOT = "armpi_fpv"
KINDS = ("accelerometer", "gyroscope", "orientation", "wire")
SENSING = (
    *("tool", "accelerometer", "accelerometer+gyroscope", "tool+accelerometer", "tool+encoders"),
    *("encoders", "orientation", "tool+orientation", "wire", "tool+wire"),
)
COUNTS = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Sizes of errors [servo counts]; a count is 0.24 deg."""
RAD_PER_COUNT = np.deg2rad(0.24)
SURE, FOUND, SHOWN = 0.99, 0.75, 0.05
"""Probability of a wrong verdict that is sure; share of runs that counts as found; probability of a
healthy robot below which a fault shows."""
PARALLEL = {f"motor_{k}:steady_state_error" for k in (2, 3, 4)}
UNSEEN = {"healthy", "motor_1:steady_state_error"}
"""What gravity cannot tell apart by errors: parallel joints, and turns about the vertical."""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sensing", nargs="*", default=list(SENSING))
    parser.add_argument("--runs-per-class", type=int, default=30)
    parser.add_argument("--per-size", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    nine = ft.simulate(ft.Plan(ROBOT, None, asked.runs_per_class, asked.seed, ROBOT, sensors=KINDS))
    sized = {counts: _errors(counts, asked.per_size, asked.seed + 1) for counts in COUNTS}
    for sensing in asked.sensing:
        diagnoser = ft.BayesDiagnoser(ROBOT, sensing=sensing)
        _tell(sensing, diagnoser.diagnose(nine))
        found = {counts: diagnoser.diagnose(runs) for counts, runs in sized.items()}
        print(f"  smallest error found [counts]: {_smallest(found)}", flush=True)


def _errors(counts: float, per_motor: int, seed: int) -> xr.Dataset:
    """Return runs with errors of one size, of each motor."""
    size = counts * RAD_PER_COUNT
    modes = dict(MODES) | {"steady_state_error": SteadyStateError(magnitude=(size, size))}
    names = [f"motor_{k}:steady_state_error" for k in (1, 2, 3, 4)]
    return ft.simulate(ft.Plan(ROBOT, names, per_motor, seed, ROBOT, modes=modes, sensors=KINDS))


def _tell(sensing: str, found: Sequence[Diagnosis]) -> None:
    wrong = [d for d in found if d.diagnosis not in (None, d.truth)]
    sure = sum(max(d.posterior.values()) > SURE for d in wrong)
    group = sum(d.diagnosis == d.truth or _alike(d) for d in found)
    count = int(right(found).sum())
    print(f"{sensing}: right {share(count, len(found))}, {nats(found).mean():.3f} nats a run")
    print(f"  right group {group}, no verdict {sum(d.diagnosis is None for d in found)}")
    print(f"  wrong and above {SURE:.0%}: {sure}; by class: {_by_class(found)}", flush=True)


def _alike(diagnosis: Diagnosis) -> bool:
    pair = {diagnosis.diagnosis, diagnosis.truth}
    return pair <= PARALLEL or pair <= UNSEEN


def _by_class(found: Sequence[Diagnosis]) -> dict[str, str]:
    told: dict[str, list[bool]] = {}
    for diagnosis in found:
        told.setdefault(str(diagnosis.truth), []).append(diagnosis.diagnosis == diagnosis.truth)
    return {name: f"{sum(ok)}/{len(ok)}" for name, ok in told.items()}


def _smallest(found: Mapping[float, Sequence[Diagnosis]]) -> dict[str, str]:
    """Return, for each motor, the size from which a fault shows, and the motor is named."""
    told = {}
    for motor in ("motor_1", "motor_2", "motor_3", "motor_4"):
        shares = {}
        for counts, diagnoses in found.items():
            own = [d for d in diagnoses if str(d.truth).startswith(motor)]
            seen = [d.diagnosis is not None and d.posterior["healthy"] < SHOWN for d in own]
            named = [s and _of_motor(d, motor) > 0.5 for s, d in zip(seen, own, strict=True)]
            shares[counts] = float(np.mean(seen)), float(np.mean(named))
        ends = []
        for k in range(2):
            good = [c for c in shares if all(shares[b][k] >= FOUND for b in shares if b >= c)]
            ends.append(f"{min(good):g}" if good else "none")
        told[motor] = " / ".join(ends)
    return told


def _of_motor(diagnosis: Diagnosis, motor: str) -> float:
    return sum(p for name, p in diagnosis.posterior.items() if name.startswith(motor))


if __name__ == "__main__":
    main()
