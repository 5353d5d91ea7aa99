"""The answer for one run: what, how sure, since when, how large."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Interval = tuple[float, float]


@dataclass(frozen=True)
class MovementEvidence:
    """What one movement says.

    Attributes:
        movement: Its number in the run, from 1.
        nats: How much it speaks for the most probable hypothesis over the second.
    """

    movement: int
    nats: float


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of one run. `None` stands for what is not known or does not apply.

    Attributes:
        run: Name of the run.
        posterior: Probability of every hypothesis; sums to 1.
        truth: True hypothesis, where the run set knows it.
        onset_s: When the fault began [s]; 0 when it was there before the run.
        onset_90: 90 % interval of the onset [s].
        magnitude: Size of the fault in `magnitude_unit`.
        magnitude_unit: Unit of the fault mode.
        magnitude_90: 90 % interval of the magnitude.
        verdict: One plain sentence.
        explanation: Why, what else it may be, and what to do now, a line each.
        evidence: What each usable movement says.
        quality: What is wrong with the log, a line each; empty when nothing is.
        undecided: Why there is no verdict; empty where there is one.
        protocol: How much real data the method has seen: P0, P0c, P1 or P2.
        method: Which diagnoser, with which healthy behaviour.
    """

    run: str
    posterior: Mapping[str, float]
    truth: str | None = None
    onset_s: float | None = None
    onset_90: Interval | None = None
    magnitude: float | None = None
    magnitude_unit: str | None = None
    magnitude_90: Interval | None = None
    verdict: str = ""
    explanation: tuple[str, ...] = ()
    evidence: tuple[MovementEvidence, ...] = ()
    quality: tuple[str, ...] = ()
    undecided: str = ""
    protocol: str = "P0"
    method: str = ""

    @property
    def ranked(self) -> list[str]:
        """Hypotheses from the most to the least probable."""
        return sorted(self.posterior, key=lambda name: -self.posterior[name])

    @property
    def diagnosis(self) -> str | None:
        """The most probable hypothesis; None where the log allows no verdict."""
        return None if self.undecided else self.ranked[0]

    @property
    def probability(self) -> float | None:
        """Probability of the most probable hypothesis; None where the log allows no verdict."""
        return None if self.undecided else self.posterior[self.ranked[0]]

    @property
    def runner_up(self) -> str | None:
        """The second most probable hypothesis; None where there is none."""
        return None if self.undecided or len(self.posterior) < 2 else self.ranked[1]

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Diagnosis:
        """Return the diagnosis whose `dataclasses.asdict` went through JSON.

        Raises:
            TypeError: If a field is unknown or missing.
        """
        intervals = {
            name: None if fields[name] is None else tuple(fields[name])
            for name in ("onset_90", "magnitude_90")
        }
        evidence = tuple(MovementEvidence(**movement) for movement in fields["evidence"])
        lines = {name: tuple(fields[name]) for name in ("explanation", "quality")}
        return cls(**{**fields, **intervals, **lines, "evidence": evidence})

    def to_record(self) -> dict[str, Any]:
        """Return the JSON object of the contract."""
        return {
            "run": self.run,
            "truth": self.truth,
            "diagnosis": self.diagnosis,
            "probability": self.probability,
            "posterior": dict(self.posterior),
            "runner_up": self.runner_up,
            "onset_s": self.onset_s,
            "onset_90": self.onset_90,
            "magnitude": self.magnitude,
            "magnitude_unit": self.magnitude_unit,
            "magnitude_90": self.magnitude_90,
            "verdict": self.verdict,
            "explanation": list(self.explanation),
            "evidence": [{"movement": e.movement, "nats": e.nats} for e in self.evidence],
            "quality": list(self.quality),
            "protocol": self.protocol,
            "method": self.method,
        }
