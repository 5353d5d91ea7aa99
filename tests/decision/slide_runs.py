"""Runs of one slide, and their densities by brute force.

The tool stands where the motor does, so that every integral over what is unknown is one over a
line. Densities are scipy's; what is believed before the run stands here in figures of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from failuretwin.digital_model.nonidealities import Imperfections, Readings
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

SCATTER_M, NOISE_M, DOF = 0.006, 0.001, 5.0
OUTLIERS = 0.01 / (4.0 / 3.0 * np.pi * 0.3**3)
"""One movement in a hundred ends anywhere within reach, 0.3 m."""
LAG_S, RAMP_S, PERIOD_S = 0.025, 0.8, 2.0
TARGETS = [0.2, -0.15, 0.1, -0.25]
STARTS_S = PERIOD_S * np.arange(4)
PLAIN = Imperfections(
    "slide",
    "test",
    settling=Settling((0.0,), (0.0,), (0.0,), (SCATTER_M,), DOF, "made up"),
    readings=Readings(10.0, noise_m=float(np.sqrt(NOISE_M**2 - 0.00006**2))),
)
"""A five-thousandth of the reach, 0.06 mm, belongs to no motor and to no sensor."""


@dataclass(frozen=True)
class Brute:
    """Densities of the settled places of one run, by scipy.

    Attributes:
        targets: Where the motor was told to go, (movement,) [m].
        stands: Where the tool was seen along the slide, (movement,) [m].
    """

    targets: np.ndarray
    stands: np.ndarray

    def at(self, movement, place, scatter=SCATTER_M):
        """Density of a settled tool if the motor goes for `place` (...), [1/m3]."""
        along = np.hypot(scatter, NOISE_M)
        shape = np.diag([along**2, NOISE_M**2, NOISE_M**2])
        off = np.zeros((*np.shape(place), 3))
        off[..., 0] = self.stands[movement] - place
        return 0.99 * stats.multivariate_t.pdf(off, np.zeros(3), shape, DOF) + OUTLIERS

    def healthy(self, movement):
        return self.at(movement, self.targets[movement])

    def before(self, first):
        """Density of all movements before the first that is spoilt."""
        return np.prod([self.healthy(m) for m in range(first)])

    def from_on(self, first, places, scatter=SCATTER_M):
        """Density of the others if the motor goes for `places` (movement, ...)."""
        count = len(self.targets)
        return np.prod([self.at(m, places[m], scatter) for m in range(first, count)], axis=0)


def scene_of(slide, run_of, targets, stands, imperfections=PLAIN):
    """Return the scene of one run that is seen at rest at `stands`, and its densities."""
    stands = np.array(stands)
    points = np.stack([stands, 0.0 * stands, 0.0 * stands], axis=-1)
    runs = run_of(np.array(targets)[:, None], points, ("motor_1",))
    likelihood = RunLikelihood(settled_evidence(runs), HealthyModel(slide, imperfections))
    return likelihood, Brute(np.array(targets), stands)


def told(weight):
    return weight.log_evidence[0]
