"""How like the real robot the imperfect twin is: figures side by side, and a two-sample test.

    python benchmarks/realism.py HEALTHY_LOG... [--copies 10]

Each real run has simulated copies with the same targets and ramps. A classifier that cannot tell
them apart better than by tossing a coin has an area under the curve of 0.5. It is judged on
sessions that it was not trained on. Then come the features that tell them apart by themselves.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import accuracy_score, roc_auc_score
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.calibration.observations import observe, session_names
from failuretwin.connection.calibration.timing_fit import movements_of
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.core.movements import Movements
from failuretwin.core.runs import concatenate
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.observation.evidence import settled_evidence

FOLDS = 5
SAMPLES = 500
"""Bootstrap samples behind each interval."""
RIDGE_M = 1e-3
"""Displacement of the tool that no motor explains [m]."""
TOLD = 6
"""Features that are printed."""


@dataclass(frozen=True)
class SameMovements(RandomMovements):
    """The targets and ramps of a recorded run; only the times of commands are drawn."""

    initial: Any = ()
    target: Any = ()
    ramp: Any = ()

    def draw(self, *where: Any) -> Movements:
        """Return the movements of one run."""
        found = super().draw(*where)
        initial, target, ramp = (np.array([x]) for x in (self.initial, self.target, self.ramp))
        return replace(found, initial=initial, target=target, ramp_duration=ramp)


def copies_of(real: xr.Dataset, robot: Robot, known: Imperfections, copies: int) -> xr.Dataset:
    """Return simulated runs with the movements of each real run."""
    movements, made = movements_of(real), []
    for run in range(real.sizes["run"]):
        own = movements[run : run + 1]
        count = int(own.exists.sum())
        lists = [x.tolist() for x in (own.initial[0], own.target[0], own.ramp_duration[0])]
        period = float(np.median(np.diff(own.start[0, :count])))
        same = SameMovements(count, period, (0.5,), lists[0], lists[1][:count], lists[2][:count])
        part = simulate(Plan(robot, [HEALTHY], copies, run, known, same))
        names = [f"copy {run}/{copy}" for copy in range(copies)]
        made.append(part.assign_coords(run=("run", np.array(names, dtype=object))))
    return concatenate(made)


def features(runs: xr.Dataset, robot: Robot) -> dict[str, FloatArray]:
    """Return what runs show at rest, on the way and in time; by name, (run,) each.

    Displacements at rest are shared out between the motors by ridge regression.
    """
    twin, time = DigitalTwin(robot), runs["time"].values
    path = twin.path(twin.respond(runs["command"].values, time))
    residual, measured = runs["measured"].values - path, runs["measured"].values
    settled, movements = settled_evidence(runs), movements_of(runs)
    expected, jacobian = twin.path_and_jacobian(np.nan_to_num(movements.target))
    beyond = np.where(settled.usable[..., None], settled.point - expected, np.nan)
    square = np.einsum("...am,...bm->...ab", jacobian, jacobian) + RIDGE_M**2 * np.eye(3)
    turn = np.einsum("...am,...ab,...b->...m", jacobian, np.linalg.inv(square), beyond)
    towards = np.sign(movements.target - movements.origin())
    names = robot.motor_names
    rows = []
    with np.errstate(invalid="ignore"):
        for run in range(runs.sizes["run"]):
            seen = np.isfinite(measured[run]).all(axis=1)
            row = {"readings, share": float(seen[time <= float(runs["duration"][run])].mean())}
            row["at rest, all [m]"] = _mean(np.linalg.norm(beyond[run], axis=1))
            for m, name in enumerate(names):
                row[f"at rest, {name}, mean [rad]"] = _mean(turn[run, :, m])
                row[f"at rest, {name}, size [rad]"] = _mean(np.abs(turn[run, :, m]))
                row[f"at rest, {name}, towards [rad]"] = _mean(turn[run, :, m] * towards[run, :, m])
            rows.append(row | _in_time(run, residual, path, measured, time, settled, movements))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _in_time(
    run: int,
    residual: FloatArray,
    path: FloatArray,
    measured: FloatArray,
    time: FloatArray,
    settled: Any,
    movements: Movements,
) -> dict[str, float]:
    """Return noise and settling at rest, and residual and lag on the way, of one run."""
    seen = np.isfinite(measured[run]).all(axis=1)
    velocity = np.gradient(path[run], time, axis=0)
    found: dict[str, list[float]] = {key: [] for key in ("noise", "settling", "way", "lag")}
    for m in np.flatnonzero(movements.exists[run]):
        begin = movements.start[run, m]
        way = seen & (time >= begin) & (time < begin + movements.ramp_duration[run, m].max())
        rest = seen & (time >= settled.begin[run, m]) & (time <= settled.end[run, m])
        if rest.sum() > 1 and settled.usable[run, m]:
            found["noise"].append(float(measured[run, rest].std(axis=0).mean()))
            moved = measured[run, rest][-1] - measured[run, rest][0]
            found["settling"].append(float(np.linalg.norm(moved)))
        if way.any():
            r, v = residual[run, way], velocity[way]
            found["way"].append(float(np.sqrt(np.mean(r**2))))
            found["lag"].append(float(-(r * v).sum() / max((v * v).sum(), 1e-9)))
    return {
        "noise at rest [m]": _mean(np.array(found["noise"])),
        "settling at rest [m]": _mean(np.array(found["settling"])),
        "on the way, median rms [m]": _median(found["way"]),
        "on the way, largest rms [m]": max(found["way"], default=np.nan),
        "on the way, median lag [s]": _median(found["lag"]),
    }


def _mean(values: FloatArray) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else np.nan


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan


def table(real: xr.Dataset, simulated: xr.Dataset, robot: Robot) -> None:
    """Print settled errors, timing and rates of both, side by side."""
    count = abs(robot.servo_units.rad_per_count)
    print(f"{'':44s} {'real':>9s} {'95 % interval':>20s} {'simulated':>10s}")
    errors = []
    for runs in (real, simulated):
        seen = observe(runs, robot)
        assert seen.position is not None
        error = (seen.position - seen.target) / count
        errors.append(error[(np.abs(error) < 20.0).all(axis=1)])
    for k, motor in enumerate(robot.motor_names):
        for what, statistic in (("mean", np.mean), ("sd", np.std)):
            values = [float(statistic(error[:, k])) for error in errors]
            rng = np.random.default_rng(0)
            draws = [statistic(rng.choice(errors[0][:, k], len(errors[0]))) for _ in range(200)]
            low, high = np.quantile(draws, [0.025, 0.975])
            name = f"settled error of {motor}, {what} [counts]"
            print(f"{name:44s} {values[0]:9.2f} {low:9.2f} to {high:7.2f} {values[1]:10.2f}")
    learned = [fit_calibration(runs, robot, "x", "x", thorough=False) for runs in (real, simulated)]
    other = {(p.name, p.motor): p for p in learned[1].parameters}
    for p in learned[0].parameters:
        match = other.get((p.name, p.motor))
        if p.unit in ("s", "share") and match is not None:
            name = f"{p.name} {p.motor} [{p.unit}]"
            print(f"{name:44s} {p.value:9.4f} {p.low:9.4f} to {p.high:7.4f} {match.value:10.4f}")


def two_sample(real: xr.Dataset, simulated: xr.Dataset, robot: Robot, copies: int) -> None:
    """Print how well classifiers tell real from simulated runs, by session, and by which features.

    Copies are in the fold of the run that they copy.
    """
    sessions = session_names(real)
    names = sorted(set(sessions))
    own = np.array([names.index(s) for s in sessions])
    groups = np.concatenate([own, np.repeat(own, copies)])
    y = np.repeat([1, 0], [len(own), copies * len(own)])
    a, b = features(real, robot), features(simulated, robot)
    seen = {name: np.concatenate([a[name], b[name]]) for name in a}
    values = np.stack(list(seen.values()), axis=1)
    kept = np.isfinite(values).any(axis=0)
    values, columns = values[:, kept], np.array(list(seen))[kept]
    filled = np.where(np.isfinite(values), values, np.nanmedian(values, axis=0))
    linear = make_pipeline(
        StandardScaler(), LogisticRegression(class_weight="balanced", max_iter=2000, C=0.1)
    )
    trees = HistGradientBoostingClassifier(class_weight="balanced", max_iter=100, random_state=0)
    folds = GroupKFold(min(FOLDS, len(names)))
    print(f"{len(own)} real runs of {len(names)} sessions, {copies} copies of each")
    for title, model in (("linear", linear), ("boosted trees", trees)):
        chance = cross_val_predict(
            model, filled, y, groups=groups, cv=folds, method="predict_proba"
        )[:, 1]
        print(f"{title}: {told_apart(y, chance, own, copies)}")
    print("features by themselves, area under the curve; mean of real, of simulated")
    areas = {n: roc_auc_score(y, f) for n, f in zip(columns, filled.T, strict=True)}
    for name in sorted(areas, key=lambda n: -abs(areas[n] - 0.5))[:TOLD]:
        means = np.nanmean(a[name]), np.nanmean(b[name])
        print(f"  {name:36s} {areas[name]:.2f}   {means[0]:10.3g} {means[1]:10.3g}")


def told_apart(y: IntArray, chance: FloatArray, own: IntArray, copies: int) -> str:
    """Return balanced accuracy and area under the curve, with intervals over real runs."""
    rng, count = np.random.default_rng(0), len(own)
    draws = []
    for _ in range(SAMPLES):
        runs = rng.integers(0, count, count)
        pick = np.concatenate([runs, *(count + runs * copies + c for c in range(copies))])
        draws.append((_balanced(y[pick], chance[pick]), roc_auc_score(y[pick], chance[pick])))
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    values = _balanced(y, chance), roc_auc_score(y, chance)
    texts = [f"{v:.2f} ({lo:.2f} to {hi:.2f})" for v, lo, hi in zip(values, low, high, strict=True)]
    return f"balanced accuracy {texts[0]}, area under the curve {texts[1]}"


def _balanced(y: IntArray, chance: FloatArray) -> float:
    weight = np.where(y == 1, np.sum(y == 0) / max(np.sum(y == 1), 1), 1.0)
    return float(accuracy_score(y, chance > 0.5, sample_weight=weight))


def main() -> None:
    """Compare healthy logs with simulated runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", help="healthy logs of the robot")
    parser.add_argument("--copies", type=int, default=10)
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    real = ft.read_runs(options.logs, robot)
    known = load_calibration(None, robot).imperfections
    simulated = copies_of(real, robot, known, options.copies)
    two_sample(real, simulated, robot, options.copies)
    print()
    table(real, simulated, robot)


if __name__ == "__main__":
    main()
