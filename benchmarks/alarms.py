"""False alarms and delays of the watch: healthy hours and faults, robots drawn at random.

    python benchmarks/alarms.py [--hours 30] [--faults 200] [--seed 0] [--robot armpi_fpv]
        [--of CALIBRATION] [--by CALIBRATION] [--learn | --alone] [--picture FILE]

Movements are seen at rest alone (`alarms_world.py`). Each healthy life is an hour of a robot of its
own. A fault is shown with the first movement at which what was seen speaks for it, its onset and
size known, by 5 nats. Delay 1 is the movement that a fault spoils first; after it was shown, 0 is
the movement that showed it. Beside the filter: a CUSUM of the residual, and a threshold on it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from alarms_world import Lives, live
from scipy import stats

import failuretwin as ft
from failuretwin.core.alarm import RAISED
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.decision.streaming.alarm_rule import AlarmRule
from failuretwin.decision.streaming.learning import LITTLE, LONG_RUN, RUN, LifeLearner
from failuretwin.decision.streaming.monitor import FOREIGN, WORTH_LEARNING
from failuretwin.digital_model.arm_classes import GENERIC_NAME, generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.inference.evidence import SettledEvidence
from failuretwin.inference.fault_filter import FaultFilter
from failuretwin.inference.healthy_mixture import HealthyMixture
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.joint_likelihood import movement_likelihoods
from failuretwin.inference.priors import Priors
from failuretwin.inference.run_likelihood import RunLikelihood

BUDGETS = (0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
"""False alarms in 100 hours that are allowed."""
AT_ONCE, MOVEMENTS, BLOCK = 10, 1560, 40
"""Lives that are simulated together, movements of a healthy one (an hour), and judged together."""
BEHIND = 4
"""Movements before a block that are looked at for commands that were lost in a row."""
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
    belief, posterior, hours = mixture.begin(len(lives.hours)), [], []
    movements = lives.evidence.usable.shape[1]
    for first in range(0, movements, BLOCK):
        before = max(first - 1, 0)
        part = (slice(None), slice(before, min(first + BLOCK, movements)))
        says = [
            one.evidence(RunLikelihood(lives.evidence[part], one.model, remembered=known[part]))
            for one, known in zip(mixture.filters, found, strict=True)
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


def look_and_learn(lives: Lives, mixture: HealthyMixture, diagnoser: ft.BayesDiagnoser) -> Seen:
    """Return lives as they are seen by a watch that learns of each as it goes, as `FaultMonitor`.

    What it takes to see the past is that of the calibration alone.
    """
    plain = look(lives, HealthyMixture(mixture.filters[:1], np.ones(1)))
    posterior = plain.posterior.copy()
    for i in range(len(lives.hours)):
        rows = (slice(i, i + 1), slice(None))
        posterior[i] = _learning(lives.evidence[rows], mixture, LifeLearner(diagnoser))
        print(f"    learned from life {i + 1} of {len(lives.hours)}", file=sys.stderr, flush=True)
    return replace(plain, posterior=posterior)


def _learning(
    evidence: SettledEvidence, mixture: HealthyMixture, learner: LifeLearner
) -> FloatArray:
    """Return the posterior of one life, (movement, hypothesis)."""
    models = [one.model for one in mixture.filters]
    belief, posterior, first = mixture.begin(1), [], 0
    while first < evidence.usable.shape[1]:
        before = max(first - BEHIND, 0)
        stop = first + (RUN if learner.movements < LITTLE else LONG_RUN)
        part = evidence[(slice(None), slice(before, stop))]
        stood = evidence.movements.origin()[:, before]
        part = replace(part, movements=replace(part.movements, initial=stood))
        says = [
            one.evidence(RunLikelihood(part, model))
            for one, model in zip(mixture.filters, models, strict=True)
        ]
        for at in range(first - before, part.usable.shape[1]):
            belief = mixture.advance(belief, says, at)
            posterior.append(mixture.posterior(belief)[0])
            one = part[(slice(None), slice(at, at + 1))]
            here = replace(one.movements, initial=part.movements.origin()[:, at])
            own = float(np.exp(belief.log_weight[0, -1]))
            if learner.take(replace(one, movements=here), own > WORTH_LEARNING):
                models[-1] = learner.model
        first += part.usable.shape[1] - (first - before)
    return np.stack(posterior)


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
    """Return false alarms in 100 hours with their 95 % Poisson interval."""
    count = sum(map(len, told.raised))
    low = stats.chi2.ppf(0.025, 2 * count) / 2.0 if count else 0.0
    high = stats.chi2.ppf(0.975, 2 * count + 2) / 2.0
    return f"{100 * count / hours:6.1f} [{100 * low / hours:5.1f} to {100 * high / hours:5.1f}]"


@dataclass(frozen=True)
class Delays:
    """How faults were found: delay and delay after shown, of those that were, and who was named."""

    found: int
    of: int
    movements: FloatArray
    after_shown: FloatArray
    right: int

    @classmethod
    def of_alarms(cls, told: Told, seen: Seen, some: Sequence[int]) -> Delays:
        """Return the delays of some lives; alarms before the onset do not count."""
        movements, after, right = [], [], 0
        for i in some:
            onset, shown = int(seen.lives.onset[i]), int(seen.shown[i])
            rows = zip(told.raised[i], told.cause[i], strict=True)
            first = next(((m, c) for m, c in rows if m >= onset), None)
            if first is None:
                continue
            movements.append(first[0] - onset + 1)
            after.append(first[0] - shown if shown >= 0 else np.nan)
            right += first[1] == seen.lives.truth[i]
        return cls(len(movements), len(some), np.array(movements), np.array(after), right)

    def __str__(self) -> str:
        if not self.found:
            return f"found 0 of {self.of}"
        quantiles = np.quantile(self.movements, (0.5, 0.9, 0.99), method="inverted_cdf")
        after = np.nanquantile(self.after_shown, (0.5, 0.9), method="inverted_cdf")
        right = f"right {100 * self.right / self.found:.1f} %" if self.right else "names nothing"
        return (
            f"found {self.found} of {self.of}; movements {'/'.join(f'{q:.0f}' for q in quantiles)};"
            f" after shown {'/'.join(f'{q:.0f}' for q in after)}; {right}"
        )


def healthy_lives(
    twin: ft.DigitalTwin, imperfections: Imperfections, hours: int, seed: int
) -> Iterator[Lives]:
    """Yield healthy lives of an hour."""
    for number in range(0, hours, AT_ONCE):
        count = min(AT_ONCE, hours - number)
        yield live(twin, imperfections, ["healthy"] * count, MOVEMENTS, ONSET, seed + number)


def main() -> None:
    """Print the tables, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=int, default=30)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--of", default=None, help="calibration of the robot that works")
    parser.add_argument("--by", default=None, help="calibration that the watch uses")
    parser.add_argument("--learn", action="store_true", help="learn of each life as it goes")
    parser.add_argument("--alone", action="store_true", help="believe the calibration for sure")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    works, known = (load_calibration(name, robot) for name in (options.of, options.by))
    hypotheses = paper_hypotheses(robot.motor_names)
    names = [str(h) for h in hypotheses]
    models = [HealthyModel(known.twin, known.imperfections)]
    if not options.alone and known.imperfections.name != GENERIC_NAME:
        models.append(HealthyModel.of(known.twin, generic_imperfections(robot)))
    filters = [FaultFilter(model, hypotheses, Priors()) for model in models]
    share = np.array([1.0 - FOREIGN, FOREIGN] if len(filters) > 1 else [1.0])
    mixture, faults_per_h = HealthyMixture(filters, share), filters[0].faults_per_h
    diagnoser = ft.BayesDiagnoser(known.twin, known.imperfections, whole_run=False)

    def see(lives: Lives) -> Seen:
        return look_and_learn(lives, mixture, diagnoser) if options.learn else look(lives, mixture)

    begun = time.process_time()
    healthy = [
        see(lives)
        for lives in healthy_lives(works.twin, works.imperfections, options.hours, options.seed)
    ]
    truth = [names[1 + k % (len(names) - 1)] for k in range(options.faults)]
    broken = see(live(works.twin, works.imperfections, truth, FAULTY, ONSET, options.seed + 77_777))
    hours = sum(float(seen.lives.hours.sum()) for seen in healthy)
    print(f"{hours:.0f} h, {options.faults} faults, {time.process_time() - begun:.0f} s of a core")
    curves: dict[str, list[tuple[float, float]]] = {}
    everything = range(options.faults)
    for budget in BUDGETS:
        rows = [by_filter(seen, names, faults_per_h, budget) for seen in healthy]
        alarms = Told([r for t in rows for r in t.raised], [c for t in rows for c in t.cause])
        told = by_filter(broken, names, faults_per_h, budget)
        delays = Delays.of_alarms(told, broken, everything)
        _note(curves, "filter", alarms, hours, delays)
        print(f"filter, {budget:5.1f} allowed: {false_alarms(alarms, hours)}; {delays}", flush=True)
        if budget == 1.0:
            which = [c for row in alarms.cause for c in row]
            print(f"    false ones name {dict(Counter(which))}")
            for name in names[1:]:
                some = [i for i in everything if truth[i] == name]
                print(f"    {name:30s} {Delays.of_alarms(told, broken, some)}")
    by_residual(healthy, broken, curves)
    if options.picture:
        draw(curves, options.picture)


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
