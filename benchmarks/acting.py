"""Closed loop: how many targets arms with a fault still reach, and with how many movements.

Arms in lockstep on the physics engine (`--engine physics`) or at rest only (`servo`), strategies
sharing arms, targets, faults and bad luck:

    open      one movement a target, by the calibrated settling
    feedback  what the tool misses is corrected by the nominal Jacobian; lost commands sent again
    diagnose  the same on the arm as it is believed to be (`failuretwin.decision.acting`)
    oracle    the same, the fault known at once and exactly

    python benchmarks/acting.py --robot armpi_fpv --fault stuck --arms 40 --json stuck.json
    python benchmarks/acting.py --forced --arms 4 --engine servo

A target counts if work on it ended after the onset. "of": the share that some pose with the motor
at its true held angle reaches, off the floor and the arm's own links, by many starts of the inverse
kinematics. `--forced`: wrong beliefs.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from acting_world import ERROR_RAD, MODES, ONSET, TrueFault, World

from failuretwin.connection.links.base import Order
from failuretwin.core.hypothesis import Fault, Hypothesis, single_faults
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.belief import ACTED_ON, CAP, LATCH, Belief, Judge, Judgement
from failuretwin.decision.acting.believed_arm import BelievedFault, Seen
from failuretwin.decision.acting.planner import Planner
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import ActingSettings, TargetResult, Task
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.observation.healthy_model import HealthyModel

TOLERANCE_M = 0.005
MOST_STEPS = 90
SCALE = (0.1, 0.6)
DRIFT = (0.01, 0.02)
HELD_SHARE = (0.2, 0.6)
STRATEGIES = ("open", "feedback", "diagnose", "oracle")
NEVER = 2.0
"""A probability that is never reached."""
Row = dict[str, Any]


@dataclass
class Told(Belief):
    """An oracle's belief: the true fault, from its onset on."""

    world: World = field(kw_only=True)
    arm: int = field(kw_only=True)
    lead: float = CAP

    def add(self, seen: Seen) -> None:
        """Look up what is the matter."""
        fault, world = self.world.faults[self.arm], self.world
        if world.count < world.onset or fault.kind == "healthy":
            return
        held = world.held[self.arm]
        angle = held if np.isfinite(held) else world.angle[self.arm, fault.motor]
        rests = np.nan if self.believed is None else self.believed.angle
        stuck = bool(np.isfinite(held))
        self.believed = BelievedFault(
            Fault(world.robot.motor_names[fault.motor], "stuck" if stuck else MODES[fault.kind]),
            fault.motor,
            float(angle) if stuck else fault.size,
            1e-4,
            0.0,
            float(angle) if stuck else rests,
        )

    def take(self, seen: Seen, judgement: Judgement | None) -> str:
        """Learn nothing: all is known."""
        return ""


@dataclass(frozen=True)
class Trial:
    """Arms with faults and tasks, alike for every strategy."""

    known: CalibratedRobot
    faults: Sequence[TrueFault]
    tasks: Sequence[Task]
    seed: int
    engine: str
    redrawn_at_rest: bool = False
    onset: int = ONSET


@dataclass
class Loop:
    """The arms of a trial at work with one strategy."""

    trial: Trial
    strategy: str
    wrong: Sequence[BelievedFault] = ()
    new_diagnoses: bool = True
    unweighed: Sequence[str] = ()
    rows: list[Row] = field(default_factory=list)
    judged_s: float = 0.0
    planned_s: float = 0.0

    def __post_init__(self) -> None:
        trial = self.trial
        self.world = World(trial.known, trial.faults, trial.seed, trial.engine,
                           trial.redrawn_at_rest, trial.onset)  # fmt: skip
        self.model = HealthyModel.of(trial.known.twin, trial.known.imperfections)
        judge = Judge(self.model, self._weighed()) if self.strategy == "diagnose" else None
        planner = Planner(SafetyGate(trial.known.robot))
        settings = ActingSettings(feedback=self.strategy != "open")
        self.said: list[list[str]] = [[] for _ in trial.tasks]
        self.actors = [
            Actor(
                planner,
                self.model,
                task,
                self._belief(i),
                self.world.home[i],
                settings,
                judge,
                self.said[i].append,
            )
            for i, task in enumerate(trial.tasks)
        ]
        self.latched = np.full(len(self.actors), np.nan)
        self.told = np.zeros(len(self.actors), dtype=np.int64)

    def _weighed(self) -> Sequence[Hypothesis]:
        modes = [mode for mode in ACTED_ON if mode not in self.unweighed]
        return single_faults(self.model.motor_names, modes)

    def _belief(self, arm: int) -> Belief:
        if self.strategy == "oracle":
            return Told(self.model, world=self.world, arm=arm)
        believed = self.wrong[arm] if self.wrong and self.strategy == "diagnose" else None
        return Belief(self.model, believed, latch=LATCH if self.new_diagnoses else NEVER)

    def run(self) -> Loop:
        """Work until every task is over."""
        for _ in range(MOST_STEPS):
            if not self._step():
                break
        for arm, actor in enumerate(self.actors):
            believed = actor.belief.believed
            wrong = believed is not None and not self._is_right(arm, believed)
            self.rows.append(self._of_arm(arm) | {"said": self.said[arm], "false": wrong})
        return self

    def _step(self) -> bool:
        """Order, move, see and learn once; return whether any arm still works."""
        began = time.process_time()
        orders = [actor.next() for actor in self.actors]
        self._report(np.full(len(orders), np.inf))
        self.planned_s += time.process_time() - began
        works = [i for i, order in enumerate(orders) if order is not None]
        if not works:
            return False
        start, rest = self.world.time_s, np.full(self.world.m, 0.4)
        still = self.world.commanded
        points = self.world.move([order or Order(still[i], rest) for i, order in enumerate(orders)])
        aims = {i: self.actors[i].target.point for i in works}
        began = time.process_time()
        for i in works:
            self.actors[i].see(points[i], start, self.world.time_s)
            self._note_latch(i)
        self.judged_s += time.process_time() - began
        error = np.full(len(orders), np.inf)
        for i in works:
            error[i] = np.linalg.norm(self.world.tool[i] - aims[i])
        self._report(error)
        return True

    def _is_right(self, arm: int, believed: BelievedFault) -> bool:
        fault, stopped = self.trial.faults[arm], np.isfinite(self.world.held[arm])
        modes = {MODES[fault.kind], "stuck"} if stopped else {MODES[fault.kind]}
        return believed.motor == fault.motor and believed.fault.mode in modes

    def _note_latch(self, arm: int) -> None:
        believed, since = self.actors[arm].belief.believed, self.world.count - self.trial.onset
        if np.isnan(self.latched[arm]) and believed is not None and since > 0:
            self.latched[arm] = since if self._is_right(arm, believed) else np.nan

    def _report(self, error: FloatArray) -> None:
        """Write down targets that are over; `error` is where the tool really is, (arm,) [m]."""
        for arm, actor in enumerate(self.actors):
            while self.told[arm] < len(actor.results):
                result = actor.results[self.told[arm]]
                self.rows.append(self._of_arm(arm) | self._of_result(result, error[arm]))
                self.told[arm] += 1

    def _of_arm(self, arm: int) -> Row:
        fault = self.trial.faults[arm]
        held, latched = float(self.world.held[arm]), float(self.latched[arm])
        stopped = fault.kind == "intermittent" and np.isfinite(held)
        kind = "stopped" if stopped else fault.kind
        known = {"arm": arm, "fault": kind, "motor": fault.motor + 1}
        return known | {"held": held, "latched": latched}

    def _of_result(self, result: TargetResult, error: float) -> Row:
        return {"count": self.world.count, "error_m": float(error), "first_m": result.first_error_m,
                "movements": result.movements, "reachable": result.reachable,
                "target": list(result.target.position), "why": result.why}  # fmt: skip


def tasks_of(robot: Robot, arms: int, targets: int, seed: int) -> list[Task]:
    """Return a task of each arm: where random poses in the usual ranges bring the tool."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    kinematics, found = InverseKinematics.of(robot), []
    for i in range(arms):
        pose = np.random.default_rng([seed, 77, i]).uniform(low, high, (targets, len(low)))
        found.append(Task.of_points(kinematics.tool(pose)[0], TOLERANCE_M))
    return found


def faults_of(kind: str, robot: Robot, arms: int, seed: int) -> list[TrueFault]:
    """Return `arms` faults of a kind at each motor; of healthy ones so many in all."""
    if kind == "healthy":
        return [TrueFault("healthy")] * arms
    ends = {
        "bias": ERROR_RAD,
        "scale": SCALE,
        "torque": (0.4, 0.7),
        "lost": (0.5, 0.5),
        "drift": DRIFT,
        "intermittent": HELD_SHARE,
    }
    rng, found = np.random.default_rng([seed, 5]), []
    for motor in range(len(robot.motors)):
        for _ in range(arms):
            sign = 1.0 if rng.random() < 0.5 or kind in ("torque", "lost", "intermittent") else -1.0
            size = sign * rng.uniform(*ends[kind]) if kind in ends else np.nan
            found.append(TrueFault(kind, motor, float(size)))
    return found


def possible(robot: Robot, rows: Sequence[Row]) -> BoolArray:
    """Return which targets can be reached with the motor at its true held angle, (row,)."""
    kinematics, rng = InverseKinematics.of(robot), np.random.default_rng(5)
    found, gate = np.ones(len(rows), dtype=bool), SafetyGate(robot)
    for i, row in enumerate(rows):
        if np.isfinite(row["held"]):
            start, locked = kinematics.starts(24, rng), np.zeros(len(robot.motors), dtype=bool)
            k = row["motor"] - 1
            locked[k], start[:, k] = True, row["held"]
            poses = kinematics.solve(np.array([row["target"]]), start, locked)
            safe = gate.clearance.margin(poses.pose) >= gate.margin_m
            found[i] = bool((safe & (poses.miss_m <= TOLERANCE_M)).any())
    return found


def summary(robot: Robot, loop: Loop) -> dict[str, dict[str, float]]:
    """Return the figures of each fault and motor."""
    rows = [r for r in loop.rows if "said" not in r and r["count"] > loop.trial.onset]
    could, found = possible(robot, rows), {}
    for key in sorted({(r["fault"], r["motor"]) for r in rows}):
        mine = np.array([(r["fault"], r["motor"]) == key for r in rows])
        chosen = [r for r, m in zip(rows, mine, strict=True) if m]
        arms = [r for r in loop.rows if "said" in r and r["motor"] == key[1]]
        hit = np.array([r["error_m"] <= TOLERANCE_M for r in chosen])
        latched = np.array([r["latched"] for r in arms])
        found[f"{key[0]} m{key[1]}"] = {
            "targets": len(chosen), "hits": int(hit.sum()), "reached": float(hit.mean()),
            "could": int(could[mine].sum()), "possible": float(could[mine].mean()),
            "movements": float(np.mean([r["movements"] for r in chosen])),
            "first": float(np.mean([r["first_m"] <= TOLERANCE_M for r in chosen])),
            "latched": float(np.mean(np.isfinite(latched))),
            "latched_3": float(np.mean(latched <= 3)),
            "false": float(np.mean([r["false"] for r in arms])),
            "told_right": float(np.mean(
                [r["reachable"] == c for r, c in zip(chosen, could[mine], strict=True)]
            )),
        }  # fmt: skip
    return found


def compare(
    trial: Trial, strategies: Sequence[str], name: str, unweighed: Sequence[str] = ()
) -> dict[str, Any]:
    """Run strategies on the same arms and print a table."""
    found = {}
    for strategy in strategies:
        began = time.monotonic()
        loop = Loop(trial, strategy, unweighed=unweighed).run()
        cells = summary(trial.known.robot, loop)
        found[strategy] = {"cells": cells, "rows": loop.rows}
        moves = max(sum(r.get("movements", 0) for r in loop.rows), 1)
        print(
            f"{name} {strategy}: {time.monotonic() - began:.0f} s; a movement: judging "
            f"{1e3 * loop.judged_s / moves:.1f} ms, planning {1e3 * loop.planned_s / moves:.1f} ms"
        )
        for cell, c in cells.items():
            print(
                f"  {cell:12s} {c['reached']:.2f} of {c['possible']:.2f} [{c['movements']:.1f}] "
                f"first {c['first']:.2f} n {c['targets']:.0f} latched {c['latched']:.2f} in 3: "
                f"{c['latched_3']:.2f} wrong {c['false']:.2f} told {c['told_right']:.2f}",
                flush=True,
            )
    return found


def forced(known: CalibratedRobot, told: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Print shares reached by truth and wrong belief, and by feedback alone.

    Truths are the nine classes, beliefs these and a motor that sticks now and then.

    The belief is there from the start, and so is the fault. `checked`: it may be let go of, but no
    other is taken up; `diagnosed`: the product as it is.
    """
    robot = known.robot
    motors = range(len(robot.motors))
    kinds = [("healthy", 0), *((kind, m) for kind in ("stuck", "random") for m in motors)]
    rng = np.random.default_rng([told.seed, 9])
    wrong = [*kinds[1:], *(("intermittent", m) for m in motors)]
    pairs = [(t, b) for t in kinds for b in wrong if t != b for _ in range(told.arms)]
    truths, beliefs = [TrueFault(*truth) for truth, _ in pairs], []
    for _, (kind, motor) in pairs:
        angle = float(rng.uniform(*robot.travel[motor])) if kind == "stuck" else np.nan
        fault = Fault(robot.motor_names[motor], MODES[kind])
        beliefs.append(BelievedFault(fault, motor, angle, 0.02, 0.0, angle))
    tasks = tasks_of(robot, len(truths), told.targets, told.seed)
    trial = Trial(known, truths, tasks, told.seed, told.engine, onset=0)
    ways = {
        "feedback": Loop(trial, "feedback"),
        "checked": Loop(trial, "diagnose", beliefs, new_diagnoses=False),
        "diagnosed": Loop(trial, "diagnose", beliefs),
    }
    cells: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for name, loop in ways.items():
        for row in loop.run().rows:
            if "said" not in row:
                hit = row["error_m"] <= TOLERANCE_M
                cells[_pair(truths[row["arm"]], beliefs[row["arm"]])][name].append(hit)
    found = {pair: {n: float(np.mean(hits)) for n, hits in c.items()} for pair, c in cells.items()}
    found = {pair: shares | {"n": len(cells[pair]["feedback"])} for pair, shares in found.items()}
    for pair, shares in found.items():
        texts = "  ".join(f"{name} {share:.3g}" for name, share in shares.items())
        print(f"  {pair:56s} {texts}", flush=True)
    return found


def _pair(truth: TrueFault, belief: BelievedFault) -> str:
    where = "same motor" if truth.motor == belief.motor else "another motor"
    where = "" if truth.kind == "healthy" else f" ({where})"
    return f"{truth.kind}, believed {belief.fault.mode}{where}"


def main() -> None:
    """Run one robot and kind of fault."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--fault", default="stuck", choices=list(MODES))
    parser.add_argument("--strategy", nargs="*", default=STRATEGIES, choices=STRATEGIES)
    parser.add_argument("--engine", default="physics", choices=["physics", "servo"])
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--unweighed", nargs="*", default=[], help="modes that are not weighed")
    parser.add_argument("--redrawn-at-rest", action="store_true")
    parser.add_argument("--forced", action="store_true", help="wrong beliefs from the start")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    known = load_calibration(None, told.robot)
    found: dict[str, Any]
    if told.forced:
        found = dict(forced(known, told))
    else:
        faults = faults_of(told.fault, known.robot, told.arms, told.seed)
        tasks = tasks_of(known.robot, len(faults), told.targets, told.seed)
        trial = Trial(known, faults, tasks, told.seed, told.engine, told.redrawn_at_rest)
        found = compare(trial, told.strategy, f"{told.robot} {told.fault}", told.unweighed)
    if told.json:
        told.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
