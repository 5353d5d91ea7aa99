"""False alarms and delays of the watch: healthy hours and faults, robots drawn at random.

    python benchmarks/alarms.py [--hours 30] [--faults 200] [--seed 0] [--robot armpi_fpv]
        [--of CALIBRATION] [--by CALIBRATION] [--robots N | --alone] [--sensing SENSING ...]
        [--drift SCATTERS] [--picture FILE]

Movements are seen at rest alone (`alarms_world.py`). Each healthy life is an hour of a robot of its
own; with --robots N, N robots are drawn and each has taught the watch before. A fault is shown with
the first movement at which what was seen speaks for it, its onset and
size known, by 5 nats. Delay 1 is the movement that a fault spoils first; after it was shown, 0 is
the movement that showed it. Beside the filter: a CUSUM of the residual, and a threshold on it.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from alarms_world import Lives, live
from telling import per_100_hours

import failuretwin as ft
from failuretwin.core.hypothesis import RAISED, paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.decision.streaming.alarm_rule import AlarmRule
from failuretwin.decision.streaming.learning import LifeLearner
from failuretwin.digital_model.arm_classes import GENERIC_NAME, generic_imperfections
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, load_calibration
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.healthy_density import healthy_log_density
from failuretwin.inference.movements.joint_likelihood import movement_likelihoods
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.sensors import SensorStack, parse_sensing
from failuretwin.inference.together.fault_filter import FaultFilter
from failuretwin.inference.together.healthy_mixture import FOREIGN, HealthyMixture

BUDGETS = (0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
"""False alarms in 100 hours that are allowed."""
AT_ONCE, MOVEMENTS, BLOCK = 10, 1560, 40
"""Lives that are simulated together, movements of a healthy one (an hour), and judged together."""
TAUGHT = 600
"""Movements from which a robot is learned where some robots are asked for: 23 minutes of work."""
FAULTY = 60
ONSET = (15, 21)
SHOWN_NATS = 5.0
SPELL = 5
"""Alarms of a residual that lie closer than so many movements are one."""
SHARE = 0.75
"""Share of healthy residuals below the drift of the CUSUM."""
CAPPED = 4.0
"""Residuals beyond so many drifts count as this: one lost command must not decide alone."""


@dataclass(frozen=True)
class Told:
    """What was said of some lives.

    Attributes:
        raised: First movement of each false alarm, by life, and of each alarm of a fault.
        cause: What was named then.
    """

    raised: list[list[int]]
    cause: list[list[str]]


@dataclass(frozen=True)
class Seen:
    """Some lives as a method sees them.

    Attributes:
        lives: The lives.
        posterior: Of the filter, (life, movement, hypothesis).
        hours: Of each movement, (life, movement) [h].
        residual: Distance of the tool from where a healthy one settles, in scatters,
            (life, movement); 0 where it was not seen.
        shown: First movement that shows the fault, (life,); -1: none.
    """

    lives: Lives
    posterior: FloatArray
    hours: FloatArray
    residual: FloatArray
    shown: np.ndarray


def look(lives: Lives, mixture: HealthyMixture) -> Seen:
    """Return lives as they are seen."""
    models = [one.model for one in mixture.filters]
    found = [movement_likelihoods(lives.evidence, model) for model in models]
    healthy = [healthy_log_density(lives.evidence, known) for known in found]
    belief, posterior, hours = mixture.begin(len(lives.hours)), [], []
    movements = lives.evidence.usable.shape[1]
    for first in range(0, movements, BLOCK):
        before = max(first - 1, 0)
        part = (slice(None), slice(before, min(first + BLOCK, movements)))
        says = [
            one.evidence(
                RunLikelihood(
                    lives.evidence[part], one.model, remembered=known[part], healthy=usual[part]
                )
            )
            for one, known, usual in zip(mixture.filters, found, healthy, strict=True)
        ]
        for at in range(first - before, says[0].hours.shape[1]):
            belief = mixture.advance(belief, says, at)
            posterior.append(mixture.posterior(belief))
            hours.append(says[0].hours[:, at])
    model = models[0]
    whole = RunLikelihood(lives.evidence, model, remembered=found[0])
    pose = found[0].expected[:, :, 0]
    error, _, spread = model.residual(lives.evidence.point, pose, model.scatter)
    residual = np.where(lives.evidence.usable, np.sqrt(spread.product(error, error)), 0.0)
    return Seen(
        lives,
        np.stack(posterior, axis=1),
        np.stack(hours, axis=1),
        residual,
        _shown(lives, whole),
    )


def taught(
    twin: ft.DigitalTwin, robot_itself: Imperfections, diagnoser: ft.BayesDiagnoser, seed: int
) -> HealthyModel:
    """Return what a watch has learned of one robot after `TAUGHT` movements."""
    life = live(twin, robot_itself, ["healthy"], TAUGHT, ONSET, seed).evidence
    learner, stood = LifeLearner(diagnoser), life.movements.origin()
    for m in range(TAUGHT):
        one = life[(slice(None), slice(m, m + 1))]
        learner.take(replace(one, movements=replace(one.movements, initial=stood[:, m])), True)
    return learner.model


def joined(parts: Sequence[Seen]) -> Seen:
    """Return lives that were seen apart as one; what was seen of them is left out."""
    lives = replace(
        parts[0].lives,
        hours=np.concatenate([part.lives.hours for part in parts]),
        truth=[fault for part in parts for fault in part.lives.truth],
        onset=np.concatenate([part.lives.onset for part in parts]),
        onset_s=np.concatenate([part.lives.onset_s for part in parts]),
        told_s=np.concatenate([part.lives.told_s for part in parts]),
    )
    names = ("posterior", "hours", "residual", "shown")
    values = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Seen(lives, **values)


def _shown(lives: Lives, likelihood: RunLikelihood) -> np.ndarray:
    """Return the first movement that shows each fault, (life,); -1: none does."""
    shown = np.full(len(lives.hours), -1)
    for i, fault in enumerate(lives.truth):
        if fault == "healthy":
            continue
        one = likelihood[i]
        profile = one.profile(one.model.motor_names.index(fault.partition(":")[0]))
        stuck = np.isfinite(lives.held[i])
        angle = np.full_like(profile.mode, lives.held[i]) if stuck else profile.faulty_baseline
        angle = angle + lives.off[i, :, None]
        log_ratio = (
            profile.log_density(angle[:, :, None], bool(stuck))[0, :, 0] - one.log_healthy[0]
        )
        log_ratio[: lives.onset[i]] = 0.0
        beyond = np.cumsum(log_ratio) >= SHOWN_NATS
        shown[i] = int(np.argmax(beyond)) if beyond.any() else -1
    return shown


def by_filter(seen: Seen, names: Sequence[str], faults_per_h: float, budget: float) -> Told:
    """Return what the filter says if so many false alarms in 100 hours are allowed."""
    told = Told([], [])
    for posterior, hours in zip(seen.posterior, seen.hours, strict=True):
        rule, episode = AlarmRule(names, faults_per_h, budget), None
        raised: list[int] = []
        cause: list[str] = []
        for m in range(len(posterior)):
            alarm = rule.see(float(m), posterior[m], float(hours[m]))
            if alarm.state == RAISED and alarm.episode != episode:
                raised.append(m)
                cause.append(alarm.cause)
                episode = alarm.episode
        told.raised.append(raised)
        told.cause.append(cause)
    return told


def by_threshold(values: FloatArray, threshold: float) -> Told:
    """Return what a threshold says of values (life, movement); it names nothing."""
    told = Told([], [])
    for row in values:
        above = np.flatnonzero(row > threshold)
        first = [int(m) for k, m in enumerate(above) if k == 0 or m - above[k - 1] > SPELL]
        told.raised.append(first)
        told.cause.append(["?"] * len(first))
    return told


def cusum(residual: FloatArray, drift: float) -> FloatArray:
    """Return the CUSUM of residuals, (life, movement); what it says of a fault does not go back."""
    total, most = np.zeros_like(residual), CAPPED * drift
    for m in range(residual.shape[1]):
        before = total[:, m - 1] if m else 0.0
        total[:, m] = np.maximum(0.0, before + np.minimum(residual[:, m], most) - drift)
    return total


def false_alarms(told: Told, hours: float) -> str:
    """Return false alarms in 100 hours with their 95 % interval."""
    return per_100_hours(sum(map(len, told.raised)), hours)


@dataclass(frozen=True)
class Delays:
    """How faults were found: delays, after shown and in seconds too, and who was named."""

    found: int
    of: int
    movements: FloatArray
    after_shown: FloatArray
    seconds: FloatArray
    right: int

    @classmethod
    def of_alarms(cls, told: Told, seen: Seen, some: Sequence[int]) -> Delays:
        """Return the delays of some lives; alarms before the onset do not count."""
        movements, after, seconds, right = [], [], [], 0
        for i in some:
            onset, shown = int(seen.lives.onset[i]), int(seen.shown[i])
            rows = zip(told.raised[i], told.cause[i], strict=True)
            first = next(((m, c) for m, c in rows if m >= onset), None)
            if first is None:
                continue
            movements.append(first[0] - onset + 1)
            after.append(first[0] - shown if shown >= 0 else np.nan)
            seconds.append(seen.lives.told_s[i, first[0]] - seen.lives.onset_s[i])
            right += first[1] == seen.lives.truth[i]
        delays = np.array(movements), np.array(after), np.array(seconds)
        return cls(len(movements), len(some), *delays, right)

    def __str__(self) -> str:
        if not self.found:
            return f"found 0 of {self.of}"
        quantiles = np.quantile(self.movements, (0.5, 0.9, 0.99), method="inverted_cdf")
        after = np.nanquantile(self.after_shown, (0.5, 0.9), method="inverted_cdf")
        seconds = np.quantile(self.seconds, (0.5, 0.9))
        right = f"right {100 * self.right / self.found:.1f} %" if self.right else "names nothing"
        return (
            f"found {self.found} of {self.of}; movements {'/'.join(f'{q:.0f}' for q in quantiles)};"
            f" after shown {'/'.join(f'{q:.0f}' for q in after)};"
            f" {'/'.join(f'{q:.1f}' for q in seconds)} s; {right}"
        )


def healthy_lives(
    works: CalibratedRobot, hours: int, seed: int, seen: SensorStack, drift: float
) -> Iterator[Lives]:
    """Yield healthy lives of an hour, with zeros that drift by so many scatters."""
    for number in range(0, hours, AT_ONCE):
        count = min(AT_ONCE, hours - number)
        faults = ["healthy"] * count
        told = works.twin, works.imperfections, faults, MOVEMENTS, ONSET, seed + number
        yield live(*told, sensors=seen, drift=drift)


def candidates(
    known: CalibratedRobot,
    alone: bool,
    works: CalibratedRobot | None,
    seed: int,
    sensing: tuple[str, ...],
) -> HealthyMixture:
    """Return what a watch believes that its robot may be.

    Args:
        known: The calibration that it was given.
        alone: Whether that is believed for sure.
        works: The robot that has taught it; None: none has, it knows arms of the kind.
        seed: Seed of what it was taught by.
        sensing: What is believed.
    """
    hypotheses = paper_hypotheses(known.robot.motor_names)
    model, cold = HealthyModel.of(known), known.imperfections.name == GENERIC_NAME
    models = [model]
    if works is not None:
        diagnoser = ft.BayesDiagnoser(known, whole_run=False)
        own = taught(works.twin, works.imperfections, diagnoser, seed + 5_000)
        models = [own] if cold else [model, own]
    elif not (alone or cold):
        models.append(HealthyModel.of(known.twin, generic_imperfections(known.robot)))
    filters = [FaultFilter(one.seen_by(sensing), hypotheses, Priors()) for one in models]
    share = np.array([1.0 - FOREIGN, FOREIGN] if len(filters) > 1 else [1.0])
    return HealthyMixture(filters, share)


def watched(
    works: CalibratedRobot,
    mixture: HealthyMixture,
    counts: tuple[int, int],
    seed: int,
    drift: float,
) -> tuple[list[Seen], Seen]:
    """Return healthy hours and faults of a robot as they are seen; `counts` says how many."""
    names = [str(h) for h in paper_hypotheses(works.robot.motor_names)]
    hours, count = counts
    seen = mixture.filters[0].model.sensors
    healthy = healthy_lives(works, hours, seed, seen, drift)
    faults = [names[1 + k % (len(names) - 1)] for k in range(count)]
    broken = live(
        works.twin, works.imperfections, faults, FAULTY, ONSET, seed + 7_777, sensors=seen
    )
    return [look(lives, mixture) for lives in healthy], look(broken, mixture)


def main() -> None:
    """Print the tables, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=int, default=30)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--of", default=None, help="calibration of the robot that works")
    parser.add_argument("--by", default=None, help="calibration that the watch uses")
    parser.add_argument("--robots", type=int, default=0, help="so many, which have taught")
    parser.add_argument("--alone", action="store_true", help="believe the calibration for sure")
    parser.add_argument("--sensing", nargs="+", default=["tool"], help="what is believed")
    parser.add_argument("--drift", type=float, default=0.0, help="of zeros, in scatters")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    curves: dict[str, list[tuple[float, float]]] = {}
    for sensing in options.sensing:
        study(options, sensing, curves)
    if options.picture:
        draw(curves, options.picture)


def study(
    options: argparse.Namespace, sensing: str, curves: dict[str, list[tuple[float, float]]]
) -> None:
    """Print the table of one kind of sensing, and add its points to the curves."""
    robot = ft.load_robot(options.robot)
    works, known = (load_calibration(name, robot) for name in (options.of, options.by))
    names = [str(h) for h in paper_hypotheses(robot.motor_names)]
    begun, rng = time.process_time(), np.random.default_rng(options.seed)
    groups = max(options.robots, 1)
    counts = options.hours // groups, options.faults // groups
    healthy, broken_parts = [], []
    for group in range(groups):
        itself = vary(works.imperfections, rng) if options.robots else works.imperfections
        robot_itself = replace(works, imperfections=itself)
        seed = options.seed + 10_000 * group
        taught_by = robot_itself if options.robots else None
        mixture = candidates(known, options.alone, taught_by, seed, parse_sensing(sensing))
        usual, faulty = watched(robot_itself, mixture, counts, seed, options.drift)
        healthy += usual
        broken_parts.append(faulty)
    broken, faults_per_h = joined(broken_parts), mixture.filters[0].faults_per_h
    hours = sum(float(seen.lives.hours.sum()) for seen in healthy)
    spent = time.process_time() - begun
    print(f"{sensing}: {hours:.0f} h, {options.faults} faults, {spent:.0f} s of a core")
    for budget in BUDGETS:
        rows = [by_filter(seen, names, faults_per_h, budget) for seen in healthy]
        alarms = Told([r for t in rows for r in t.raised], [c for t in rows for c in t.cause])
        told = by_filter(broken, names, faults_per_h, budget)
        by_filter_told(sensing, budget, (alarms, told), broken, hours, curves)
    if sensing == "tool":
        by_residual(healthy, broken, curves)


def by_filter_told(
    sensing: str,
    budget: float,
    alarms_and_told: tuple[Told, Told],
    broken: Seen,
    hours: float,
    curves: dict[str, list[tuple[float, float]]],
) -> None:
    """Print what the filter gives at one budget, and at the default each fault by itself."""
    (alarms, told), truth = alarms_and_told, broken.lives.truth
    delays = Delays.of_alarms(told, broken, range(len(truth)))
    _note(curves, f"filter, {sensing}", alarms, hours, delays)
    print(f"filter, {budget:5.1f} allowed: {false_alarms(alarms, hours)}; {delays}", flush=True)
    if budget != 1.0:
        return
    print(f"    false ones name {dict(Counter(c for row in alarms.cause for c in row))}")
    for name in sorted(set(truth)):
        some = [i for i, fault in enumerate(truth) if fault == name]
        print(f"    {name:30s} {Delays.of_alarms(told, broken, some)}")


def by_residual(
    healthy: Sequence[Seen], broken: Seen, curves: dict[str, list[tuple[float, float]]]
) -> None:
    """Print what a CUSUM of the residual and a threshold on it give."""
    everything = range(len(broken.lives.hours))
    hours = sum(float(seen.lives.hours.sum()) for seen in healthy)
    residual = np.concatenate([seen.residual for seen in healthy])
    drift = float(np.quantile(residual[residual > 0.0], SHARE))
    methods = {
        "CUSUM of the residual": (cusum(residual, drift), cusum(broken.residual, drift)),
        "threshold on the residual": (residual, broken.residual),
    }
    for name, (usual, faulty) in methods.items():
        for per_100_h in (1.0, 10.0, 100.0):
            top = _threshold(usual, per_100_h * hours / 100.0)
            alarms, told = by_threshold(usual, top), by_threshold(faulty, top)
            delays = Delays.of_alarms(told, broken, everything)
            _note(curves, name, alarms, hours, delays)
            print(f"{name}: {false_alarms(alarms, hours)}; {delays}", flush=True)


def _threshold(values: FloatArray, spells: float) -> float:
    """Return the threshold that values exceed in so many spells."""
    candidates = np.unique(np.quantile(values, 1.0 - np.geomspace(1e-6, 0.05, 200)))
    counts = [sum(map(len, by_threshold(values, float(c)).raised)) for c in candidates]
    fitting = [c for c, count in zip(candidates, counts, strict=True) if count <= spells]
    return float(min(fitting, default=values.max()))


def _note(
    curves: dict[str, list[tuple[float, float]]],
    name: str,
    alarms: Told,
    hours: float,
    delays: Delays,
) -> None:
    missed = np.full(delays.of - delays.found, np.inf)
    late = np.quantile(np.append(delays.movements, missed), 0.9, method="inverted_cdf")
    rate = 100.0 * sum(map(len, alarms.raised)) / hours
    curves.setdefault(name, []).append((rate, float(late)))


def draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Draw false alarms against the delay within which nine of ten faults are found."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0))
    for name, points in curves.items():
        rate, delay = np.array(points).T
        axes.plot(np.maximum(rate, 0.1), np.minimum(delay, FAULTY), "o-", label=name)
    axes.set_xscale("log")
    axes.set_xlabel("false alarms in 100 h (0.1: none seen)")
    axes.set_ylabel("movements until nine of ten faults are found")
    axes.set_ylim(0, 30)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
