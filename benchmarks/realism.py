"""How like the real robot the imperfect twin is: figures side by side, and a two-sample test.

    python benchmarks/realism.py HEALTHY_LOG... [--runs 500]

A classifier that cannot tell real from simulated runs better than by tossing a coin has an area
under the curve of 0.5. It is judged on sessions that it was not trained on.
"""

from __future__ import annotations

import argparse

import numpy as np
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
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.evidence import settled_evidence

FOLDS = 5
MOVEMENTS = 5


def features(runs: object, robot: Robot) -> FloatArray:
    """Return residual features of runs at system level, (run, feature).

    Per movement: settled residual of the tool (x, y, z) [m], its residual while moving (rms) [m]
    and the share of readings that are there.
    """
    import xarray as xr

    assert isinstance(runs, xr.Dataset)
    twin, time = DigitalTwin(robot), runs["time"].values
    path = twin.path(twin.respond(runs["command"].values, time))
    residual = runs["measured"].values - path
    settled = settled_evidence(runs)
    movements = movements_of(runs)
    rows = []
    for run in range(runs.sizes["run"]):
        row: list[float] = []
        for m in range(MOVEMENTS):
            begin = movements.start[run, m]
            end = begin + movements.ramp_duration[run, m].max()
            moving = residual[run, (time >= begin) & (time < end)]
            whole = residual[run, (time >= begin) & (time < begin + 2.0), 0]
            seen = np.isfinite(moving).all(axis=1)
            rms = np.sqrt(np.mean(moving[seen] ** 2)) if seen.any() else np.nan
            expected = twin.path(movements.target[run, m])
            off = settled.point[run, m] - expected if settled.usable[run, m] else [np.nan] * 3
            row += [*off, rms, float(np.isfinite(whole).sum())]
        rows.append(row)
    return np.array(rows)


def table(real: object, simulated: object, robot: Robot) -> None:
    """Print settled errors, timing and rates of both, side by side."""
    import xarray as xr

    assert isinstance(real, xr.Dataset) and isinstance(simulated, xr.Dataset)
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


def two_sample(real: object, simulated: object, robot: Robot) -> None:
    """Print how well classifiers tell real from simulated runs, by session."""
    import xarray as xr

    assert isinstance(real, xr.Dataset) and isinstance(simulated, xr.Dataset)
    sessions = session_names(real)
    names = sorted(set(sessions))
    a, b = features(real, robot), features(simulated, robot)
    values_of, y = np.concatenate([a, b]), np.repeat([1, 0], [len(a), len(b)])
    groups = [names.index(s) for s in sessions] + [i % len(names) for i in range(len(b))]
    filled = np.where(np.isfinite(values_of), values_of, 0.0)
    linear = make_pipeline(
        StandardScaler(), LogisticRegression(class_weight="balanced", max_iter=2000, C=0.1)
    )
    trees = HistGradientBoostingClassifier(class_weight="balanced", max_iter=100, random_state=0)
    folds = GroupKFold(min(FOLDS, len(names)))
    for name, model, values in (("linear", linear, filled), ("boosted trees", trees, values_of)):
        chance = cross_val_predict(
            model, values, y, groups=groups, cv=folds, method="predict_proba"
        )[:, 1]
        weight = np.where(y == 1, len(b) / len(a), 1.0)
        right = accuracy_score(y, chance > 0.5, sample_weight=weight)
        area = roc_auc_score(y, chance)
        draws = []
        rng = np.random.default_rng(0)
        for _ in range(500):
            pick = np.concatenate(
                [rng.choice(np.flatnonzero(y == k), np.sum(y == k)) for k in (0, 1)]
            )
            draws.append(roc_auc_score(y[pick], chance[pick]))
        low, high = np.quantile(draws, [0.025, 0.975])
        print(
            f"two-sample test, {name}: area under the curve {area:.3f} (95 % interval {low:.3f} to "
            f"{high:.3f}), balanced accuracy {right:.3f}; {len(a)} real, {len(b)} simulated runs"
        )


def main() -> None:
    """Compare healthy logs with simulated runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", help="healthy logs of the robot")
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--robot", default="armpi_fpv")
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    real = ft.read_runs(options.logs, robot)
    imperfections = load_calibration(None, robot).imperfections
    simulated = simulate(Plan(robot, [HEALTHY], options.runs, 0, imperfections))
    table(real, simulated, robot)
    print()
    two_sample(real, simulated, robot)


if __name__ == "__main__":
    main()
