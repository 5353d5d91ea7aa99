"""The life of a robot run by run: each is judged by what came before, then learned from.

    theta_i = theta_i-1 + N(0, Q),    p(theta | runs before) = base times sites of the latest runs

The folder posterior in order of time: assumed density filtering over the runs that are behind,
expectation propagation over the latest ones, which are judged again with what came after them, so
that a start that was judged wrongly is put right. A run that leaves the window stays as its site.

Section: docs/calibration_tracking.md
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.inference.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.priors import Priors
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.runs_together import Counts, RunsTogether
from failuretwin.inference.shared_belief import Belief
from failuretwin.inference.shared_likelihood import Normal
from failuretwin.inference.shared_weighing import SharedWeighing

WINDOW = 24
"""Latest runs that are judged again as more come."""
AGAIN = 8
"""Runs after which those of the window are judged again; among the first ones, whenever they have
become half as many again."""
REMEMBERED = 200.0
"""Runs by which scatter and loss rates are known at most: older ones fade."""
