from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from failuretwin.core.hypothesis import MAGNITUDE_UNITS, Fault, Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate_runs
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.settling import Settling
from failuretwin.failure_behavior.modes import MODES
from failuretwin.failure_behavior.random_movements import RandomMovements

PAGE = Path(__file__).parents[2] / "docs" / "fault_modes.md"
ZERO = (0.0,) * 4


@pytest.fixture(scope="session")
def sagging():
    """Motors that give way under load and do nothing else that the published twin does not."""
    settling = Settling(ZERO, (0.5,) * 4, ZERO, ZERO, np.inf, "test")
    return Imperfections("sagging", "test", settling=settling)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """The mode that the page on fault modes offers for copying, registered for this module."""
    text = PAGE.read_text("utf-8").partition("## A mode of your own")[2]
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    path = tmp_path_factory.mktemp("template") / "mode_from_the_page.py"
    path.write_text(code)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    modes, units = dict(MODES), dict(MAGNITUDE_UNITS)
    spec.loader.exec_module(module)
    (name,) = MODES.keys() - modes.keys()
    yield MODES[name]
    for registry, before in ((MODES, modes), (MAGNITUDE_UNITS, units)):
        registry.clear()
        registry.update(before)
    del sys.modules[path.stem]


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
