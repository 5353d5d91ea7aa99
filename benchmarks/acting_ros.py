"""The real parts end to end: `emulate --obey`, `watch` and `act` as processes, a roscore between.

    python benchmarks/acting_ros.py [--arms 12]

Each arm has its fault from the start, at one motor after the other. Shares of targets that `act`
reached within 5 mm by the sensor, "of" what some safe pose can reach, and what `watch` said last
before `act` had ended. Needs roscore.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from acting import TOLERANCE_M, possible, tasks_of
from acting_world import ERROR_RAD, SCALE

from failuretwin.decision.acting.task import Task
from failuretwin.digital_model.robot import Robot, load_robot

FAULTS = ("stuck", "steady_state_error", "encoder_bias", "encoder_scale")
LONGEST_S = 300.0


def main() -> None:
    """Print shares by fault."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", type=int, default=12)
    parser.add_argument("--targets", type=int, default=6)
    parser.add_argument("--port", type=int, default=11411)
    told = parser.parse_args()
    robot = load_robot("armpi_fpv")
    environment = os.environ | {
        "ROS_MASTER_URI": f"http://127.0.0.1:{told.port}",
        "ROS_IP": "127.0.0.1",
    }
    with tempfile.TemporaryDirectory() as folder:
        master = _start(["roscore", "-p", str(told.port)], environment, Path(folder) / "roscore")
        time.sleep(4.0)
        try:
            for fault in FAULTS:
                _report(fault, robot, environment, Path(folder), told)
        finally:
            _stop(master)


def _report(
    fault: str, robot: Robot, environment: dict[str, str], folder: Path, told: argparse.Namespace
) -> None:
    hits, could, movements, named = 0, 0, [], 0
    for arm in range(told.arms):
        motor = arm % len(robot.motors)
        rng = np.random.default_rng([arm, FAULTS.index(fault)])
        task = tasks_of(robot, 1, told.targets, 100 + arm)[0]
        held = np.nan
        if fault == "stuck":
            size = held = float(rng.uniform(*robot.motors[motor].movement_range))
        else:
            low, high = SCALE if fault == "encoder_scale" else ERROR_RAD
            size = float(rng.uniform(low, high))
        name = f"{robot.motor_names[motor]}:{fault}"
        rows, said = _act(f"{name}={size:.4f}", task, arm, environment, folder)
        known = [{"held": held, "motor": motor + 1, "target": list(t.position)}
                 for t in task.targets]  # fmt: skip
        here = sum(row["reached"] for row in rows)
        hits, could = hits + here, could + int(possible(robot, known).sum())
        movements += [row["movements"] for row in rows]
        named += f"motor {motor + 1}" in said
        print(f"  {name} {size:+.2f}: {here} of {len(rows)}; watch: {said}", flush=True)
    print(
        f"{fault:20s} {hits} of {could} reached within {1e3 * TOLERANCE_M:.0f} mm "
        f"[{np.mean(movements):.1f}], watch named the motor on {named} of {told.arms}",
        flush=True,
    )


def _act(
    fault: str, task: Task, seed: int, environment: dict[str, str], folder: Path
) -> tuple[list[dict[str, bool]], str]:
    """Return what became of the targets, and the last that `watch` said of the arm."""
    csv, out, heard = (folder / name for name in ("task.csv", "out.jsonl", "watch"))
    points = "".join(f"{x},{y},{z}\n" for x, y, z in (t.position for t in task.targets))
    csv.write_text("x,y,z\n" + points)
    out.unlink(missing_ok=True)
    ours = [sys.executable, "-m", "failuretwin"]
    emulate = ["emulate", "--obey", "--fault", fault, "--seed", str(seed)]
    others = [_start([*ours, *emulate], environment, folder / "emulate")]
    time.sleep(3.0)
    others.append(_start([*ours, "watch", "ros1"], environment, heard))
    time.sleep(2.0)
    act = ["act", str(csv), "--on", "ros1", "--move", "--json", str(out)]
    try:
        subprocess.run([*ours, *act], env=environment, capture_output=True, timeout=LONGEST_S)
        lines = [line for line in heard.read_text().splitlines() if "  ALARM: " in line]
    finally:
        for process in others:
            _stop(process)
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    return rows, lines[-1].strip() if lines else ""


def _start(command: list[str], environment: dict[str, str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as file:
        return subprocess.Popen(
            command, env=environment, stdout=file, stderr=subprocess.STDOUT, start_new_session=True
        )


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(15.0)
    except subprocess.TimeoutExpired:
        process.kill()


if __name__ == "__main__":
    main()
