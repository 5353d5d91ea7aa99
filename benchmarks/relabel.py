"""Runs of real arms with known faults, made from measured poses of healthy arms.

    python benchmarks/relabel.py POSES.csv ur10|ur5 OUT [--calibration N] [--healthy N]
        [--per-cell N] [--seed S] [--raw]

POSES.csv is a file of the UR10 or UR5 sets, as published (docs/data.md). OUT receives arm.urdf,
map.toml, calibration_1.csv and so on, test.csv and truth.csv.

Measurements stay as they are; the claimed commands change. For a steady-state error, the claim of
one motor is displaced by an error drawn anew for each movement, of 0.8 to 1.2 times its size. For
a stuck motor, poses that share the angle of this motor follow each other, and the claim says that
it was sent elsewhere. The load at the claimed pose differs from that at the real one. Call results
"relabelled real". Base and tool offset are fitted on the calibration poses, which are no test
poses, and positions are given in the base frame; with --raw they stay in the tracker's frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from failuretwin.core.types import FloatArray

H = np.pi / 2
ARMS = {
    "ur10": (
        [0, -0.612, -0.5723, 0, 0, 0],
        [0.1273, 0, 0, 0.163941, 0.1157, 0.0922],
        [H, 0, 0, H, -H, 0],
    ),
    "ur5": (
        [0, -0.425, -0.39225, 0, 0, 0],
        [0.089159, 0, 0, 0.10915, 0.09465, 0.0823],
        [H, 0, 0, H, -H, 0],
    ),
}
"""Denavit-Hartenberg a [m], d [m] and alpha [rad] of each joint; Universal Robots' tables."""
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
SIZES_DEG = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)
STUCK_WITHIN_DEG, AWAY_DEG = 0.5, 5.0
"""Poses share an angle within the first; a claim elsewhere is further than the second."""
CALIBRATION_SHARE = 0.4
SESSION_RUNS = 25
MOVEMENTS, PERIOD_S, RAMP_S, SEEN_S, STEP_S = 5, 3.0, 1.0, 1.5, 0.1


def read_poses(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return commanded angles (pose, joint) [rad] and tool positions (pose, axis) [m]."""
    if ";" in path.read_text(encoding="utf-8").partition("\n")[0]:
        table = pd.read_csv(path, sep=";", decimal=",")
        angles = table[[f"{joint}_joint" for joint in UR_JOINTS]].to_numpy(float)
        return angles, table[[f"measurement_{axis}" for axis in "xyz"]].to_numpy(float) / 1e3
    table = pd.read_csv(path)
    if "q1" in table:  # angles in rad, positions in m
        return table.filter(regex="^q").to_numpy(float), table[list("xyz")].to_numpy(float)
    target, beyond = (table[[f"{axis}{end}" for axis in "xyz"]] for end in ("_t", "_dif"))
    angles = np.radians(table.filter(regex="^joint_").to_numpy(float))
    return angles, (target.to_numpy(float) + beyond.to_numpy(float)) / 1e3


def flange(angles: FloatArray, arm: str) -> FloatArray:
    """Return the frames of the last link, (pose, 4, 4)."""
    frame = np.broadcast_to(np.eye(4), (len(angles), 4, 4))
    for angle, a, d, alpha in zip(angles.T, *ARMS[arm], strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        zero, one = np.zeros_like(c), np.ones_like(c)
        rows = [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [zero, sa * one, ca * one, d * one],
            [zero, zero, zero, one],
        ]
        frame = frame @ np.moveaxis(np.array(rows), -1, 0)
    return frame


def fit_frames(
    angles: FloatArray, seen: FloatArray, arm: str
) -> tuple[Rotation, FloatArray, FloatArray, float]:
    """Return the base's rotation and origin [m], the tool on the last axis [m], and rms [mm]."""
    frames = flange(angles, arm)
    point = frames[:, :3, 3]
    u, _, vt = np.linalg.svd((point - point.mean(0)).T @ (seen - seen.mean(0)))
    turn = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    start = np.r_[
        Rotation.from_matrix(turn).as_rotvec(), seen.mean(0) - turn @ point.mean(0), 0, 0, 0
    ]

    def residual(p: FloatArray) -> FloatArray:
        reached = point + frames[:, :3, :3] @ p[6:]
        placed = Rotation.from_rotvec(p[:3]).apply(reached) + p[3:6]
        return np.asarray(((seen - placed) * 1e3).ravel())

    tool = np.array([0.0, 0.0, least_squares(residual, start, loss="soft_l1").x[8]])

    def of_base(p: FloatArray) -> FloatArray:
        return residual(np.r_[p, tool])

    base = least_squares(of_base, start[:6], loss="soft_l1").x
    rms = float(np.sqrt(np.mean(residual(np.r_[base, tool]) ** 2) * 3))
    return Rotation.from_rotvec(base[:3]), base[3:6], tool, rms


def urdf(arm: str, tool: FloatArray) -> str:
    """Return the arm with its tool as URDF."""
    lines, parent, roll = [f'<robot name="{arm}"><link name="base"/>'], "base", 0.0
    xyz: tuple[float, float, float] = (0, 0, 0)
    for j, (a, d, alpha) in enumerate(zip(*ARMS[arm], strict=True), 1):
        lines.append(
            f'<link name="link_{j}"/><joint name="joint_{j}" type="revolute">'
            f'<parent link="{parent}"/><child link="link_{j}"/>'
            f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.2832" upper="6.2832" effort="150" velocity="2.0"/></joint>'
        )
        parent, xyz, roll = f"link_{j}", (a, 0, d), alpha
    at = Rotation.from_euler("x", roll).apply(tool) + np.array(xyz)
    lines.append(
        '<link name="tool"/><joint name="tool_fixed" type="fixed">'
        f'<parent link="{parent}"/><child link="tool"/>'
        f'<origin xyz="{at[0]:.6f} {at[1]:.6f} {at[2]:.6f}" rpy="0 0 0"/></joint></robot>'
    )
    return "\n".join(lines)


class Writer:
    """Collects runs and their truth, and writes them as CSV."""

    def __init__(self, motors: int) -> None:
        self.rows: list[list[object]] = []
        self.truth: list[list[object]] = []
        self.motors = motors

    def add(
        self,
        name: str,
        claim: FloatArray,
        tool: FloatArray,
        hypothesis: str = "healthy",
        size: float = np.nan,
        onset: float = np.nan,
    ) -> None:
        """Add a run that starts at rest; the tool is seen at rest alone."""
        for k in range(len(claim)):
            for i in range(round(PERIOD_S / STEP_S)):
                t = i * STEP_S
                share = min(1.0, t / RAMP_S)
                command = claim[k] if k == 0 else claim[k - 1] + share * (claim[k] - claim[k - 1])
                seen = tool[k] if t >= SEEN_S or k == 0 else [np.nan] * 3
                self.rows.append([name, round(k * PERIOD_S + t, 3), *command, *seen])
        self.truth.append([name, hypothesis, size, onset])

    def write(self, path: Path, truth: Path | None = None) -> None:
        """Write the runs, and their truth into a file of its own."""
        commands = [f"command_{j}" for j in range(1, self.motors + 1)]
        runs = pd.DataFrame(self.rows, columns=["run", "time", *commands, "x", "y", "z"])
        runs.to_csv(path, index=False, float_format="%.9g")
        if truth is not None:
            table = pd.DataFrame(self.truth, columns=["run", "truth", "size_deg", "onset_s"])
            table.to_csv(truth, index=False)


def column_map(motors: int) -> str:
    """Return the column map of the runs."""
    names = ", ".join(f'"command_{j}"' for j in range(1, motors + 1))
    return (
        'separator = ","\nrun = "run"\n[time]\ncolumn = "time"\nunit = "s"\n'
        f'[command]\ncolumns = [{names}]\nkind = "sampled"\nunit = "rad"\n'
        '[tool]\ncolumns = ["x", "y", "z"]\nunit = "m"\n'
    )


def add_faulty(
    writer: Writer, angles: FloatArray, place: FloatArray, per_cell: int, rng: np.random.Generator
) -> None:
    """Add the runs with errors and with stuck motors."""
    size, poses = MOVEMENTS + 1, np.arange(len(angles))
    for j in range(writer.motors):
        for degrees in SIZES_DEG:
            for r in range(per_cell):
                i = rng.choice(poses, size, replace=False)
                claim = angles[i, : writer.motors].copy()
                signs, share = rng.choice([-1, 1], size), rng.uniform(0.8, 1.2, size)
                claim[:, j] -= np.radians(degrees) * signs * share
                name = f"motor_{j + 1}_error_{degrees:g}_{r:02d}"
                fault = f"motor_{j + 1}:steady_state_error"
                writer.add(name, claim, place[i], fault, degrees, 0.0)
        for r in range(per_cell):
            first = int(rng.integers(1, 4))  # the first movement that the stuck motor spoils
            i = rng.choice(poses, size, replace=False)
            away = np.abs(angles[:, j] - angles[i[first - 1], j])
            near = np.argsort(away)
            i[first:] = rng.permutation(near[near != i[first - 1]][: size - first])
            if np.degrees(away[i[first:]].max()) > STUCK_WITHIN_DEG:  # no poses share the angle
                continue
            claim = angles[i, : writer.motors].copy()
            elsewhere = angles[away > np.radians(AWAY_DEG), j]
            claim[first:, j] = rng.choice(elsewhere, size - first)
            onset = first * PERIOD_S
            name = f"motor_{j + 1}_stuck_{r:02d}"
            writer.add(name, claim, place[i], f"motor_{j + 1}:stuck", onset=onset)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write all files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("poses", type=Path, nargs="+")
    parser.add_argument("arm", choices=ARMS)
    parser.add_argument("out", type=Path)
    parser.add_argument("--calibration", type=int, default=4, help="sessions of 25 healthy runs")
    parser.add_argument("--healthy", type=int, default=200, help="healthy test runs")
    parser.add_argument("--per-cell", type=int, default=10, help="runs of each motor and size")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--raw", action="store_true", help="positions in the tracker's frame")
    o = parser.parse_args(arguments)
    o.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(o.seed)
    angles, seen = (np.concatenate(parts) for parts in zip(*map(read_poses, o.poses), strict=True))
    cal, test = np.split(rng.permutation(len(angles)), [int(CALIBRATION_SHARE * len(angles))])
    turn, origin, tool, rms = fit_frames(angles[cal], seen[cal], o.arm)
    place = seen if o.raw else turn.inv().apply(seen - origin)
    motors = angles.shape[1] - 1  # the tool is on the last axis, within 1 mm: it shows nothing
    print(
        f"{o.arm}: {len(cal)} poses to calibrate, fitted to {rms:.2f} mm rms; {len(test)} to test"
    )
    (o.out / "arm.urdf").write_text(urdf(o.arm, tool), encoding="utf-8")
    (o.out / "map.toml").write_text(column_map(motors), encoding="utf-8")
    size = MOVEMENTS + 1
    for s in range(o.calibration):
        own, session = np.array_split(cal, o.calibration)[s], Writer(motors)
        for r in range(SESSION_RUNS):
            i = rng.choice(own, size, replace=False)
            session.add(f"session{s + 1}_{r:02d}", angles[i, :motors], place[i])
        session.write(o.out / f"calibration_{s + 1}.csv")
    writer, shuffled = Writer(motors), rng.permutation(test)
    for r in range(o.healthy):  # disjoint poses as long as they last, then drawn again
        i = shuffled[r * size : (r + 1) * size]
        i = i if len(i) == size else rng.choice(test, size, replace=False)
        writer.add(f"healthy_{r:04d}", angles[i, :motors], place[i])
    add_faulty(writer, angles[test], place[test], o.per_cell, rng)
    writer.write(o.out / "test.csv", o.out / "truth.csv")
    print(f"{len(writer.truth)} runs in {o.out / 'test.csv'}")


if __name__ == "__main__":
    main()
