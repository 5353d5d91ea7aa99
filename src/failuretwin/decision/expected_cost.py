"""What to do about an arm: the action of least expected cost, with the user's own costs.

    choose argmin over a of E[C(a)] = sum over h of p(h) C(a, h)
    C(a, h) = price(a) + targets * missed_target * share missed(a, h)
    C(inspect, h) = price(inspect) + min over the other a of C(a, h)

An inspection tells which hypothesis is true, so that what follows it is the best for that one.
Replacing a motor makes it as good as new; a fault of another one stays. No cost is ours: a file of
the user says them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds, Share, from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY, Fault, Hypothesis
from failuretwin.core.types import FloatArray

CONTINUE, COMPENSATE, SLOW_DOWN = "continue", "compensate", "slow down"
INSPECT, REPLACE, STOP = "inspect", "replace", "stop"
ANY = "any"
"""Name of the row that stands for modes without one of their own."""


@dataclass(frozen=True)
class Missed(Bounded):
    """Share of targets that an arm with a fault misses, by what is done.

    Attributes:
        going_on: As if nothing were wrong.
        compensating: With `failuretwin act`.
        slowly: Slowed down.
    """

    going_on: Share
    compensating: Share
    slowly: Share


@dataclass(frozen=True)
class Costs(Bounded):
    """What things cost, in a currency of the user's.

    Attributes:
        targets: Targets until something else can be decided.
        missed_target: Cost of a target that is missed.
        compensate: Price of working round a fault: it is slower, and somebody watches.
        slow_down: Price of working slowly.
        inspect: Price of finding out for sure.
        replace: Price of a new motor, built in.
        stop: Price of standing still until then.
        missed: Shares of missed targets by fault mode; `any` for modes that are not named.
        healthy: The same of a healthy arm.
        currency: What costs are told in.
    """

    targets: Annotated[float, Bounds(0.0, 1e12)]
    missed_target: AtLeastZero
    compensate: AtLeastZero
    slow_down: AtLeastZero
    inspect: AtLeastZero
    replace: AtLeastZero
    stop: AtLeastZero
    missed: dict[str, Missed] = field(default_factory=dict)
    healthy: Missed = Missed(0.0, 0.0, 0.0)
    currency: str = ""

    def missed_by(self, fault: Fault) -> Missed:
        """Return the shares of a fault."""
        row = self.missed.get(fault.mode, self.missed.get(ANY))
        if row is None:
            raise InputError(
                f"costs: no shares of missed targets for mode {fault.mode!r}. Add a table "
                f"[missed.{fault.mode}], or [missed.any]."
            )
        return row


def costs_template() -> str:
    """Return a file of costs to be filled in; none is shipped as truth."""
    return (files("failuretwin.decision") / "costs.template").read_text(encoding="utf-8")


def load_costs(path: str | Path) -> Costs:
    """Load the user's costs from a TOML file; see `costs_template`."""
    return from_table(Costs, read_toml(Path(path)), str(path))


@dataclass(frozen=True)
class Option:
    """One thing that can be done.

    Attributes:
        action: What.
        motor: Which motor, where one is replaced.
        cost: Expected cost.
    """

    action: str
    motor: str
    cost: float

    def __str__(self) -> str:
        return f"{self.action} {self.motor}".strip()


@dataclass(frozen=True)
class Advice:
    """What can be done about an arm, the cheapest first.

    Attributes:
        options: All of them.
        hinge: Hypothesis whose probability decides between the first two; empty: none does.
        hinge_probability: Probability of it at which they change places.
        currency: What costs are told in.
    """

    options: Sequence[Option]
    hinge: str
    hinge_probability: float
    currency: str

    @property
    def best(self) -> Option:
        """What to do."""
        return self.options[0]

    @property
    def verdict(self) -> str:
        """One plain sentence or two."""
        first, second = self.options[:2]
        money = f" {self.currency}" if self.currency else ""
        said = (
            f"{first}: expected cost {first.cost:.3g}{money}; next best {second}, "
            f"{second.cost:.3g}{money}"
        )
        if not self.hinge:
            return f"{said}. No single probability changes that"
        return (
            f"{said}. It hinges on {self.hinge}: at {self.hinge_probability:.0%} they change places"
        )


def cost_of(action: str, motor: str, hypothesis: Hypothesis, costs: Costs) -> float:
    """Return C(a, h) of an action other than inspecting."""
    if action == STOP:
        return costs.stop
    faults = hypothesis.faults if hypothesis.known else (Fault("", ANY),)
    if action == REPLACE:
        faults = tuple(fault for fault in faults if fault.motor != motor)
    rows = [costs.missed_by(fault) for fault in faults] or [costs.healthy]
    price, share = {
        COMPENSATE: (costs.compensate, max(row.compensating for row in rows)),
        SLOW_DOWN: (costs.slow_down, max(row.slowly for row in rows)),
        REPLACE: (costs.replace, max(row.going_on for row in rows)),
    }.get(action, (0.0, max(row.going_on for row in rows)))
    return price + costs.targets * costs.missed_target * share


def cost_table(
    hypotheses: Sequence[Hypothesis], costs: Costs
) -> tuple[list[tuple[str, str]], FloatArray]:
    """Return all actions and C(a, h), (action, hypothesis)."""
    motors = sorted({fault.motor for h in hypotheses for fault in h.faults})
    actions = [(CONTINUE, ""), (COMPENSATE, ""), (SLOW_DOWN, ""), (STOP, "")]
    actions += [(REPLACE, motor) for motor in motors]
    table = np.array(
        [[cost_of(action, motor, h, costs) for h in hypotheses] for action, motor in actions]
    )
    known = costs.inspect + table.min(axis=0)
    return [*actions, (INSPECT, "")], np.vstack([table, known])


def advise(posterior: Mapping[str, float], costs: Costs | str | Path) -> Advice:
    """Return what to do about an arm.

    Args:
        posterior: Probability of each hypothesis, by its text; they sum to 1.
        costs: What things cost, or the file that says it.

    Raises:
        InputError: If a mode has no share of missed targets, or the file cannot be read.
    """
    costs = costs if isinstance(costs, Costs) else load_costs(Path(costs))
    hypotheses = [Hypothesis.parse(name) for name in posterior]
    if HEALTHY not in hypotheses:
        raise InputError("the posterior does not say how probable it is that the arm is healthy.")
    actions, table = cost_table(hypotheses, costs)
    probability = np.array(list(posterior.values()))
    expected = table @ probability
    order = np.argsort(expected, kind="stable")
    ranked = [(*actions[int(i)], float(expected[i])) for i in order]
    options = [Option(action, motor, cost) for action, motor, cost in ranked]
    hinge, at = _hinge(table[order[0]] - table[order[1]], probability)
    name = str(hypotheses[hinge]) if hinge >= 0 else ""
    return Advice(options, name, at, costs.currency)


def _hinge(difference: FloatArray, probability: FloatArray) -> tuple[int, float]:
    """Return the hypothesis whose probability must change least for the best to change.

    With its probability at t and the others in proportion, the difference of two costs is
    t d_h + (1 - t) sum over others of p d / (1 - p_h): a line in t, which is 0 at one place.

    Returns:
        Its index, -1 if none, and the probability.
    """
    rest = 1.0 - probability
    left = difference @ probability - difference * probability
    others = np.divide(left, rest, out=np.zeros_like(rest), where=rest > 1e-12)
    apart = others - difference
    t = np.divide(others, apart, out=np.full_like(rest, np.nan), where=apart != 0.0)
    away = np.where((t >= 0.0) & (t <= 1.0), np.abs(t - probability), np.inf)
    best = int(np.argmin(away))
    return (best, float(t[best])) if np.isfinite(away[best]) else (-1, np.nan)
