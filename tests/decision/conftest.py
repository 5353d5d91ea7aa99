from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.data_knowledge.generation import Plan, simulate
from failuretwin.digital_model.imperfections import load_imperfections


@pytest.fixture(scope="session")
def imperfect(armpi):
    """Twenty runs of each of the paper's classes, with the imperfections of the real robot."""
    known = load_imperfections("armpi_fpv", armpi)
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 20, 5, known))


@pytest.fixture(scope="session")
def diagnoses(twin, imperfect):
    """What the default diagnoser says of `imperfect`."""
    return BayesDiagnoser(twin).diagnose(imperfect)


@pytest.fixture(scope="session")
def run_of():
    """Make a run set of one run: motors go to `targets`, the tool reads `measured`."""

    def make(targets, measured, motors=("motor_1", "motor_2"), rate=100.0, ramp_s=0.8):
        targets = np.asarray(targets, dtype=float)
        count = len(targets)
        time = np.arange(200 * count) * 0.01
        movements = Movements(
            initial=np.zeros((1, len(motors))),
            target=targets[None],
            ramp_duration=np.full((1, *targets.shape), ramp_s),
            start=2.0 * np.arange(count, dtype=float)[None],
        )
        path = measured(time) if callable(measured) else np.repeat(measured, 200, axis=0)
        return RunTable(
            run=["run"],
            motor=motors,
            time=time,
            command=movements.reference(time),
            measured=np.array(path, dtype=float)[None],
            measured_rate_hz=rate,
        ).to_dataset()

    return make
