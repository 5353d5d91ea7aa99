"""Model and network together: the paper's closing idea, in two forms.

Blended: log probabilities of both are added with weights fitted on simulated runs. Gated: the
Bayesian part alone says how probable a healthy robot is, the network shares the rest among faults.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.decision.learned.blend import Weights, blended, gated
from failuretwin.decision.learned.telling import told

if TYPE_CHECKING:
    import xarray as xr

HEALTHY = "healthy"


class Diagnoser(Protocol):
    """Whatever diagnoses runs: the Bayesian diagnoser, a network."""

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run."""
        ...


@dataclass(frozen=True)
class HybridDiagnoser:
    """Two diagnosers as one.

    Attributes:
        bayes: The model-based one; where it gives no verdict, there is none.
        network: The learned one, of the same classes.
        weights: Of a blend; None: gated.
    """

    bayes: Diagnoser
    network: Diagnoser
    weights: Weights | None = None

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run of a run set.

        Onset and size are those of the Bayesian part, where both agree on the fault.

        Raises:
            InputError: If the parts know different classes.
        """
        pairs = zip(self.bayes.diagnose(runs), self.network.diagnose(runs), strict=True)
        return [self._joined(first, second) for first, second in pairs]

    def _joined(self, bayes: Diagnosis, network: Diagnosis) -> Diagnosis:
        if bayes.undecided:
            return bayes
        if set(bayes.posterior) != set(network.posterior):
            raise InputError(
                f"the parts know different classes: {', '.join(bayes.posterior)} and "
                f"{', '.join(network.posterior)}."
            )
        classes = list(bayes.posterior)
        first = np.array([[bayes.posterior[name] for name in classes]])
        second = np.array([[network.posterior[name] for name in classes]])
        if self.weights is None:
            chances = gated(first, second, classes.index(HEALTHY))[0]
        else:
            chances = blended(first, second, self.weights)[0]
        joined = replace(
            bayes,
            posterior=dict(zip(classes, map(float, chances), strict=True)),
            evidence=(),
            protocol=max(bayes.protocol, network.protocol),
            method=f"{'gated' if self.weights is None else 'blended'}: {bayes.method} with "
            f"{network.method}",
        )
        if joined.diagnosis != bayes.diagnosis:
            joined = replace(
                joined,
                onset_s=None,
                onset_90=None,
                magnitude=None,
                magnitude_unit=None,
                magnitude_90=None,
            )
        return told(joined)
