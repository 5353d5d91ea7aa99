"""The answer for one run: what, how sure, since when, how large."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Interval = tuple[float, float]


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
        quality: What is wrong with the log, a line each; empty when nothing is.
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
    quality: tuple[str, ...] = ()
    protocol: str = "P0"
    method: str = ""

    @property
    def ranked(self) -> list[str]:
        """Hypotheses from the most to the least probable."""
        return sorted(self.posterior, key=lambda name: -self.posterior[name])

    @property
    def diagnosis(self) -> str:
        """The most probable hypothesis."""
        return self.ranked[0]

    @property
    def probability(self) -> float:
        """Probability of the most probable hypothesis."""
        return self.posterior[self.diagnosis]

    @property
    def runner_up(self) -> str | None:
        """The second most probable hypothesis; None where there is only one."""
        return self.ranked[1] if len(self.posterior) > 1 else None

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
            "quality": list(self.quality),
            "protocol": self.protocol,
            "method": self.method,
        }
