"""What is known of the fault modes: one table, read by priors, verdicts and documentation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.hypothesis import Fault, Hypothesis


@dataclass(frozen=True)
class FailureMode:
    """One row of the table `failure_modes.toml`, where each column is explained.

    Attributes:
        name: What a person calls it; ``{motor}`` stands for the motor.
        mechanisms: What breaks.
        effect: What the motor then does.
        shows: How it looks at the tool.
        prior_odds: Odds against healthy for each motor before a run is seen.
        before_run: Probability that the fault was there before the run, if it is there.
        advice: What to do now.
        source: Where the row comes from.
        sizes: Magnitudes that diagnosis considers, in the unit of the mode; none for modes with
            beliefs of their own.
    """

    name: str
    mechanisms: tuple[str, ...]
    effect: str
    shows: str
    prior_odds: float
    before_run: float
    advice: str
    source: str
    sizes: tuple[float, ...] = ()


@cache
def failure_modes() -> dict[str, FailureMode]:
    """Return the table, by mode id."""
    path = Path(str(files("failuretwin.data_knowledge") / "failure_modes.toml"))
    table = read_toml(path)
    return {mode: from_table(FailureMode, row, f"{path}: {mode}") for mode, row in table.items()}


def magnitude_range(mode: str) -> tuple[float, float]:
    """Return lowest and highest magnitude that diagnosis considers, in the unit of the mode."""
    low, high = failure_modes()[mode].sizes
    return low, high


def prior_odds(hypothesis: Hypothesis) -> float:
    """Return the odds of a hypothesis against healthy; faults of several motors multiply."""
    odds = 1.0
    for fault in hypothesis.faults:
        odds *= failure_modes()[fault.mode].prior_odds
    return odds


def plain_name(hypothesis: Hypothesis) -> str:
    """Return a hypothesis as a person would say it, such as ``motor 3 stuck``."""
    if not hypothesis.known:
        return "something that none of the known faults explains"
    return " and ".join(_plain_fault(fault) for fault in hypothesis.faults) or "healthy"


def _plain_fault(fault: Fault) -> str:
    return failure_modes()[fault.mode].name.format(motor=fault.motor.replace("_", " "))
