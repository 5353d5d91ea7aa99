"""Diagnosis under conditions that the calibration does not know.

    python benchmarks/conditions.py [--per-class 20] [--healthy 120] [--seed 0] [--only TEXT]
        [--told]

Simulated runs (physics engine unless said; its stiffness and friction are its own) of the ArmPi FPV
and of the three other bundled arms. The diagnoser keeps its bundled calibration,
or none where the arm has none, and default priors. A line for each condition: runs right, log
score, calibration error and how much of it is beyond chance (its mean over answers that mean what
they say), coverage of 90 % intervals of held angle, onset of stuck motors and size of errors, and
healthy runs called faulty. With `--told` the diagnoser knows each condition: what is left is what
such runs cannot show.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation
from telling import nats, right

import failuretwin as ft
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.scoring import calibrated_error, reliability
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES

if TYPE_CHECKING:
    import xarray as xr

COUNT_RAD = float(np.deg2rad(0.24))
LATE_S = 8.0
OTHERS = ("ur5e", "panda", "so101")
QUANTITIES = ("held angle", "onset", "size")


def unmoved(point: FloatArray) -> FloatArray:
    """Return tool positions as they are, (..., 3) [m]."""
    return point


@dataclass(frozen=True)
class Condition:
    """What is true while the diagnoser believes its calibration.

    Attributes:
        name: What it is.
        robot: The robot.
        truth: What its healthy behaviour is.
        believed: What the diagnoser believes; None: the class of the arm.
        movements: How movements are drawn.
        errors: Range of steady-state errors [rad]; None: the paper's.
        latest_s: Latest onset [s]; None: as usual.
        moved: What becomes of seen tool positions.
        engine: What moves the robot.
    """

    name: str
    robot: Robot
    truth: Imperfections
    believed: Imperfections | None
    movements: RandomMovements = field(default_factory=RandomMovements)
    errors: tuple[float, float] | None = None
    latest_s: float | None = None
    moved: Callable[[FloatArray], FloatArray] = unmoved
    engine: str = "physics"

    def runs(self, per_class: int, healthy: int, seed: int) -> list[xr.Dataset]:
        """Return runs of every class, and more healthy ones."""
        plans = [self._plan(None, per_class, seed), self._plan(["healthy"], healthy, seed + 1)]
        found = []
        for plan in plans:
            runs = simulate(plan)
            seen = self.moved(runs["measured"].values)
            found.append(runs.assign(measured=(runs["measured"].dims, seen)))
        return found

    def _plan(self, hypotheses: list[str] | None, count: int, seed: int) -> Plan:
        return Plan(
            self.robot,
            hypotheses,
            count,
            seed,
            self.truth,
            self.movements,
            self._modes,
            self.engine,
        )

    @property
    def _modes(self) -> dict[str, ft.FaultMode]:
        modes = dict(MODES)
        if self.errors is not None:
            modes["steady_state_error"] = SteadyStateError(magnitude=self.errors)
        if self.latest_s is not None:
            late = (0.0, self.latest_s)
            modes |= {n: replace(modes[n], onset_s=late) for n in ("stuck", "steady_state_error")}
        return modes


# What may be otherwise than the calibration says.


def settled(
    truth: Imperfections, compliance: float = 1.0, friction: float = 1.0, scatter: float = 1.0
) -> Imperfections:
    """Return healthy behaviour with settling figures multiplied."""
    old = truth.settling
    assert old is not None
    settling = replace(
        old,
        compliance=tuple(compliance * v for v in old.compliance),
        friction=tuple(friction * v for v in old.friction),
        scatter=tuple(scatter * v for v in old.scatter),
    )
    return replace(truth, settling=settling)


def biased(truth: Imperfections, bias_rad: float) -> Imperfections:
    """Return healthy behaviour with a constant error of every motor, signs in turn."""
    old = truth.settling
    assert old is not None
    bias = tuple(v + bias_rad * (-1) ** k for k, v in enumerate(old.bias))
    return replace(truth, settling=replace(old, bias=bias))


def lossy(truth: Imperfections, factor: float) -> Imperfections:
    """Return healthy behaviour with more commands lost."""
    lost = tuple(
        replace(one, rate=factor * one.rate, rate_when_late=min(factor * one.rate_when_late, 0.25))
        for one in truth.lost_commands
    )
    return replace(truth, lost_commands=lost)


def paced(truth: Imperfections, period_s: float) -> Imperfections:
    """Return healthy behaviour with a movement every so often."""
    return replace(truth, schedule=replace(truth.schedule, period_s=(period_s, 1.03 * period_s)))


def sampled(
    truth: Imperfections, rate_hz: float | None = None, noise_m: float = 0.0
) -> Imperfections:
    """Return healthy behaviour before another sensor; None: as often as it is."""
    old = truth.readings
    assert old is not None
    readings = replace(old, rate_hz=rate_hz or old.rate_hz, noise_m=noise_m)
    return replace(truth, readings=readings)


def turned(point: FloatArray) -> FloatArray:
    """Return positions turned by a degree about the y axis."""
    return np.asarray(point @ Rotation.from_euler("y", 1.0, degrees=True).as_matrix().T)


def shifted(*shift_m: float) -> Callable[[FloatArray], FloatArray]:
    """Return what shifts positions [m]."""
    return lambda point: point + np.array(shift_m)


def conditions() -> Iterator[Condition]:
    """Yield all conditions, the bundled calibration's own first."""
    known = calibrated(load_robot("armpi_fpv"))
    base = Condition(
        "as the calibration says", known.robot, known.imperfections, known.imperfections
    )
    yield base
    yield from _of_motions(base)
    yield from _of_healthy_behaviour(base)
    yield from _of_faults(base)
    yield from _of_frames(base)
    yield replace(base, name="own twin (servo engine)", engine="servo")
    yield replace(base, name="no calibration", believed=generic_imperfections(base.robot))
    yield from _of_other_arms()


def _of_motions(base: Condition) -> Iterator[Condition]:
    for count in (2, 3, 4, 8):
        yield replace(base, name=f"{count} movements", movements=RandomMovements(count))
    for period in (1.2, 4.0):
        truth, movements = paced(base.truth, period), RandomMovements(period_s=period)
        name = f"a movement every {period:g} s"
        yield replace(base, name=name, truth=truth, movements=movements)
    for low, high in ((0.1, 0.2), (0.7, 0.8)):
        movements = RandomMovements(ramp_shares=(low, 0.5 * (low + high), high))
        yield replace(base, name=f"ramps of {low:g} to {high:g} of it", movements=movements)


def _of_healthy_behaviour(base: Condition) -> Iterator[Condition]:
    truth, settling = base.truth, base.truth.settling
    assert settling is not None
    for factor in (0.5, 1.5, 2.0):
        yield replace(base, name=f"scatter x {factor:g}", truth=settled(truth, scatter=factor))
    heavy = replace(truth, settling=replace(settling, tail_dof=3.0))
    yield replace(base, name="tails nu = 3", truth=heavy)
    for rate in (5.0, 20.0, 50.0):
        yield replace(base, name=f"sensor {rate:g} Hz", truth=sampled(truth, rate_hz=rate))
    for noise in (0.001, 0.002):
        name = f"tool noise {1e3 * noise:g} mm, not told"
        yield replace(base, name=name, truth=sampled(truth, noise_m=noise))
    yield replace(base, name="losses x 3", truth=lossy(truth, 3.0))
    late = replace(truth, timing=replace(truth.timing, late_rate=2.0 * truth.timing.late_rate))
    yield replace(base, name="late starts x 2", truth=late)
    for factor in (0.5, 1.5):
        sagging = settled(truth, compliance=factor)
        yield replace(base, name=f"sag x {factor:g} (servo)", truth=sagging, engine="servo")
    for factor in (0.0, 2.0):
        sticky = settled(truth, friction=factor)
        yield replace(base, name=f"friction x {factor:g} (servo)", truth=sticky, engine="servo")
    for counts in (1, 3):
        name = f"bias of {counts} counts in every motor"
        yield replace(base, name=name, truth=biased(truth, counts * COUNT_RAD))
    slow = replace(truth, timing=replace(truth.timing, lag_s=(0.1, 0.1)))
    yield replace(base, name="lag of 0.1 s", truth=slow)


def _of_faults(base: Condition) -> Iterator[Condition]:
    small, all_sizes = (3 * COUNT_RAD, 8 * COUNT_RAD), (3 * COUNT_RAD, 40 * COUNT_RAD)
    yield replace(base, name=f"onset anywhere, 0-{LATE_S:g} s", latest_s=LATE_S)
    yield replace(base, name="errors 3-40 counts", errors=all_sizes)
    yield replace(base, name="errors 3-8 counts", errors=small)
    yield replace(
        base,
        name="errors 3-40, onset anywhere, losses x 3",
        errors=all_sizes,
        latest_s=LATE_S,
        truth=lossy(base.truth, 3.0),
    )


def _of_frames(base: Condition) -> Iterator[Condition]:
    yield replace(base, name="tool origin 3 mm in x", moved=shifted(0.003, 0.0, 0.0))
    yield replace(base, name="tool origin 3 mm in z", moved=shifted(0.0, 0.0, 0.003))
    yield replace(base, name="turned 1 deg", moved=turned)
    yield replace(base, name="scale 1 %", moved=lambda point: 1.01 * point)


def _of_other_arms() -> Iterator[Condition]:
    for name in OTHERS:
        robot = load_robot(name)
        truth = calibrated(robot).imperfections
        base = Condition(f"{name} as its class", robot, truth, None)
        yield base
        settling = truth.settling
        assert settling is not None
        exact = replace(settling, scatter=(0.004,) * len(settling.scatter))
        odd = biased(replace(truth, settling=exact), 0.01)
        yield replace(base, name=f"{name}, bias 0.01 rad, scatter 0.004", truth=odd)
        yield replace(base, name=f"{name}, scatter x 2", truth=settled(truth, scatter=2.0))


# How well they are judged.


@dataclass(frozen=True)
class Score:
    """How well the runs of one condition were judged.

    Attributes:
        found: The diagnoses.
        held: Intervals that hold the truth, by quantity.
        asked: All intervals of runs whose fault was found, by quantity.
    """

    found: Sequence[Diagnosis]
    held: Mapping[str, int]
    asked: Mapping[str, int]

    @classmethod
    def of(cls, condition: Condition, parts: Sequence[xr.Dataset]) -> Score:
        """Judge the runs of a condition."""
        diagnoser = ft.BayesDiagnoser(condition.robot, condition.believed)
        found: list[Diagnosis] = []
        held, asked = Counter[str](), Counter[str]()
        for runs in parts:
            told = diagnoser.diagnose(runs)
            found += told
            truths = zip(runs["onset"].values, runs["magnitude"].values, strict=True)
            for diagnosis, (onset, magnitude) in zip(told, truths, strict=True):
                for quantity, inside in _intervals(diagnosis, float(onset), float(magnitude)):
                    asked[quantity] += 1
                    held[quantity] += inside
        return cls(found, held, asked)

    def line(self, name: str) -> str:
        """Return what is told of the condition."""
        told = [d for d in self.found if d.diagnosis is not None]
        sure = np.array([d.probability for d in told])
        error = reliability(sure, right(told)).error
        chance = float(np.mean(calibrated_error(sure, np.random.default_rng(0))))
        healthy = [d for d in self.found if d.truth == "healthy"]
        false = np.mean([d.diagnosis not in (None, "healthy") for d in healthy])
        cover = " ".join(f"{_percent(self.held[q], self.asked[q]):>5s}" for q in QUANTITIES)
        return (
            f"{name:40s} {100 * right(self.found).mean():6.1f} {nats(self.found).mean():6.3f} "
            f"{error:6.3f} {max(error - chance, 0.0):6.3f} {cover} {100 * false:6.1f}"
        )


def _intervals(diagnosis: Diagnosis, onset: float, magnitude: float) -> Iterator[tuple[str, bool]]:
    """Yield what intervals are of, and whether they hold the truth, if the fault was found."""
    if diagnosis.diagnosis != diagnosis.truth or diagnosis.magnitude_90 is None:
        return
    stuck = str(diagnosis.truth).endswith(":stuck")
    low, high = diagnosis.magnitude_90
    yield "held angle" if stuck else "size", low <= magnitude <= high
    if stuck and diagnosis.onset_90 is not None:
        yield "onset", diagnosis.onset_90[0] <= onset <= diagnosis.onset_90[1]


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f}" if whole else "-"


def main() -> None:
    """Print a line for each condition, and the coverage of all together."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--per-class", type=int, default=20, help="runs of each of the classes")
    parser.add_argument("--healthy", type=int, default=120, help="more healthy runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="conditions whose name holds this text")
    parser.add_argument("--told", action="store_true", help="tell the diagnoser the condition")
    options = parser.parse_args()
    print(f"{'':40s}  right   nats    ECE beyond  held onset  size  false", flush=True)
    held, asked = Counter[str](), Counter[str]()
    for condition in conditions():
        if options.only not in condition.name:
            continue
        if options.told:
            condition = replace(condition, believed=condition.truth)
        score = Score.of(
            condition, condition.runs(options.per_class, options.healthy, options.seed)
        )
        held.update(score.held)
        asked.update(score.asked)
        print(score.line(condition.name), flush=True)
    print("pooled: " + ", ".join(f"{q} {_percent(held[q], asked[q])} %" for q in QUANTITIES))


if __name__ == "__main__":
    main()
