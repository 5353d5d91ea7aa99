"""All that the golden cases use of the package: when its files move, this is what to rewrite."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.calibration.observations import observe
from failuretwin.core.hypothesis import parse_hypotheses
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.decision.learned.feature_encoder import (
    FeatureEncoder,
    augmented_features,
    original_features,
    signals_of,
)
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import LostCommand, Readings
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference import seen_runs
from failuretwin.inference.engine import registration
from failuretwin.inference.expected_bayes_factors import expected_log_bayes_factors
from failuretwin.inference.faults.priors import MONITORING, priors_of
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.log_quality import log_quality

__all__ = [
    "MODES",
    "MONITORING",
    "LostCommand",
    "Readings",
    "StreamingFleet",
    "augmented_features",
    "expected_log_bayes_factors",
    "fit_calibration",
    "generic_imperfections",
    "load_run_set",
    "log_quality",
    "monitor",
    "observe",
    "original_features",
    "parse_hypotheses",
    "priors_of",
    "save_run_set",
    "signals_of",
]

MEASURED = Path(__file__).parents[1] / "measured_armpi.toml"
"""Imperfections of the ArmPi whose figures stay as they are, whatever the package bundles."""


@cache
def twin(name="armpi_fpv"):
    return ft.DigitalTwin(ft.load_robot(name))


def healthy(which, robot):
    """Return imperfections by name: `own`, `generic`, `none`, `measured` or a bundled one."""
    if which == "own":
        return load_calibration(None, robot).imperfections
    if which == "generic":
        return generic_imperfections(robot)
    return load_calibration(str(MEASURED) if which == "measured" else which, robot).imperfections


def robust_features(robot, imperfections, runs):
    encoder = FeatureEncoder("robust", robot, imperfections)
    return encoder.residuals(signals_of(runs))


def evidence_of(diagnoser, runs):
    """Return what the runs say where the tool rests, and on the way as far as that counts."""
    sound = Evidence(runs).sound
    if not diagnoser.uses_transients:
        return sound.settled, None
    return sound.settled, sound.transient.where(diagnoser.transient_mask(sound.settled.usable))


def with_log_evidence(diagnoser, runs):
    """Return the diagnoses, and the log evidence before the prior, (run, hypothesis)."""
    kept = []

    def weighed(*arguments):
        kept.append(registration.run_posterior(*arguments))
        return kept[-1]

    with mock.patch.object(seen_runs, "run_posterior", weighed):
        diagnoses = diagnoser.diagnose(runs)
    says = [np.stack([weight.log_evidence for weight in j.weights], axis=1) for j in kept]
    return diagnoses, np.concatenate(says)
