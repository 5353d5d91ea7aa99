"""Values that were rounded in the log: found, said, and counted as noise."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.movements import Movements, find_movements
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.observation.rounding import grid_of


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def runs(armpi):
    known = load_calibration("armpi_fpv", armpi).imperfections
    plan = Plan(armpi, ["healthy"], 4, 3, known, RandomMovements(count=6))
    return simulate(plan)


def to(step, values):
    return np.round(values / step) * step


@pytest.mark.parametrize(("step", "told"), [(1e-3, "1 mm"), (5e-4, "0.5 mm"), (1e-2, "10 mm")])
def test_the_coarsest_grid_is_named(rng, step, told):
    found = grid_of(to(step, rng.normal(0.0, 0.2, 200)), {"mm": 1e-3})
    assert (found.step, found.told) == (pytest.approx(step), told)
    assert found.deviation == pytest.approx(step / 12.0**0.5)


def test_what_lies_on_no_grid_has_none(rng):
    values = rng.normal(0.0, 0.2, 200)
    assert grid_of(values, {"mm": 1e-3}) is None
    assert grid_of(np.array([0.0, 0.1, 0.2, np.nan]), {"mm": 1e-3}) is None


def test_rounded_tool_positions_are_noisier(twin, runs):
    coarse = runs.assign(measured=(runs["measured"].dims, to(0.005, runs["measured"].values)))
    diagnoser = BayesDiagnoser(twin)
    as_is, seen = diagnoser.seen(runs), diagnoser.seen(coarse)
    assert as_is.rounding() == []
    assert as_is.healthy is as_is.model
    (line,) = seen.rounding()
    assert "rounded to 5 mm: each is off by up to 2.5 mm" in line
    noise = np.hypot(as_is.model.path_noise, 0.005 / np.sqrt(12.0))
    assert seen.healthy.path_noise == pytest.approx(noise)
    assert seen.elsewhere() == ""  # it is noise that is known


def commanded(runs, step):
    """Return runs whose robot was told targets on a grid; it went where it went."""
    told = find_movements(runs["command"].values, runs["time"].values)
    parts = to(step, told.initial), to(step, told.target), told.ramp_duration, told.start
    command = Movements(*parts).reference(runs["time"].values)
    return runs.assign(command=(runs["command"].dims, command))


def test_commands_that_the_log_rounded_are_told_from_whole_ones(twin, runs):
    """A robot that was really told whole degrees scatters about them as it always does."""
    step = float(np.deg2rad(2.0))
    rounded = BayesDiagnoser(twin).seen(commanded(runs, step))
    (line,) = rounded.rounding()
    assert line.startswith("commands lie on steps of 2 deg")
    diagnoses = BayesDiagnoser(twin).diagnose(commanded(runs, step))
    assert all(any(line in remark for remark in d.quality) for d in diagnoses)
    found, told = (
        find_movements(one["command"].values, runs["time"].values)
        for one in (commanded(runs, step), runs)
    )
    moved = twin.path(found.target) - twin.path(told.target)
    measured = runs["measured"].values.copy()
    for run, starts in enumerate(found.start):
        for m, start in enumerate(starts):
            measured[run, runs["time"].values >= start] += moved[run, m]
            measured[run, runs["time"].values >= start] -= moved[run, m - 1] if m else 0.0
    honest = commanded(runs, step).assign(measured=(runs["measured"].dims, measured))
    assert BayesDiagnoser(twin).seen(honest).rounding() == []
