from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.random_movements import RandomMovements
from user_modes import code_on_the_page, registered_from

ZERO = (0.0,) * 4


@pytest.fixture(scope="session")
def sagging():
    """Motors that give way under load and do nothing else that the published twin does not."""
    settling = Settling(ZERO, (0.5,) * 4, ZERO, ZERO, np.inf, "test")
    return Imperfections("sagging", "test", settling=settling)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """The mode that the page on fault modes offers for copying, registered for this module."""
    with registered_from(code_on_the_page(), tmp_path_factory.mktemp("template")) as mode:
        yield mode


@pytest.fixture(scope="session")
def runs_of(armpi):
    """Simulate runs in which one motor has a mode; without a mode, healthy ones of that seed."""

    def run(mode=None, motor="motor_2", count=8, seed=1, imperfections=NO_IMPERFECTIONS, ramps=()):
        state = Hypothesis((Fault(motor, mode.mode),) if mode else ())
        movements = RandomMovements(ramp_shares=ramps) if ramps else RandomMovements()
        modes = {mode.mode: mode} if mode else {}
        plan = Plan(armpi, [state], count, seed, imperfections, movements, modes)
        return simulate_runs(plan, range(count))

    return run
