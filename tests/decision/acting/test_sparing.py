"""Worn motors are spared: weights from a history, plans that prefer less, and what that costs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_world import SmallWorld, carry_out, task_of

from failuretwin import InputError
from failuretwin.app.arms import spared_of
from failuretwin.connection.tracked_diagnosis import read_rows
from failuretwin.decision.acting.planner import Planner, Standing, turned_round, wear_weights
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit


def history(path, rows, robot="armpi_fpv"):
    lines = [{"history_of": robot, "calibration": "0"}, *rows]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def kept(path, rows):
    """Return rows as they come back from a file."""
    return read_rows(history(path, rows), "armpi_fpv")


def row(bias, deviation=0.0, compliance=0.0, friction=0.0):
    named = {"bias": bias, "compliance": compliance, "friction": friction}
    told = {name: np.broadcast_to(value, 4).tolist() for name, value in named.items()}
    return told | {f"{name}_deviation": [deviation] * 4 for name in named}


def test_weights_are_what_a_history_says_beyond_doubt(model, tmp_path):
    scatter = wear_unit(model)[:4]
    limit = WearLimits().limit
    last = np.array([0.0, 2.0, -1.0, 9.0]) * scatter
    rows = kept(tmp_path / "a.history.jsonl", [row(0.0), row(last / 2), row(last)])
    np.testing.assert_allclose(wear_weights(rows, model), [0.0, 2.0 / limit, 1.0 / limit, 1.0])
    # A robot is not worn by what it was like at first.
    rows = kept(tmp_path / "b.history.jsonl", [row(last), row(last)])
    np.testing.assert_array_equal(wear_weights(rows, model), np.zeros(4))


def test_doubt_is_no_wear(model, tmp_path):
    scatter = wear_unit(model)[:4]
    doubt = float(scatter.min())
    last = 2.0 * scatter
    rows = kept(tmp_path / "a.history.jsonl", [row(0.0, doubt), row(last, doubt)])
    expected = (last - 1.645 * np.sqrt(2.0) * doubt) / scatter / WearLimits().limit
    np.testing.assert_allclose(wear_weights(rows, model), np.maximum(expected, 0.0))
    rows = kept(tmp_path / "b.history.jsonl", [row(0.0, 9.0), row(last, doubt)])
    np.testing.assert_array_equal(wear_weights(rows, model), np.zeros(4))


def test_friction_that_grows_is_wear_too(model, tmp_path):
    friction = wear_unit(model)[8:]
    rows = kept(tmp_path / "a.history.jsonl", [row(0.0), row(0.0, friction=friction)])
    np.testing.assert_allclose(wear_weights(rows, model), np.full(4, 1.0 / WearLimits().limit))


def test_a_history_that_stopped_to_learn_is_told(model, tmp_path):
    said = "bias of motor_2 changes faster than by wear"
    rows = kept(tmp_path / "a.history.jsonl", [row(0.0), row(0.0) | {"alarm": said}])
    told = []
    assert spared_of((), rows, model, told.append) is None
    assert any(line.endswith(said) for line in told)
    learns = kept(tmp_path / "b.history.jsonl", [row(0.0), row(0.0) | {"alarm": ""}])
    told.clear()
    spared_of((), learns, model, told.append)
    assert len(told) == 1


def test_histories_of_others_are_refused(tmp_path):
    with pytest.raises(InputError, match="expected 'armpi_fpv'"):
        read_rows(history(tmp_path / "a.history.jsonl", [row(0.0)], "panda"), "armpi_fpv")
    with pytest.raises(InputError, match="holds no run"):
        read_rows(history(tmp_path / "b.history.jsonl", []), "armpi_fpv")


@pytest.mark.parametrize("motor", [1, 2])
def test_a_spared_motor_does_less_at_no_loss(model, armpi, motor):
    spared = np.zeros(4)
    spared[motor] = 1.0
    task = task_of(armpi, 25, 11)
    actor = carry_out(SmallWorld(model, 4), None, task, spared=spared)
    plain = carry_out(SmallWorld(model, 4), None, task)
    reached = [sum(result.reached for result in each.results) for each in (actor, plain)]
    assert reached[0] >= reached[1] - 1
    assert len(actor.ways) == 25
    assert plain.ways == []

    planner = Planner(SafetyGate(armpi), spared)
    way_s = np.mean([planner.way_s(poses, at) for poses, at in actor.ways], axis=0)
    load = np.mean([planner.load(poses)[:, motor] for poses, _ in actor.ways], axis=0)
    travel = np.mean([np.abs(poses - at.pose)[:, motor] for poses, at in actor.ways], axis=0)
    effort = load + travel / np.pi
    assert effort[0] < 0.9 * effort[1]
    assert way_s[0] >= way_s[1]
    lines = planner.sparing_lines(actor.ways)
    assert lines[0].startswith(f"motor_{motor + 1} spared (weight 1.00)")
    assert f"load {load[0]:.0%} instead of {load[1]:.0%}" in lines[0]
    assert f"{way_s[0]:.2f} instead of {way_s[1]:.2f}" in lines[-1]


def test_reversals_are_seen_by_the_travel_before():
    at = Standing(np.zeros(3), np.zeros(3), 0.0, np.array([0.1, -0.1, 0.0]))
    pose = np.array([[0.2, 0.2, 0.2], [-0.2, -0.2, -0.2]])
    assert turned_round(pose, at).tolist() == [[False, True, False], [True, False, False]]
    assert not turned_round(pose, Standing(np.zeros(3), np.zeros(3), 0.0)).any()
