"""An arm in a plane: along one axis nothing moves the tool, and that is no dead sensor."""

from __future__ import annotations

import pytest
from small_arms import PLANAR, small_twin

from failuretwin import BayesDiagnoser, StreamingDiagnoser
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate

STATES = [Hypothesis(), Hypothesis.parse("motor_2:stuck")]


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return small_twin(tmp_path_factory.mktemp("planar"), "planar", PLANAR, "0.25 0 0")


@pytest.fixture(scope="module")
def runs(twin):
    return simulate(Plan(twin.robot, STATES, 2, seed=3))


def test_an_axis_along_which_no_motor_moves_the_tool_is_not_dead(twin, armpi, runs):
    assert twin.robot.idle_axes == (False, False, True)
    assert armpi.idle_axes == (False, False, False)
    found = BayesDiagnoser(twin).diagnose(runs)
    assert [d.diagnosis for d in found] == runs["fault"].values.tolist()
    assert not any("dead" in line for d in found for line in d.quality)


def test_a_stream_goes_on_beside_an_axis_that_never_moves(twin, runs):
    one = runs.isel(run=2)
    stream = StreamingDiagnoser(BayesDiagnoser(twin))
    samples = (one[name].values for name in ("time", "command", "measured"))
    for time, command, point in zip(*samples, strict=True):
        stream.update(time, command, point)
    answer = stream.conclude()
    assert answer.diagnosis is not None
    assert answer.diagnosis.diagnosis == "motor_2:stuck"
