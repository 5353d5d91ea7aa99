"""Health checks and designed movements: what they find, and whether they find what they promise.

    python benchmarks/asking.py check --arms 20
    python benchmarks/asking.py others --arms 10 --robots ur5e so101
    python benchmarks/asking.py few --arms 40
    python benchmarks/asking.py further --arms 4
    python benchmarks/asking.py promised --arms 20
    python benchmarks/asking.py probes --arms 20 --probes 0 3

`check`: arms of the ArmPi FPV, each its own robot, with random errors of 5 counts (1.2 deg) at each
motor, and healthy ones; checks of 20 and 60 s, random movements of the usual ranges beside them, on
the physics engine. `others`: arms that nobody has calibrated, unknown zeros of 0.3 deg; an SO-101
is drawn from what its class file says, with play. `few`: five random movements and errors of 5
counts, as `diagnose` weighs them. `further`:
errors of 4 to 12 counts; posteriors that three random movements leave open, how many more settle
them (P >= 0.99), designed or random. `promised`:
faults as large as `ft.isolability` says that the motions show, by the priors of a check. `probes`:
arms of the ArmPi FPV at work, two shifts of twelve movements with a break after each; motors 3 and
4 miss their targets from the first break on, the watch may ask in the second.

A fault is named right if the motor is (P of its modes together above all else), healthy if P of
healthy is above that of every motor. The set-up of the sensor is taken as known.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from acting_world import TrueFault, World, home_of

from failuretwin.app.arms import emulation_with
from failuretwin.app.shadow import Shadow
from failuretwin.connection.emulated_arm import EmulatedArm, Shifts
from failuretwin.connection.links.base import Order
from failuretwin.core.hypothesis import CLEAR, RAISED, SUSPECTED, Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.belief import settled_evidence_of
from failuretwin.decision.acting.believed_arm import Seen
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.scoring import Share
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.decision.test_motions.design import Designer, Movement, next_movement
from failuretwin.decision.test_motions.health_check import (
    checking,
    faults_at_rest,
)
from failuretwin.decision.test_motions.motions import Motions
from failuretwin.decision.test_motions.outlook import Outlook, of_priors
from failuretwin.decision.test_motions.probing import Prober, ProbeRules
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.inference.engine.registration import run_posterior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.isolability import isolability
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior

COUNT_RAD = float(np.deg2rad(0.24))
AT_ONCE = 1
"""Arms judged at a time."""
SURE, GREEN_FROM = 0.99, 0.95
ERROR = "steady_state_error"


@dataclass(frozen=True)
class Robots:
    """Arms of one kind, and how they are judged."""

    known: CalibratedRobot
    nine: bool = False
    usual: bool = False

    @property
    def model(self) -> HealthyModel:
        """The healthy arm."""
        return HealthyModel.of(self.known.twin, self.known.imperfections)

    @property
    def names(self) -> list[str]:
        """Names of its motors."""
        return self.known.robot.motor_names

    @property
    def hypotheses(self) -> Sequence[Hypothesis]:
        """What is weighed."""
        return paper_hypotheses(self.names) if self.nine else faults_at_rest(self.model)

    def designer(self, seed: int, *, usual: bool) -> Designer:
        """Return what chooses movements."""
        model = self.model
        asked = paper_hypotheses(self.names)
        members = of_priors(model, asked, checking(model, asked))
        return Designer(SafetyGate(self.known.robot), Outlook(model, members), seed, usual)

    def judge(self, windows: Sequence[Sequence[Seen]]) -> list[Posterior]:
        """Return the posterior of some arms at a time."""
        model = self.model
        priors = Priors() if self.usual else checking(model, self.hypotheses)
        return [
            run_posterior(
                RunLikelihood(settled_evidence_of(windows[at : at + AT_ONCE]), model),
                self.hypotheses,
                priors,
                in_doubt=False,
            )
            for at in range(0, len(windows), AT_ONCE)
        ]

    def by_motor(self, windows: Sequence[Sequence[Seen]]) -> FloatArray:
        """Return P(healthy), then P that each motor is faulty, (arm, 1 + motor)."""
        names = [str(h) for h in self.hypotheses]
        of = [0 if n == "healthy" else 1 + self.names.index(n.split(":")[0]) for n in names]
        found = np.concatenate([np.exp(p.log_posterior) for p in self.judge(windows)])
        return np.stack(
            [found[:, np.array(of) == k].sum(axis=1) for k in range(1 + len(self.names))], axis=1
        )


def windows_of(
    world: World, orders: Sequence[Sequence[Order]], seconds: Sequence[float]
) -> list[list[Seen]]:
    """Return what is seen of arms that carry out orders, (movement, arm)."""
    windows: list[list[Seen]] = [[] for _ in world.faults]
    for each, lasts in zip(orders, seconds, strict=True):
        add(world, windows, each, lasts)
    return windows


def add(world: World, windows: list[list[Seen]], orders: Sequence[Order], seconds: float) -> None:
    """Let arms make one movement each."""
    start = world.time_s
    told = [w[-1].command if w else world.home[i] for i, w in enumerate(windows)]
    points = world.move(orders)
    for i, order in enumerate(orders):
        windows[i].append(
            Seen(order.target, told[i], order.duration, start, start + seconds, points[i])
        )


def carried_out(
    robots: Robots, faults: Sequence[TrueFault], made: Sequence[Movement], seed: int
) -> list[list[Seen]]:
    """Return what is seen of arms that all make the same movements."""
    world = World(robots.known, faults, seed, "physics", onset=0)
    orders = [[m.order] * len(faults) for m in made]
    return windows_of(world, orders, [m.seconds for m in made])


def share(hits: FloatArray) -> str:
    """Return how many, and the Wilson interval of the share."""
    low, high = Share(int(np.sum(hits)), len(hits)).interval
    return f"{int(np.sum(hits))}/{len(hits)} ({100 * low:.1f} to {100 * high:.1f} %)"


def report(head: str, robots: Robots, truth: FloatArray, found: FloatArray) -> None:
    """Print what was named right of each motor, healthy kept, and wrongly above 0.99."""
    best = found.argmax(axis=1)
    cells = [f"{'healthy' if k == 0 else robots.names[k - 1]} {share((best == k)[truth == k])}"
             for k in np.unique(truth)]  # fmt: skip
    wrong = (best != truth) & (found.max(axis=1) >= SURE)
    alarms = wrong[truth == 0]
    said = f"wrong above .99: {int(wrong.sum())} of {len(truth)}"
    said += f", healthy {int(alarms.sum())} of {len(alarms)}"
    green = (truth > 0) & (found[:, 0] >= GREEN_FROM)
    said += f"; faulty ones with a green light: {int(green.sum())} of {int((truth > 0).sum())}"
    print(f"{head}: {'; '.join(cells)}; {said}", flush=True)


def checks(arms: int, seed: int, seconds: Sequence[float]) -> None:
    """Checks of the ArmPi FPV beside random movements."""
    robots = Robots(load_calibration(None, "armpi_fpv"))
    home = home_of(robots.known.robot)
    motors = len(robots.names)
    faults = [TrueFault("healthy")] * (4 * arms)
    faults += [TrueFault("random", k, 5 * COUNT_RAD) for k in range(motors) for _ in range(arms)]
    truth = np.array([0 if f.kind == "healthy" else 1 + f.motor for f in faults])
    for length in seconds:
        usual = robots.designer(seed, usual=True)
        for name, made in (
            ("designed", robots.designer(seed, usual=False).sequence(home, length)),
            ("designed, usual ranges", usual.sequence(home, length)),
            ("random, usual ranges", usual.random(home, length)),
        ):
            found = robots.by_motor(carried_out(robots, faults, made, seed))
            report(f"{length:.0f} s {name}, {len(made)} movements", robots, truth, found)


SIZES_DEG = {"ur5e": (0.5, 1.0), "panda": (0.5, 1.0), "so101": (2.0, 4.0)}
"""Random errors of other arms [deg]."""


def others(arms: int, seed: int, names: Sequence[str]) -> None:
    """Checks of arms that nobody has calibrated."""
    for name in names:
        sizes = SIZES_DEG[name]
        robots = Robots(load_calibration(None, name), nine=True)
        home, motors = home_of(robots.known.robot), len(robots.names)
        designer = robots.designer(seed, usual=False)
        plans = {
            "designed": designer.sequence(home, 20.0),
            "random, usual ranges": robots.designer(seed, usual=True).random(home, 20.0),
        }
        for size in sizes:
            faults = [TrueFault("healthy")] * (2 * arms)
            faults += [TrueFault("random", k, float(np.deg2rad(size)))
                       for k in range(motors) for _ in range(arms)]  # fmt: skip
            truth = np.array([0 if f.kind == "healthy" else 1 + f.motor for f in faults])
            for plan, made in plans.items():
                found = robots.by_motor(carried_out(robots, faults, made, seed))
                head = f"{name} {size:g} deg, 20 s {plan}, {len(made)} movements"
                report(head, robots, truth, found)


FEW = 5
"""Movements of a run of the paper."""


def few(arms: int, seed: int) -> None:
    """Small errors in five random movements, by the priors of `diagnose`."""
    robots = Robots(load_calibration(None, "armpi_fpv"), nine=True, usual=True)
    home, motors = home_of(robots.known.robot), len(robots.names)
    for size in (5.0, 15.0):
        faults = [TrueFault("healthy")] * (3 * arms)
        faults += [TrueFault("random", k, size * COUNT_RAD)
                   for k in range(motors) for _ in range(arms)]  # fmt: skip
        truth = np.array([0 if f.kind == "healthy" else 1 + f.motor for f in faults])
        made = [robots.designer(seed + i, usual=True).random(home, 1e3, FEW)
                for i in range(arms)]  # fmt: skip
        orders = [[made[i % arms][k].order for i in range(len(faults))] for k in range(FEW)]
        world = World(robots.known, faults, seed, "physics", onset=0)
        found = robots.by_motor(windows_of(world, orders, [1.6] * FEW))
        report(f"{FEW} random movements, {size:g} counts", robots, truth, found)


FIRST = 3
"""Random movements after which a posterior is looked at."""
MOST = 12
"""Further movements after which it is given up."""


def further(arms: int, seed: int) -> None:
    """Movements that settle what random ones leave open."""
    robots = Robots(load_calibration(None, "armpi_fpv"), nine=True)
    home, motors = home_of(robots.known.robot), len(robots.names)
    faults = [TrueFault("healthy")] * arms
    faults += [TrueFault("random", k) for k in range(motors) for _ in range(arms)]
    truth = np.array([0 if f.kind == "healthy" else 1 + f.motor for f in faults])
    usual = robots.designer(seed, usual=True)
    gate = SafetyGate(robots.known.robot)
    first = usual.random(home, 1e3, FIRST)
    for name in ("random", "designed"):
        small = (4.0 * COUNT_RAD, 12.0 * COUNT_RAD)
        world = World(robots.known, faults, seed, "physics", onset=0, errors=small)
        windows = windows_of(world, [[m.order] * len(faults) for m in first], [1.6] * FIRST)
        needed = np.full(len(faults), np.nan)
        right = np.zeros(len(faults), dtype=bool)
        was_open = robots.by_motor(windows).max(axis=1) < SURE
        for count in range(MOST + 1):
            found = robots.by_motor(windows)
            news = was_open & np.isnan(needed) & (found.max(axis=1) >= SURE)
            needed[news], right[news] = count, (found.argmax(axis=1) == truth)[news]
            if count == MOST:
                break
            orders = []
            for i, window in enumerate(windows):
                at = window[-1].command
                order = None
                if name == "designed" and was_open[i] and np.isnan(needed[i]):
                    (posterior,) = robots.judge([window])
                    order = next_movement(robots.model, gate, posterior, at, seed + count)
                orders.append(order or usual.random(at, 1e3, 1)[0].order)
            add(world, windows, orders, 1.6)
        told = np.where(np.isnan(needed), MOST, needed)[was_open]
        settled = was_open & ~np.isnan(needed)
        wrong, never = int((settled & ~right).sum()), int((was_open & np.isnan(needed)).sum())
        said = f"{was_open.sum()} of {len(faults)} open after {FIRST}, settled by {told.mean():.2f}"
        said += f" (+- {told.std() / np.sqrt(len(told)):.2f}) on average"
        said += f", healthy {told[truth[was_open] == 0].mean():.2f}, never in {MOST}: {never}"
        said += f", wrong at .99: {wrong} of {int(settled.sum())}"
        print(f"further movements, {name}: {said}", flush=True)


def promised(arms: int, seed: int) -> None:
    """Faults as large as the smallest that the motions are said to show."""
    robots = Robots(load_calibration(None, "armpi_fpv"), nine=True)
    home = home_of(robots.known.robot)
    for length in (20.0, 60.0):
        made = robots.designer(seed, usual=False).sequence(home, length)
        motions = Motions.of(robots.known.robot, made)
        time, command = motions.reference()
        priors = checking(robots.model, robots.hypotheses)
        figures = robots.known.imperfections
        said = isolability(robots.known.twin, command, time, figures, priors=priors)
        for factor in (0.75, 1.0, 1.25):
            cells = []
            for k, name in enumerate(robots.names):
                size = said.isolated[f"{name}:{ERROR}"]
                assert size is not None
                faults = [TrueFault("random", k, factor * size)] * arms
                found = robots.by_motor(carried_out(robots, faults, made, seed + 1))
                cells.append(f"{np.rad2deg(size):.2f} deg {share(found.argmax(axis=1) == 1 + k)}")
            print(
                f"{length:.0f} s, {factor:g} of the size promised: {'; '.join(cells)}", flush=True
            )


PROBED_DEG = {2: 1.4, 3: 2.0}
"""Random errors of motors 3 and 4, above what a check of 20 s is said to show [deg]; at work motor
4 shows less."""
BREAK_S, ENDS_S = 60.0, 55.0
"""Break after each shift, and when a watch is read in the second [s]."""
BEGINS_S = 60.0
"""When faults begin, in the first break [s]."""


@dataclass(frozen=True)
class Watched:
    """What a watch believes at the end.

    Attributes:
        named: The fault that has 0.95 or more; empty: none.
        sure: Whatever has 0.99 or more, healthy included; empty: nothing.
        state: Of the alarm, or why nothing is decided.
        asked: Movements that it asked by.
    """

    named: str
    sure: str
    state: str
    asked: int


def watched(known: CalibratedRobot, fault: str, probes: int, seed: int) -> Watched:
    """Watch an emulated arm at work for two shifts, asking it in the second break."""
    emulation = emulation_with([fault] if fault else [], known, seed)
    arm = EmulatedArm(emulation, shifts=Shifts(break_s=BREAK_S))
    watch = monitor(known.twin, known.imperfections)
    prober = Prober(watch, SafetyGate(known.robot), arm, ProbeRules(probes), seed)
    shadow = Shadow(arm, watch, known.twin, [prober])
    asked: list[str] = []
    made, until = 0, np.inf
    while shadow.snapshot.stream_time < until:
        standing = arm.standing
        shadow.step(0.0)
        made += not np.array_equal(standing, arm.standing)
        if made == 2 * Shifts().movements:
            until = min(until, shadow.snapshot.stream_time + ENDS_S)
        if prober.due:
            prober.ask(shadow.hear, asked.append)
    believed = watch.believed
    best = int(np.argmax(believed.probability))
    name, most = str(believed.hypotheses[best]), float(believed.probability[best])
    said = shadow.snapshot.answer.diagnosis
    undecided = "" if said is None else said.undecided
    times = [int(text.split()[2]) for text in asked if text.startswith("asked by")]
    return Watched(
        "" if name == "healthy" or most < GREEN_FROM else name,
        name if most >= SURE else "",
        undecided or shadow.snapshot.answer.alarm.state,
        sum(times),
    )


def probed(arms: int, seed: int, probes: Sequence[int]) -> None:
    """Arms that are asked while they are watched, beside some that are not."""
    known = load_calibration(None, "armpi_fpv")
    names = known.robot.motor_names
    faults = {"healthy": ""} | {
        f"{names[k]} {size:g} deg": f"{names[k]}:{ERROR}={np.deg2rad(size):.5f}@{BEGINS_S:g}"
        for k, size in PROBED_DEG.items()
    }
    for most in probes:
        for cell, fault in faults.items():
            count = arms if fault else 2 * arms
            found = [watched(known, fault, most, seed + i) for i in range(count)]
            motor = fault.partition(":")[0]
            right = [one.named.partition(":")[0] == motor for one in found]
            if not fault:
                right = [one.state == CLEAR for one in found]
            wrong = sum(
                bool(one.sure) and one.sure != "healthy" and one.sure.partition(":")[0] != motor
                for one in found
            )
            clear = sum(one.state == CLEAR for one in found)
            asked = [one.asked for one in found if one.asked]
            why = {one.state for one in found} - {CLEAR, SUSPECTED, RAISED}
            print(
                f"--probe {most}, {cell}: right {share(np.array(right))}, no alarm and no "
                f"suspicion {clear}, another fault above .99: {wrong}; asked {len(asked)} arms by "
                f"{np.mean(asked) if asked else 0.0:.1f} movements; undecided: {why or 'none'}",
                flush=True,
            )


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("check", "others", "few", "further", "promised",
                                         "probes"))  # fmt: skip
    parser.add_argument("--arms", type=int, default=20, help="arms a cell")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, nargs="+", default=(20.0, 60.0))
    parser.add_argument("--robots", nargs="+", choices=tuple(SIZES_DEG), default=tuple(SIZES_DEG))
    parser.add_argument("--probes", type=int, nargs="+", default=(0, 3))
    options = parser.parse_args()
    if options.what == "check":
        checks(options.arms, options.seed, options.seconds)
    elif options.what == "probes":
        probed(options.arms, options.seed, options.probes)
    elif options.what == "others":
        others(options.arms, options.seed, options.robots)
    else:
        {"few": few, "further": further, "promised": promised}[options.what](
            options.arms, options.seed
        )


if __name__ == "__main__":
    main()
