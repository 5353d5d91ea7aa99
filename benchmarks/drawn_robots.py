"""Robots that nobody has seen, each calibrating itself, beside a calibration of its own.

    python benchmarks/drawn_robots.py [--robot armpi_fpv] [--robots 20] [--runs 45] [--engine servo]

Each robot is drawn from what its class is like: bias, sag, friction, and factors on scatter and
loss rates. It makes runs of the paper's classes, with errors of 1.2 to 4.8 degrees, and 40 healthy
ones. Its runs are judged each alone by the class, together (`--self-calibrate`), and by a
calibration from its healthy runs. With `--engine physics` the stiffness and the friction of its
gears are drawn by factors about the bundled ones; its own sag and friction come from there. Told is
also how often the 95 % intervals of what was learned hold the truth (servo engine alone).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import tomli_w
import xarray as xr
from telling import nats, right, share

import failuretwin as ft
from failuretwin.connection.calibration.result import Calibration
from failuretwin.core.hypothesis import Diagnosis, paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.digital_model.physics.motors import load_parameters
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES

ERRORS_RAD = (float(np.deg2rad(1.2)), float(np.deg2rad(4.8)))
STIFFNESS, FRICTION, SCATTER, LOSSES = 0.4, 0.5, 0.3, 0.7
"""Deviations of the logarithms of what robots differ by."""
HEALTHY = 40
METHODS = ("alone", "together", "own calibration")


@dataclass
class Told:
    """What was found of all robots so far."""

    found: Mapping[str, list[Diagnosis]] = field(default_factory=lambda: {m: [] for m in METHODS})
    held: int = 0
    asked: int = 0

    def lines(self) -> list[str]:
        """Return a line for each method, and one for the intervals."""
        lines = []
        for method, found in self.found.items():
            if not found:
                continue
            healthy = [d for d in found if d.truth == "healthy"]
            false = sum(d.diagnosis not in (None, "healthy") for d in healthy)
            lines.append(
                f"  {method:16} {share(int(right(found).sum()), len(found))}, "
                f"{nats(found).mean():.3f} nats; healthy called faulty {share(false, len(healthy))}"
            )
        if self.asked:
            lines.append(f"  intervals hold {share(self.held, self.asked)}")
        return lines


def drawn(robot: Robot, rng: np.random.Generator) -> Imperfections:
    """Return what one robot of the class is like."""
    kind = generic_imperfections(robot)
    assert kind.variation is not None
    motors = len(robot.motors)
    differ = replace(
        kind.variation,
        compliance=(STIFFNESS,) * motors,
        scatter=(SCATTER,) * motors,
        rates=LOSSES,
    )
    own = vary(replace(kind, variation=differ), rng)
    settling = own.settling
    assert settling is not None
    friction = tuple(np.abs(settling.friction).tolist())
    return replace(own, settling=replace(settling, friction=friction))


def with_gears(robot: Robot, rng: np.random.Generator, folder: Path) -> Robot:
    """Return a robot whose gears are softer or stiffer, and stick more or less."""
    parameters = load_parameters(robot)
    assert parameters is not None
    motors = []
    for motor in parameters.motors:
        soft, sticky = np.exp(rng.standard_normal(2) * (STIFFNESS, FRICTION))
        motors.append(
            replace(
                motor,
                stiffness=float(motor.stiffness * soft),
                flex_stiffness=float(motor.flex_stiffness * soft),
                friction=float(motor.friction * sticky),
            )
        )
    path = folder / "gears.toml"
    table = {"source": parameters.source, "motors": [asdict(motor) for motor in motors]}
    path.write_text(tomli_w.dumps(table))
    return replace(robot, profile=replace(robot.profile, physics=str(path)))


def made(
    robot: Robot,
    own: Imperfections,
    hypotheses: Sequence[str] | None,
    each: int,
    seed: int,
    engine: str,
) -> xr.Dataset:
    """Return runs of one robot."""
    modes = dict(MODES) | {"steady_state_error": SteadyStateError(magnitude=ERRORS_RAD)}
    return simulate(Plan(robot, hypotheses, each, seed, own, modes=modes, engine=engine))


def held(learned: Calibration, own: Imperfections, motors: Sequence[str]) -> tuple[int, int]:
    """Return how many of the identified offsets lie in their intervals, of how many."""
    settling = own.settling
    asked = [p for p in learned.parameters if p.identified]
    true = [getattr(settling, p.name)[motors.index(p.motor)] for p in asked]
    return sum(p.low <= t <= p.high for p, t in zip(asked, true, strict=True)), len(asked)


def judge(robot: Robot, number: int, runs: int, engine: str, told: Told) -> None:
    """Judge the runs of one robot in all ways."""
    rng = np.random.default_rng([number, 17])
    own = drawn(robot, rng)
    with tempfile.TemporaryDirectory() as folder:
        body = with_gears(robot, rng, Path(folder)) if engine == "physics" else robot
        classes = len(paper_hypotheses(robot.motor_names))
        made_runs = made(body, own, None, -(-runs // classes), number, engine)
        healthy = made(body, own, ["healthy"], HEALTHY, number + 10_000, engine)
    learned = ft.SelfCalibratingDiagnoser(robot).learn(made_runs)
    told.found["together"].extend(learned.diagnoses)
    told.found["alone"].extend(ft.BayesDiagnoser(robot, "generic").diagnose(made_runs))
    try:
        calibration = ft.calibrate(healthy, robot)
    except ft.InputError as error:
        print(f"robot {number}: its healthy runs are refused ({error})", flush=True)
    else:
        diagnoser = ft.BayesDiagnoser(robot, calibration.imperfections)
        told.found["own calibration"].extend(diagnoser.diagnose(made_runs))
    if engine == "servo":
        inside, asked = held(learned.calibration, own, robot.motor_names)
        told.held, told.asked = told.held + inside, told.asked + asked


def main() -> None:
    """Print what all robots give, after each of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--runs", type=int, default=45)
    parser.add_argument("--engine", choices=["servo", "physics"], default="servo")
    options = parser.parse_args()
    robot, told = load_robot(options.robot), Told()
    for number in range(options.robots):
        judge(robot, number, options.runs, options.engine, told)
        print(f"{robot.name}, {options.engine} engine, {number + 1} robots", flush=True)
        print("\n".join(told.lines()), flush=True)


if __name__ == "__main__":
    main()
