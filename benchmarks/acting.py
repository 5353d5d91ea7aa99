"""Closed loop: how many targets arms with a fault still reach, and with how many movements.

Arms in lockstep on the physics engine (`--engine physics`) or at rest only (`servo`), strategies
sharing arms, targets, faults and bad luck:

    open      one movement a target, by the calibrated settling
    feedback  what the tool misses is corrected by the nominal Jacobian; lost commands sent again
    diagnose  the same on the arm as it is believed to be (`failuretwin.decision.acting`)
    oracle    the same, the fault known at once and exactly

    python benchmarks/acting.py --robot armpi_fpv --fault stuck --arms 40 --json stuck.json

A target counts if work on it ended after the onset. "of what can be reached": beside the share of
targets that a pose with the motor held at its true angle reaches (inverse kinematics, many starts).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from failuretwin.connection.links.commander import Order
from failuretwin.core.hypothesis import Fault
from failuretwin.decision.acting.actor import ActingSettings, Actor
from failuretwin.decision.acting.belief import BeliefSettings, Judge, LatchedBelief, NoBelief
from failuretwin.decision.acting.believed_arm import BelievedFault, Seen
from failuretwin.decision.acting.planner import Planner
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import Task
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.nonidealities import vary
from failuretwin.digital_model.physics_engine import LiveArms, PhysicsEngine
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.inference.healthy_model import HealthyModel

STEP_S = 0.01
SETTLE_S = 0.8
"""Time at rest after the longest ramp [s]."""
ONSET = 4
"""Movements before the fault begins."""
TOLERANCE_M = 0.005
BIAS_RAD = float(np.deg2rad(0.3))
"""Unknown constant errors of arms that nobody has calibrated, their deviation [rad]."""
REPEAT_RAD = float(np.deg2rad(0.011))
"""Their scatter from movement to movement [rad]."""
ERROR_RAD = (float(np.deg2rad(2.4)), float(np.deg2rad(12.0)))
"""Random and constant errors, 10 to 50 counts of 0.24 deg [rad]."""
SCALE = (0.1, 0.6)
MOST_STEPS = 90

MODES = {
    "healthy": "",
    "stuck": "stuck",
    "random": "steady_state_error",
    "bias": "encoder_bias",
    "scale": "encoder_scale",
    "torque": "torque_loss",
    "lost": "lost_commands",
}


@dataclass(frozen=True)
class TrueFault:
    """The fault of one arm: a kind of `MODES` at a motor; size in the unit of its mode."""

    kind: str
    motor: int = 0
    size: float = np.nan


@dataclass
class World:
    """Arms in lockstep, one movement at a time."""

    known: CalibratedRobot
    faults: Sequence[TrueFault]
    seed: int
    engine: str
    redrawn_at_rest: bool = False
    onset: int = ONSET
    count: int = 0
    lost: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        robot, n = self.known.robot, len(self.faults)
        self.robot, self.m = robot, len(robot.motors)
        self.twin = self.known.twin
        self.rngs = [np.random.default_rng([self.seed, i]) for i in range(n)]
        self.own = [self._own(rng) for rng in self.rngs]
        self.settling = [own.settling or Settling.ideal(self.m) for own in self.own]
        self.bias, self.friction, self.scatter, self.compliance = (
            np.array([getattr(s, name) for s in self.settling])
            for name in ("bias", "friction", "scatter", "compliance")
        )
        self.commanded = self.home = np.tile(_home(robot), (n, 1))
        self.base = self.home + self.bias
        self.error = np.zeros(n)
        self.held = np.full(n, np.nan)
        self.time_s = 0.0
        if self.engine == "physics":
            self.arms = LiveArms(PhysicsEngine(robot), self.base, STEP_S, np.zeros(n))
            self.angle = self.arms.angle
        else:
            self.angle = self._rest(np.zeros((n, self.m), dtype=bool))

    def _own(self, rng: np.random.Generator) -> object:
        """Return what this very arm is like."""
        figures = self.known.imperfections
        if self.robot.imperfections_file is not None:
            return vary(figures, rng)
        zero = (0.0,) * self.m
        settling = Settling(
            tuple(BIAS_RAD * rng.standard_normal(self.m)), zero, zero, (REPEAT_RAD,) * self.m, 4.0
        )
        return replace(figures, settling=settling, lost_commands=(), variation=None)

    def move(self, orders: Sequence[Order]) -> np.ndarray:
        """Carry out an order of each arm; return where the tools are seen at rest, (arm, 3)."""
        self.count += 1
        target = np.array([order.target for order in orders])
        ramp = np.array([order.duration for order in orders])
        still = np.abs(target - self.commanded) < 1e-9
        aim, scatter, held = target.copy(), np.empty_like(target), np.zeros(target.shape, bool)
        self.lost = np.zeros(target.shape, dtype=bool)
        weak = np.zeros(target.shape)
        noise = np.zeros((len(target), 3))
        for i, (fault, rng) in enumerate(zip(self.faults, self.rngs, strict=True)):
            dof = self.settling[i].tail_dof
            scatter[i] = (
                rng.standard_normal(self.m) if np.isinf(dof) else rng.standard_t(dof, self.m)
            )
            self._lose(i, rng.random())
            noise[i] = rng.standard_normal(3)
            luck = rng.random(3)
            if self.count > self.onset:
                self._strike(i, fault, luck, aim, held, weak, still)
        scatter *= self.scatter
        friction = 0.0 if self.engine == "physics" else self.friction
        new = aim + self.bias - friction * np.sign(target - self.commanded) + scatter
        keeps = still if not self.redrawn_at_rest else np.zeros_like(still)
        new = np.where(keeps | self.lost, self.base, new)
        self.commanded = np.where(self.lost, self.commanded, target)
        before, self.base = self.base, new
        period = float(ramp.max()) + SETTLE_S
        self.time_s += period
        if self.engine == "physics":
            self._drive(before, ramp, period, held, weak)
        else:
            self.angle = self._rest(held, weak)
        return self._seen(noise)

    def _lose(self, i: int, chance: float) -> None:
        below, names = 0.0, self.robot.motor_names
        for entry in self.own[i].lost_commands:
            if below <= chance < below + entry.rate:
                self.lost[i, [names.index(motor) for motor in entry.motors]] = True
            below += entry.rate

    def _strike(self, i, fault, luck, aim, held, weak, still) -> None:  # noqa: ANN001
        k = fault.motor
        if fault.kind == "stuck":
            if np.isnan(self.held[i]):
                self.held[i] = self.angle[i, k]
            held[i, k] = True
        elif fault.kind == "random":
            if self.redrawn_at_rest or not still[i, k] or self.error[i] == 0.0:
                sign = 1.0 if luck[0] < 0.5 else -1.0
                self.error[i] = sign * (ERROR_RAD[0] + luck[1] * (ERROR_RAD[1] - ERROR_RAD[0]))
            aim[i, k] += self.error[i]
        elif fault.kind == "bias":
            aim[i, k] += fault.size
        elif fault.kind == "scale":
            aim[i, k] *= 1.0 + fault.size
        elif fault.kind == "torque":
            weak[i, k] = fault.size
        elif fault.kind == "lost":
            self.lost[i, k] |= luck[2] < fault.size

    def _rest(self, held: np.ndarray, weak: np.ndarray | None = None) -> np.ndarray:
        give = self.compliance / (1.0 - (0.0 if weak is None else weak))
        stand = np.where(held, self.held[:, None], self.base)
        near = stand
        for _ in range(3):
            near = np.where(held, stand, self.base + sag(self.robot, near, give, 0.0))
        return near

    def _drive(self, before, ramp, period, held, weak) -> None:  # noqa: ANN001
        t = np.arange(1, round(period / STEP_S) + 1)[None, :, None] * STEP_S
        share = np.clip(t / ramp[:, None], 0.0, 1.0)
        reference = before[:, None] + share * (self.base - before)[:, None]
        steps = reference.shape[1]
        brake = np.repeat(held[:, None], steps, axis=1) if held.any() else None
        weakness = np.repeat(weak[:, None], steps, axis=1) if weak.any() else None
        self.angle = self.arms.follow(reference, brake, weakness)[:, -1]

    def _seen(self, noise: np.ndarray) -> np.ndarray:
        readings, angle = self.known.imperfections.readings, self.angle
        if readings is not None and readings.whole_counts:
            units = self.robot.servo_units
            angle = units.to_rad(np.round(units.to_counts(angle)))
        noise_m = 0.0005 if readings is None else readings.noise_m
        return self.twin.path(angle) + noise_m * noise

    @property
    def tool(self) -> np.ndarray:
        """Where the tools really are, (arm, 3) [m]."""
        return self.twin.path(self.angle)


def _home(robot: Robot) -> np.ndarray:
    return np.array([float(np.clip(0.0, *motor.movement_range)) for motor in robot.motors])


@dataclass
class Told:
    """An oracle's belief: the true fault, from its onset on."""

    world: World
    arm: int
    believed: BelievedFault | None = None
    window: Sequence[Seen] = ()
    confirmed: bool = True

    def add(self, seen: Seen) -> None:
        fault = self.world.faults[self.arm]
        if self.world.count >= self.world.onset and fault.kind != "healthy":
            held = self.world.held[self.arm]
            angle = held if np.isfinite(held) else self.world.angle[self.arm, fault.motor]
            rests = self.believed.angle if self.believed is not None else np.nan
            motor = self.world.robot.motor_names[fault.motor]
            self.believed = BelievedFault(
                Fault(motor, MODES[fault.kind]),
                fault.motor,
                angle if fault.kind == "stuck" else fault.size,
                1e-4,
                0.0,
                angle if fault.kind == "stuck" else rests,
            )

    def take(self, seen: Seen, judgement: object) -> str:
        return ""

    def stands_at(self, angle: float, spread: float) -> None:
        if self.believed is not None:
            self.believed = replace(self.believed, angle=angle, spread=spread)


@dataclass
class Outcome:
    """What became of the arms of one strategy."""

    rows: list[dict]
    judged_s: float
    planned_s: float
    wall_s: float


def run(
    known: CalibratedRobot,
    faults: Sequence[TrueFault],
    tasks: Sequence[Task],
    strategy: str,
    seed: int,
    engine: str,
    wrong: Sequence[BelievedFault | None] | None = None,
    redrawn_at_rest: bool = False,
    new_diagnoses: bool = True,
    onset: int = ONSET,
) -> Outcome:
    """Carry out a task on each arm."""
    began = time.monotonic()
    world = World(known, faults, seed, engine, redrawn_at_rest, onset)
    model = HealthyModel.of(known.twin, known.imperfections)
    planner = Planner(SafetyGate(known.robot))
    judge = Judge(model)
    settings = ActingSettings(feedback=strategy != "open")
    actors = []
    for i, task in enumerate(tasks):
        belief = NoBelief()
        if strategy == "diagnose":
            latch = BeliefSettings() if new_diagnoses else BeliefSettings(latch=2.0)
            belief = LatchedBelief(model, latch, None if wrong is None else wrong[i])
        elif strategy == "oracle":
            belief = Told(world, i)
        actors.append(Actor(planner, model, task, belief, world.home[i], settings))
    rows: list[dict] = []
    done = [0] * len(actors)
    latched = [np.nan] * len(actors)
    judged = planned = 0.0
    for _ in range(MOST_STEPS):
        t = time.process_time()
        orders, working = [], []
        for i, actor in enumerate(actors):
            order = actor.next()
            while len(actor.results) > done[i]:  # given up without a movement
                rows.append(_row(actor.results[done[i]], world, i, latched[i]))
                done[i] += 1
            working.append(order is not None)
            orders.append(order or Order(world.commanded[i], np.full(world.m, 0.4)))
        planned += time.process_time() - t
        if not any(working):
            break
        start = world.time_s
        points = world.move(orders)
        t = time.process_time()
        for i, actor in enumerate(actors):
            if working[i]:
                actor.see(points[i], start, world.time_s)
        windows = [actor.window if works else () for actor, works in zip(actors, working)]
        judgements = judge(windows, [actor.belief.believed for actor in actors])
        judged += time.process_time() - t
        tool = world.tool
        for i, actor in enumerate(actors):
            if not working[i]:
                continue
            actor.learn(judgements[i])
            believed, fault = actor.belief.believed, faults[i]
            if np.isnan(latched[i]) and believed is not None and world.count > onset:
                if believed.motor == fault.motor and believed.fault.mode == MODES[fault.kind]:
                    latched[i] = world.count - onset
            if len(actor.results) > done[i]:
                error = float(np.linalg.norm(tool[i] - actor.results[-1].target.point))
                rows.append(_row(actor.results[-1], world, i, latched[i], error))
                done[i] += 1
    for i, actor in enumerate(actors):
        rows.append(
            {"arm": i, "said": actor.said, "latched": latched[i], "fault": faults[i].kind,
             "motor": faults[i].motor + 1, "false": _false(actor, faults[i]),
             "held": float(world.held[i])}
        )  # fmt: skip
    return Outcome(rows, judged, planned, time.monotonic() - began)


def _false(actor: Actor, fault: TrueFault) -> bool:
    """Return whether in the end another fault than the true one is believed."""
    believed = actor.belief.believed
    if believed is None:
        return False
    right = believed.motor == fault.motor and believed.fault.mode == MODES[fault.kind]
    return not right


def _row(result, world: World, i: int, latched: float, error: float = np.inf) -> dict:  # noqa: ANN001
    fault = world.faults[i]
    return {
        "arm": i, "fault": fault.kind, "motor": fault.motor + 1, "count": world.count,
        "error_m": error, "seen_m": result.error_m, "first_m": result.first_error_m,
        "movements": result.movements, "reachable": result.reachable, "latched": latched,
        "believed": result.believed, "target": list(result.target.position), "why": result.why,
        "held": float(world.held[i]),
    }  # fmt: skip


def tasks_of(robot: Robot, arms: int, targets: int, seed: int) -> list[Task]:
    """Return a task of each arm: where random poses in the usual ranges bring the tool."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    kinematics = InverseKinematics.of(robot)
    found = []
    for i in range(arms):
        rng = np.random.default_rng([seed, 77, i])
        pose = rng.uniform(low, high, (targets, len(low)))
        found.append(Task.of_points(kinematics.tool(pose)[0], TOLERANCE_M))
    return found


def ceiling(robot: Robot, rows: Sequence[dict]) -> np.ndarray:
    """Return which targets can be reached with the motor at its true held angle, (row,)."""
    kinematics, rng = InverseKinematics.of(robot), np.random.default_rng(5)
    found = np.zeros(len(rows), dtype=bool)
    for i, row in enumerate(rows):
        if not np.isfinite(row["held"]):
            found[i] = True
            continue
        start = kinematics.starts(24, rng)
        locked = np.zeros(start.shape[1], dtype=bool)
        k = row["motor"] - 1
        locked[k], start[:, k] = True, row["held"]
        miss = kinematics.solve(np.array([row["target"]]), start, locked).miss_m
        found[i] = miss.min() <= TOLERANCE_M
    return found


def summary(robot: Robot, outcome: Outcome) -> dict[str, dict]:
    """Return the figures of each fault and motor."""
    told = [row for row in outcome.rows if "said" in row]
    rows = [r for r in outcome.rows if "said" not in r and r["count"] > ONSET]
    possible = ceiling(robot, rows)
    found: dict[str, dict] = {}
    for key in sorted({(r["fault"], r["motor"]) for r in rows}):
        mine = np.array([(r["fault"], r["motor"]) == key for r in rows])
        chosen = [r for r, m in zip(rows, mine, strict=True) if m]
        arms = [r for r in told if (r["fault"], r["motor"]) == key]
        hit = np.array([r["error_m"] <= TOLERANCE_M for r in chosen])
        latched = np.array([r["latched"] for r in arms])
        found[f"{key[0]} m{key[1]}"] = {
            "targets": len(chosen),
            "reached": float(hit.mean()),
            "possible": float(possible[mine].mean()),
            "hits": int(hit.sum()),
            "could": int(possible[mine].sum()),
            "movements": float(np.mean([r["movements"] for r in chosen])),
            "first": float(np.mean([r["first_m"] <= TOLERANCE_M for r in chosen])),
            "latched_3": float(np.mean(latched <= 3)),
            "latched": float(np.mean(np.isfinite(latched))),
            "false": float(np.mean([r["false"] for r in arms])),
            "unreachable_told_right": float(
                np.mean([r["reachable"] == p for r, p in zip(chosen, possible[mine], strict=True)])
            ),
        }
    return found


def faults_of(kind: str, robot: Robot, arms: int, seed: int) -> list[TrueFault]:
    """Return `arms` faults of a kind at each motor; of healthy ones just as many in all."""
    if kind == "healthy":
        return [TrueFault("healthy")] * arms
    rng, found = np.random.default_rng([seed, 5]), []
    for k in range(len(robot.motors)):
        for _ in range(arms):
            sign = 1.0 if rng.random() < 0.5 else -1.0
            ends = {"bias": ERROR_RAD, "scale": SCALE, "torque": (0.4, 0.7), "lost": (0.5, 0.5)}
            size = sign * rng.uniform(*ends[kind]) if kind in ends else np.nan
            found.append(TrueFault(kind, k, abs(size) if kind in ("torque", "lost") else size))
    return found


def forced(known: CalibratedRobot, arms: int, targets: int, seed: int, engine: str) -> dict:
    """Return shares reached by truth and wrong belief of the nine classes, and by feedback alone.

    The belief is there from the start, and so is the fault. `checked`: it may be let go of, but no
    other is taken up; `diagnosed`: the product as it is.
    """
    robot = known.robot
    kinds = [
        ("healthy", 0),
        *((k, m) for k in ("stuck", "random") for m in range(len(robot.motors))),
    ]
    truths, beliefs, rng = [], [], np.random.default_rng([seed, 9])
    for truth in kinds:
        for belief in kinds[1:]:
            if belief == truth:
                continue
            for _ in range(arms):
                truths.append(TrueFault(*truth))
                low, high = robot.travel[belief[1]]
                angle = float(rng.uniform(low, high)) if belief[0] == "stuck" else np.nan
                fault = Fault(robot.motor_names[belief[1]], MODES[belief[0]])
                beliefs.append(BelievedFault(fault, belief[1], angle, 0.02, 0.0, angle))
    tasks = tasks_of(robot, len(truths), targets, seed)
    found: dict[str, dict[str, float]] = {}
    for name, strategy, wrong, new in (
        ("feedback", "feedback", None, True),
        ("checked", "diagnose", beliefs, False),
        ("diagnosed", "diagnose", beliefs, True),
    ):
        outcome = run(
            known, truths, tasks, strategy, seed, engine,
            wrong=wrong, new_diagnoses=new, onset=0,
        )  # fmt: skip
        print(f"{name}: {outcome.wall_s:.0f} s", flush=True)
        for row in outcome.rows:
            if "said" in row:
                continue
            belief, truth = beliefs[row["arm"]], truths[row["arm"]]
            sort = "healthy" if truth.kind == "healthy" else (
                "same motor" if truth.motor == belief.motor else "another motor"
            )  # fmt: skip
            pair = f"{truth.kind}, believed {belief.fault.mode} ({sort})"
            cell = found.setdefault(pair, {})
            cell[name] = cell.get(name, 0) + (row["error_m"] <= TOLERANCE_M)
            cell[f"n {name}"] = cell.get(f"n {name}", 0) + 1
    for pair, cell in found.items():
        shares = [
            f"{n} {cell[n] / cell[f'n {n}']:.3f}" for n in ("feedback", "checked", "diagnosed")
        ]
        print(f"  {pair:60s} {'  '.join(shares)}  n {cell['n feedback']}", flush=True)
    return found


def main() -> None:
    """Run one robot and kind of fault and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--fault", default="stuck", choices=list(MODES))
    parser.add_argument("--strategy", nargs="*", default=["open", "feedback", "diagnose", "oracle"])
    parser.add_argument("--engine", default="physics", choices=["physics", "servo"])
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--redrawn-at-rest", action="store_true")
    parser.add_argument("--forced", action="store_true", help="wrong beliefs from the start")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    known = load_calibration(None, told.robot)
    if told.forced:
        cells = forced(known, told.arms, told.targets, told.seed, told.engine)
        if told.json:
            told.json.write_text(json.dumps(cells))
        return
    faults = faults_of(told.fault, known.robot, told.arms, told.seed)
    tasks = tasks_of(known.robot, len(faults), told.targets, told.seed)
    found = {}
    for strategy in told.strategy:
        outcome = run(
            known, faults, tasks, strategy, told.seed, told.engine,
            redrawn_at_rest=told.redrawn_at_rest,
        )  # fmt: skip
        found[strategy] = {"cells": summary(known.robot, outcome), "rows": outcome.rows}
        moves = sum(("said" not in r and r["movements"]) or 0 for r in outcome.rows)
        print(
            f"{told.robot} {told.fault} {strategy}: {outcome.wall_s:.0f} s, judging "
            f"{1e3 * outcome.judged_s / max(moves, 1):.1f} ms, planning "
            f"{1e3 * outcome.planned_s / max(moves, 1):.1f} ms a movement"
        )
        for name, cell in found[strategy]["cells"].items():
            print(
                f"  {name:12s} {cell['reached']:.2f} of {cell['possible']:.2f} "
                f"[{cell['movements']:.1f}] first {cell['first']:.2f} n {cell['targets']} "
                f"latched {cell['latched']:.2f} in 3: {cell['latched_3']:.2f} "
                f"wrong {cell['false']:.2f} told {cell['unreachable_told_right']:.2f}",
                flush=True,
            )
        if told.json:
            told.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
