"""The life of a robot run by run: each is judged by what came before, then learned from.

    theta_i = theta_i-1 + N(0, Q),    p(theta | runs before) = base times sites of the latest runs

The folder posterior in order of time: assumed density filtering over the runs that are behind,
expectation propagation over the latest ones. Those are judged again with what came after them, so
that a start that was judged wrongly is put right. A run that leaves the window stays as its site.

The latest runs are compared with what is behind and with what that was a while ago: what changes
faster than by wear is a fault, whatever each run by itself looks like, and is not learned.

Section: docs/inference.md#lives
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Stretches
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.inference.engine.registration import (
    displaced_components,
    looked_further,
    registered_together,
    sensor_in_doubt,
)
from failuretwin.inference.engine.theta import (
    AS_TOLD,
    Layout,
    layout_of,
    offsets_doubted,
    robot_components,
)
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.together.belief import Belief, Normal, summed
from failuretwin.inference.together.folder_posterior import FolderPosterior
from failuretwin.inference.together.habits import Habits
from failuretwin.inference.together.runs_together import RunsTogether
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

WINDOW = 24
"""Latest runs that are judged again as more come, and compared with what is behind."""
AGAIN = 8
"""Runs after which those of the window are judged again; of the first ones sooner: whenever they
are half as many again. With a calibration, once in the window: it does not begin wrongly."""
FIRST = 2
"""Runs that are judged again the first time."""
ROUNDS, DAMPING = 2, 0.7
"""Times that they are judged then among the first ones, later once; share of a new site taken."""
FEWEST = 5
"""Runs below which nothing is said of a sudden change, or of where the sensor stands."""
CHANCE = 4.0
"""The latest runs may lie this many standard deviations off by chance."""
ANYWHERE = 30.0
"""How far a sudden change may go, a standard deviation in scatters: as good as anywhere."""
LEAST_SPREAD = 1e-6
"""The same of an offset that wear does not change, in units."""
MOST_DOUBT = 5.0
"""A run that leaves a bias open by more scatters says nothing of it by itself: `ANYWHERE` draws the
others by less than a 36th."""
REMEMBERED = 200.0
"""Runs by which scatter and loss rates are known at most: older ones fade."""
OFFSETS = ("bias", "compliance", "friction")


@dataclass
class LifeFilter:
    """What is believed of a robot between two of its runs; theta as of `RunsTogether`.

    Attributes:
        model: The healthy robot as it was believed to be at the beginning.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        limits: How fast and how far it may change.
        unit: Unit of theta, (theta,).
        base: What is believed without the latest runs, in units.
        habits: What is believed of scatter and losses without them; None: they are known.
        past: Mean and deviation of the offsets after every `WINDOW` runs of the last horizon,
            oldest first, (..., 2, 3 motor).
        window: The latest runs; None before the first.
        arrived: Runs so far.
        movements: Settled movements so far.
        due: Runs at which those of the window are judged again.
        alarm: What changes as no wear does, or empty.
        moved: Whether the sensor was found not to stand where the profile says.
        lag_s: How far the tool trails its commands in runs that hardly rest [s]; None: there was no
            such run, and theta has no places for lags.
        alone: What each of the runs followed last says without any belief, in units; it is not
            kept. None before them.
        begun: What was believed of the healthy robot at the beginning.
    """

    model: HealthyModel
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    limits: WearLimits
    unit: FloatArray
    base: Belief
    habits: Habits | None
    past: FloatArray
    window: RunsTogether | None = None
    arrived: int = 0
    due: int = FIRST
    movements: int = 0
    alarm: str = ""
    moved: bool = False
    lag_s: float | None = None
    alone: Normal | None = None
    begun: Imperfections = field(init=False)

    def __post_init__(self) -> None:
        self.begun = self.model.imperfections

    @classmethod
    def of(
        cls,
        model: HealthyModel,
        hypotheses: Sequence[Hypothesis],
        priors: Priors,
        limits: WearLimits,
    ) -> LifeFilter:
        """Return what is believed before any run: what the model's variation says.

        Args:
            model: A calibrated robot, or what arms of its kind are like.
            hypotheses: What may be the case.
            priors: Beliefs about faults and set-ups.
            limits: How fast and how far it may change.
        """
        layout = layout_of(model.without_doubt)
        believed = robot_components(model, layout, AS_TOLD)
        unit = believed.usual_deviation
        learns = offsets_doubted(model) and model.imperfections.settling is not None
        habits = Habits.believed(model) if learns else None
        base = Belief.of(believed, unit)
        begun = _state(base, unit, layout)[None]
        due = FIRST if learns else WINDOW
        return cls(model, hypotheses, priors, limits, unit, base, habits, begun, due=due)

    def follow(
        self, evidence: SettledEvidence, moving: TransientSamples | None = None
    ) -> Posterior:
        """Return what is the case in the next runs by those before them alone, then learn of them.

        Args:
            evidence: Settled positions of the runs, one at least.
            moving: Their readings on the way; None: they are left aside.
        """
        first = 0 if self.window is None else self.window.runs
        window = self.window = self._joined(evidence)
        again = self.arrived + len(evidence.usable) >= self.due
        if again and not self.moved and self._in_doubt(window):
            self._look_for_sensor(window)
        self.movements += int(evidence.usable.sum())
        (found,) = window.judge(np.arange(first, window.runs), moving)
        self.alone = window.alone(found)
        window.learn([found])
        if again:
            self._judge_again(window)
        for _ in range(len(evidence.usable)):
            self.arrived += 1
            if self.arrived % WINDOW == 0:
                kept = self.limits.horizon // WINDOW
                self.past = np.concatenate([self.past, self._state(self.base)[None]])[-kept:]
        self.alarm = self._unlike_wear(window)
        if self.alarm:
            window.counted[:] = False
            window.maximise()
        self.window = self._without_oldest(window)
        return looked_further(found.weighing)

    def see_moving(self, lag_s: float) -> float:
        """Let runs that hardly rest be followed too: lags are in doubt from now on.

        Args:
            lag_s: How far the tool trails its commands in them [s]; returned.
        """
        before, seen = len(self.unit), None if self.window is None else self.window.given.evidence
        self.lag_s = lag_s
        believed = robot_components(self.model, self.layout, AS_TOLD)
        self.unit = np.append(self.unit, believed.usual_deviation[before:])
        lags = Belief.of(believed, self.unit).precision[0, 0, before:, before:]
        self.base = self.base.beside(lags)
        if self.window is not None and seen is not None:
            window = self._together(_as_stretches(seen))
            window.sites.precision[:, :before, :before] = self.window.sites.precision
            window.sites.shift[:, :before] = self.window.sites.shift
            window.counted[:] = self.window.counted
            window.told.put(slice(None), self.window.told)
            window.here[:before] = self.window.here
            window.maximise()
            self.window = window
        return lag_s

    @property
    def layout(self) -> Layout:
        """Places in theta."""
        return layout_of(self.model.without_doubt, self.lag_s is not None)

    def _state(self, belief: Belief) -> FloatArray:
        """Return mean and deviation of the offsets beside those given, (2, 3 motor)."""
        return _state(belief, self.unit, self.layout)

    @property
    def belief(self) -> Belief:
        """What is believed of theta now, in units."""
        return self.base if self.window is None else self.window.belief

    @property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """Mean and deviation of bias, compliance and friction, (3, motor) each [rad, rad/(N m)]."""
        given = np.stack([getattr(self.model.settling, name) for name in OFFSETS])
        mean, deviation = self._state(self.belief).reshape(2, *given.shape)
        return given + mean, deviation

    def bias_by_run(self) -> tuple[FloatArray, FloatArray]:
        """Return what each of the runs followed last says by itself of the biases.

        They are beside those given. Compliance, friction and frame are believed to be what the
        runs behind the latest ones say of them.

        Returns:
            Mean and deviation, (run, motor) [rad]; NaN where a run leaves more open than
            `MOST_DOUBT` scatters.
        """
        alone, motors = self.alone, len(self.model.scatter)
        if alone is None:
            return np.zeros((0, motors)), np.zeros((0, motors))
        scatter = wear_unit(self.model)[:motors]
        free = slice(REGISTRATION, REGISTRATION + motors)
        prior = self._anywhere(free, ANYWHERE * scatter)
        mean, covariance = prior.times(alone).moments
        deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        mean, deviation = ((part * self.unit)[:, free] for part in (mean, deviation))
        told = deviation < MOST_DOUBT * scatter
        return np.where(told, mean, np.nan), np.where(told, deviation, np.nan)

    @property
    def learned(self) -> Imperfections:
        """The healthy robot with the offsets, scatter and rates that are most probable now."""
        return self._robot.imperfections

    @property
    def _robot(self) -> HealthyModel:
        """The healthy robot that is most probable now."""
        if self.window is None:
            return self.model
        return self.window.at(self.belief.moments[0][0] * self.unit)

    @property
    def told(self) -> FolderPosterior:
        """What all runs say together; of single ones nothing is kept."""
        (mean,), (covariance,) = self.belief.moments
        size, usual, broad = len(self.unit), self.unit, self.unit.copy()
        if self.moved:
            broad[:REGISTRATION] = np.inf
        place = mean * usual
        place[REGISTRATION:] = 0.0
        none = Normal(np.zeros((0, size, size)), np.zeros((0, size)))
        return FolderPosterior(
            self._robot,
            place,
            mean * usual,
            covariance * np.outer(usual, usual),
            broad,
            usual,
            none,
            np.zeros(0),
            (),
        )

    # The state as arrays, to go on from.

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return all that is believed, by name; its size does not grow with the runs."""
        told = {
            "arrived": np.array([self.arrived, self.due, self.moved, self.movements]),
            "alarm": np.array(self.alarm),
            "past": self.past,
            "lag": np.array(np.nan if self.lag_s is None else self.lag_s),
            **_fields("base", self.base),
            **({} if self.habits is None else _fields("habits", self.habits)),
        }
        if self.window is None:
            return told
        window = self.window
        seen = window.given.evidence
        return {
            **told,
            **_fields("sites", window.sites),
            **_fields("told", window.told),
            **seen.to_arrays("seen"),
            "window": np.array(seen.usable.shape),
            "counted": window.counted,
            "here": window.here,
        }

    def resumed(self, arrays: Mapping[str, FloatArray]) -> LifeFilter:
        """Return what was believed when `to_arrays` was asked; begun as this one.

        Raises:
            KeyError: If something is missing.
            ValueError: If something is of another shape.
        """
        arrived, due, moved, settled = arrays["arrived"].astype(int).tolist()
        base = Belief(*(arrays[f"base/{f.name}"] for f in fields(Belief)))
        habits = None if self.habits is None else _read(Habits, "habits", arrays)
        began, lag_s = copy.deepcopy(self), float(arrays["lag"])
        if np.isfinite(lag_s):
            began.see_moving(lag_s)
        found = replace(
            began,
            base=base,
            habits=habits,
            past=arrays["past"],
            arrived=arrived,
            due=due,
            moved=bool(moved),
            movements=settled,
            alarm=str(arrays["alarm"]),
        )
        if "window" not in arrays:
            return found
        runs, movements = arrays["window"].astype(int).tolist()
        motors = len(self.model.scatter)
        seen = SettledEvidence.empty(run=runs, movement=movements, motor=motors, axis=3)
        if found.lag_s is not None:
            seen = _as_stretches(seen)
        seen.from_arrays("seen", arrays)
        window = found._together(seen)
        window.sites = Normal(arrays["sites/precision"], arrays["sites/shift"])
        window.told = _read(Habits, "told", arrays)
        window.counted[:], window.here = arrays["counted"], arrays["here"]
        window.maximise()
        found.window = window
        return found

    # The latest runs: joined by new ones, judged again, let go of.

    def joined_evidence(self, evidence: SettledEvidence) -> SettledEvidence:
        """Return the settled positions of the latest runs with new ones behind them."""
        if self.lag_s is not None:
            evidence = _as_stretches(evidence)
        return evidence if self.window is None else self.window.given.evidence.followed_by(evidence)

    def _joined(self, evidence: SettledEvidence) -> RunsTogether:
        """Return the latest runs with new ones behind them."""
        before, after = self.window, self._together(self.joined_evidence(evidence))
        if before is not None:
            _take(after, slice(0, before.runs), before, slice(None))
        return after

    def _together(self, evidence: SettledEvidence) -> RunsTogether:
        likelihood = RunLikelihood(evidence, self.model)
        asked = self.hypotheses, self.priors, self.layout
        found = RunsTogether.of(likelihood, *asked, self.base, self.unit)
        found.habits = self.habits
        found.here = self.layout.place(self.base.moments[0][0] * self.unit)
        found.maximise()
        return found

    def _judge_again(self, window: RunsTogether) -> None:
        arrived = self.arrived + 1
        sooner = min(arrived + (arrived + 1) // 2, arrived + AGAIN)
        self.due = max(self.arrived + 2, sooner) if self.habits is not None else arrived + WINDOW
        rounds = ROUNDS if arrived < WINDOW else 1
        for _ in range(rounds if window.runs > 1 else 0):
            window.learn(window.judge(np.arange(window.runs)), DAMPING)

    def _without_oldest(self, window: RunsTogether) -> RunsTogether:
        """Return the latest runs alone; what older ones say becomes part of the base."""
        old = window.runs - WINDOW
        if old <= 0:
            return window
        for row in range(old):
            if window.counted[row]:
                one = slice(row, row + 1)
                site = Normal(window.sites.precision[one], window.sites.shift[one])
                self.base = self.base.times(site).pruned()
                if self.habits is not None:
                    fading = self.habits.fading(1.0 - 1.0 / REMEMBERED, self.model)
                    self.habits = fading.plus(window.told[one])
            self.base = self.base.blurred(self._walk)
        kept = slice(old, None)
        rest = self._together(window.given.evidence[kept])
        _take(rest, slice(None), window, kept)
        return rest

    @property
    def _walk(self) -> FloatArray:
        """Variance of the random walk of a run, in units, (theta,)."""
        step, offsets = np.zeros(len(self.unit)), self.layout.offsets
        step[offsets] = self.limits.rate * wear_unit(self.model) / self.unit[offsets]
        return step**2

    # Where the sensor stands.

    def _in_doubt(self, window: RunsTogether) -> bool:
        """Return whether the latest runs say that the sensor stands elsewhere."""
        few = window.runs < FEWEST
        return not few and sensor_in_doubt(window.given, self.hypotheses, self.priors)

    def _look_for_sensor(self, window: RunsTogether) -> None:
        """Let the frame of the sensor be anywhere near, and judge the latest runs anew."""
        usual = robot_components(self.model, self.layout, AS_TOLD)
        asked = self.model, self.priors.setup, self.layout, usual
        variance = (displaced_components(*asked).widest / self.unit) ** 2
        variance[REGISTRATION:] = 0.0
        self.moved = True
        self.base = self.base.or_moved(variance, self.priors.setup.odds)
        window.base = self.base
        window.sites.precision[:], window.sites.shift[:] = 0.0, 0.0
        there = registered_together(window.given, self.hypotheses, self.priors)
        window.here = np.concatenate([there, np.zeros(len(self.unit) - REGISTRATION)])

    # What changes as no wear does.

    def _unlike_wear(self, window: RunsTogether) -> str:
        """Return what has changed more than wear can make it, or nothing.

        The latest runs by themselves are compared with what is behind them and with what that was a
        horizon ago: a fault that grows slowly drags the belief along before it shows. Of an unknown
        robot fewer runs than these are no measure: a wrong start is outweighed, not defended.
        """
        if window.runs < FEWEST:
            return ""
        wear = wear_unit(self.model)
        now, chance = self._by_itself(window, wear)

        def off(known: FloatArray, most: float) -> FloatArray:
            """Return by how much each offset lies off beyond `most` and chance."""
            return np.abs(now - known[0]) - most * wear - CHANCE * np.hypot(chance, known[1])

        measured = self.habits is None or self.arrived >= 2 * WINDOW
        behind = (self._state(self.base), self.past[0]) if measured else ()
        fast = np.max([np.full_like(now, -np.inf), *(off(k, self.limits.reach) for k in behind)], 0)
        begun = np.stack([np.zeros_like(wear), self.unit[self.layout.offsets]])
        excess = np.maximum(fast, off(begun, self.limits.limit))
        over = np.divide(excess, wear, out=np.zeros_like(wear), where=wear > 0.0)
        worst = int(np.argmax(over))
        if over[worst] <= 0.0:
            return ""
        kind, motor = divmod(worst, len(self.model.scatter))
        how = (
            "changes faster than by wear" if fast[worst] > 0.0 else "is worn beyond what is normal"
        )
        return f"{OFFSETS[kind]} of {self.model.motor_names[motor]} {how}"

    def _by_itself(self, window: RunsTogether, wear: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return offsets that the latest runs have if any are as good, and their deviation."""
        anywhere = self._anywhere(self.layout.offsets, ANYWHERE * wear)
        return tuple(self._state(anywhere.times(summed(window.sites))))

    def _anywhere(self, free: slice, spread: FloatArray) -> Belief:
        """Return what is believed without the latest runs, but some of theta is anywhere."""
        (mean,), (covariance,) = self.base.moments
        loose = np.zeros(len(self.unit), dtype=bool)
        loose[free] = True
        precision, rest = np.zeros_like(covariance), np.ix_(~loose, ~loose)
        precision[rest] = np.linalg.inv(covariance[rest])
        of_each = np.maximum(spread / self.unit[free], LEAST_SPREAD)
        precision[loose, loose] = of_each**-2.0
        return Belief(np.zeros((1, 1)), precision[None, None], (precision @ mean)[None, None])


def _as_stretches(evidence: SettledEvidence) -> SettledEvidence:
    return replace(evidence, movements=Stretches.of(evidence.movements))


def _state(belief: Belief, unit: FloatArray, layout: Layout) -> FloatArray:
    """Return mean and deviation of the offsets beside those given, (2, 3 motor)."""
    (mean,), (covariance,) = belief.moments
    both = np.stack([mean, np.sqrt(np.diag(covariance))]) * unit
    return np.asarray(both[:, layout.offsets])


def _fields(name: str, value: Belief | Normal | Habits) -> dict[str, FloatArray]:
    """Return the arrays of a value by ``name/field``."""
    return {f"{name}/{f.name}": getattr(value, f.name) for f in fields(value)}


def _read(kind: type[Habits], name: str, arrays: Mapping[str, FloatArray]) -> Habits:
    """Return a value from its arrays."""
    return kind(*(arrays[f"{name}/{f.name}"] for f in fields(kind)))


def _take(after: RunsTogether, rows: slice, before: RunsTogether, kept: slice) -> None:
    """Take over what is known of some runs."""
    after.sites.precision[rows] = before.sites.precision[kept]
    after.sites.shift[rows] = before.sites.shift[kept]
    after.counted[rows] = before.counted[kept]
    after.told.put(rows, before.told[kept])
    after.here = before.here
    after.maximise()
