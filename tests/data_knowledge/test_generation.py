from __future__ import annotations

import json
import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import xarray as xr

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    UNKNOWN,
    Hypothesis,
    paper_hypotheses,
)
from failuretwin.core.runs import check_runs
from failuretwin.data_knowledge import generate as generation
from failuretwin.data_knowledge.generate import Plan, iterate, simulate, simulate_runs
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.registry import MODES

BOTH = pytest.mark.parametrize("imperfections", ["none", "armpi_fpv"])
VALUES = ("command", "measured", "position")


@pytest.fixture
def plan_of(armpi):
    def plan(imperfections="armpi_fpv", runs_per_class=2, seed=0, hypotheses=None):
        known = load_calibration(imperfections, armpi).imperfections
        classes = hypotheses or paper_hypotheses(armpi.motor_names)
        return Plan(armpi, classes, runs_per_class, seed, known)

    return plan


def parse(text, armpi):
    return [Hypothesis.parse(part, armpi.motor_names) for part in text.split(",")]


@BOTH
def test_run_set_keeps_the_contract(plan_of, imperfections):
    runs = check_runs(simulate(plan_of(imperfections)), "simulated")
    classes = [str(h) for h in paper_hypotheses([f"motor_{k}" for k in range(1, 5)])]
    assert runs["fault"].values.tolist() == np.repeat(classes, 2).tolist()
    samples = 1000
    if imperfections != "none":  # room for two late starts
        samples += round(200 * plan_of(imperfections).imperfections.timing.late_s[1])
    assert runs.sizes == {"run": 18, "time": samples, "motor": 4, "axis": 3, "movement": 5}
    np.testing.assert_allclose(runs["time"], np.arange(samples) * 0.01)
    ends = runs["duration"].values
    assert (ends >= 10.0 - 0.011).all() and (ends <= runs["time"].values[-1]).all()
    seen = np.isfinite(runs["measured"].values[..., 0])
    assert not seen[runs["time"].values > ends[:, None] + 0.005].any()
    assert runs.attrs["measured_rate_hz"] == (100.0 if imperfections == "none" else 10.0)
    assert (runs.attrs["robot"], runs.attrs["seed"]) == ("armpi_fpv", 0)
    configuration = json.loads(runs.attrs["configuration"])
    assert configuration["imperfections"] == imperfections
    assert configuration["hypotheses"] == classes


def test_number_of_workers_does_not_matter(monkeypatch, plan_of):
    monkeypatch.setattr(generation, "CHUNK_RUNS", 5)
    plan = plan_of("armpi_fpv")
    xr.testing.assert_identical(simulate(plan, workers=1), simulate(plan, workers=2))


@BOTH
def test_size_of_chunks_does_not_matter(monkeypatch, plan_of, imperfections):
    whole = simulate(plan_of(imperfections))
    monkeypatch.setattr(generation, "CHUNK_RUNS", 1)
    xr.testing.assert_identical(simulate(plan_of(imperfections)), whole)


@BOTH
@pytest.mark.parametrize("subset", [[7], [17, 0, 9, 8], range(17, -1, -1)])
def test_a_run_is_the_same_whatever_is_made_beside_it(plan_of, imperfections, subset):
    plan = plan_of(imperfections)
    whole, some = simulate_runs(plan, range(plan.size)), simulate_runs(plan, subset)
    rows = list(subset)
    for name in VALUES:
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[rows])
    for field in fields(some.movements):
        np.testing.assert_array_equal(
            getattr(some.movements, field.name), getattr(whole.movements, field.name)[rows]
        )
    assert list(some.run) == [whole.run[row] for row in rows]
    np.testing.assert_array_equal(some.truth.magnitude, whole.truth.magnitude[rows])


@BOTH
def test_the_seed_alone_decides(plan_of, imperfections):
    one, same = simulate(plan_of(imperfections)), simulate(plan_of(imperfections))
    other = simulate(plan_of(imperfections, seed=1))
    xr.testing.assert_identical(one, same)
    for run in range(one.sizes["run"]):
        assert not np.array_equal(one["command"][run], other["command"][run])


def test_no_two_runs_are_alike(plan_of):
    command = simulate(plan_of("none", runs_per_class=5))["target"].values.reshape(45, -1)
    assert len(np.unique(command, axis=0)) == 45


def test_without_imperfections_the_twin_itself_moves(plan_of, twin, armpi):
    runs = simulate(plan_of("none", 5, hypotheses=parse("healthy", armpi)))
    position = twin.respond(runs["command"].values, runs["time"].values)
    np.testing.assert_array_equal(runs["position"].values, position)
    np.testing.assert_array_equal(runs["measured"].values, twin.path(position))


def test_published_stuck_runs_are_the_twin_frozen(plan_of, twin, armpi):
    runs = simulate(plan_of("none", 5, hypotheses=parse("motor_3:stuck", armpi)))
    position = twin.respond(runs["command"].values, runs["time"].values)
    position[:, 49:, 2] = position[:, 49, 2, None]
    np.testing.assert_array_equal(runs["position"].values, position)
    np.testing.assert_array_equal(runs["magnitude"].values, position[:, -1, 2])
    np.testing.assert_allclose(runs["onset"].values, 0.49)


def test_steady_state_error_is_that_of_the_truth(plan_of, armpi):
    runs = simulate(plan_of("none", 20, hypotheses=parse("motor_2:steady_state_error", armpi)))
    ends = np.append(np.arange(200, 1000, 200), 1000) - 1
    settled = runs["position"].values[:, ends] - runs["command"].values[:, ends]
    for run, text in enumerate(runs["fault_detail"].values):
        (fault,) = json.loads(text)["faults"]
        np.testing.assert_allclose(settled[run, :, 1], fault["offset_rad"], atol=1e-4)
        rms = np.sqrt(np.mean(np.square(fault["offset_rad"])))
        assert runs["magnitude"].values[run] == pytest.approx(rms)
    assert np.abs(settled[..., [0, 2, 3]]).max() < 1e-4


def test_two_faults_act_together(plan_of, armpi):
    text = "motor_1:stuck+motor_4:steady_state_error"
    runs = simulate(plan_of("none", 2, hypotheses=parse(text, armpi)))
    assert set(runs["fault"].values) == {text}
    assert np.ptp(runs["position"].values[:, 49:, 0], axis=1).max() == 0.0
    off = runs["position"].values[:, 999, 3] - runs["command"].values[:, 999, 3]
    assert (np.abs(off) > np.deg2rad(2.3)).all()


def test_progress_adds_up_to_all_runs(monkeypatch, plan_of):
    monkeypatch.setattr(generation, "CHUNK_RUNS", 7)
    done = []
    simulate(plan_of("none"), 1, done.append)
    assert done == [7, 7, 4]


@BOTH
def test_runs_can_be_drawn_without_storing(plan_of, imperfections):
    plan = plan_of(imperfections)
    whole = simulate_runs(plan, range(plan.size))
    tables = list(iterate(plan, 5))
    assert [len(table.run) for table in tables] == [5, 5, 5, 3]
    for name in VALUES:
        drawn = np.concatenate([getattr(table, name) for table in tables])
        np.testing.assert_array_equal(drawn, getattr(whole, name))


def test_runs_can_be_drawn_in_any_order(plan_of):
    plan = plan_of()
    order = np.random.default_rng(1).permutation(plan.size)
    whole = simulate_runs(plan, range(plan.size))
    tables = list(iterate(plan, 4, order))
    names = [name for table in tables for name in table.run]
    assert names == [whole.run[run] for run in order]
    measured = np.concatenate([table.measured for table in tables])
    np.testing.assert_array_equal(measured, whole.measured[order])


def test_runs_are_drawn_when_they_are_asked_for(monkeypatch, plan_of):
    made = []
    monkeypatch.setattr(generation, "simulate_runs", lambda plan, runs: made.append(runs))
    drawing = iterate(plan_of(runs_per_class=10**6), 10)
    next(drawing)
    next(drawing)
    assert made == [range(10), range(10, 20)]


def test_no_runs_at_a_time_are_refused(plan_of):
    with pytest.raises(InputError, match="runs at a time is 0, expected 1 or more"):
        next(iterate(plan_of(), 0))


@pytest.mark.parametrize(
    "change",
    [
        lambda plan: {"seed": 1},
        lambda plan: {"runs_per_class": 3},
        lambda plan: {"hypotheses": plan.hypotheses[:-1]},
        lambda plan: {"imperfections": load_calibration("none", plan.robot).imperfections},
        lambda plan: {"movements": replace(plan.movements, period_s=1.9)},
        lambda plan: {
            "modes": {**plan.modes, "stuck": replace(plan.modes["stuck"], onset_s=(1.0, 2.0))}
        },
        lambda plan: {"robot": load_robot("so101"), "hypotheses": [Hypothesis()]},
    ],
    ids=["seed", "runs", "hypotheses", "imperfections", "movements", "modes", "robot"],
)
def test_another_plan_has_another_hash(plan_of, change):
    plan = plan_of()
    other = replace(plan, **change(plan))
    assert other.manifest()["plan_sha256"] != plan.manifest()["plan_sha256"]
    again = pickle.loads(pickle.dumps(plan))
    assert again.manifest() == plan.manifest() == json.loads(json.dumps(plan.manifest()))


def test_another_urdf_has_another_hash(plan_of, tmp_path, armpi):
    plan = plan_of()
    for name in ("armpi_fpv.urdf", "armpi_fpv.toml"):
        (tmp_path / name).write_bytes((armpi.folder / name).read_bytes())
    moved = replace(plan, robot=load_robot(tmp_path / "armpi_fpv.toml"))
    assert moved.manifest() == plan.manifest()
    with (tmp_path / "armpi_fpv.urdf").open("a") as urdf:
        urdf.write("<!-- another mass -->")
    assert moved.manifest()["plan_sha256"] != plan.manifest()["plan_sha256"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hypotheses": [Hypothesis(), Hypothesis()]}, "a hypothesis is given twice"),
        ({"runs_per_class": 0}, "runs per class is 0, expected 1 or more"),
        ({"hypotheses": [UNKNOWN]}, "'unknown' cannot be simulated"),
    ],
)
def test_plan_that_cannot_be_made_is_refused(plan_of, changes, message):
    with pytest.raises(InputError, match=message):
        replace(plan_of(), **changes)


def test_mode_that_cannot_be_simulated_names_those_that_can(plan_of, armpi):
    modes = {name: MODES[name] for name in ("stuck", "steady_state_error")}
    with pytest.raises(
        InputError, match=r"unknown fault mode 'backlash'.* stuck, steady_state_error"
    ):
        replace(plan_of(), hypotheses=parse("motor_1:backlash", armpi), modes=modes)


@pytest.mark.parametrize(("imperfections", "motor"), [("none", 2), ("armpi_fpv", 1)])
def test_torque_loss_is_refused_where_nothing_gives_way(plan_of, armpi, imperfections, motor):
    """Motor 1 turns about the vertical, so no weight pulls at it."""
    fault = f"motor_{motor}:torque_loss"
    with pytest.raises(InputError, match=f"'{fault}' would not show.*--calibration"):
        plan_of(imperfections, hypotheses=parse(fault, armpi))


def test_all_modes_can_be_simulated_with_all_imperfections(plan_of, armpi):
    faults = ",".join(f"motor_3:{mode}" for mode in MODES)
    runs = simulate(plan_of("armpi_fpv", 1, hypotheses=parse(faults, armpi)))
    assert runs["fault"].values.tolist() == faults.split(",")
    assert np.isfinite(runs["magnitude"].values).all()
    modes = json.loads(runs.attrs["configuration"])["modes"]
    assert list(modes) == list(MODES)
    assert modes["lag"]["magnitude"] == [0.1, 0.3]


def test_no_workers_are_refused(plan_of):
    with pytest.raises(InputError, match="workers is 0, expected 1 to"):
        simulate(plan_of(), workers=0)


def test_a_plan_takes_text():
    plan = Plan("ur5e", ["healthy", "motor_2:stuck"], 3)
    assert plan.robot.name == "ur5e"
    assert plan.hypotheses == (Hypothesis.parse("healthy"), Hypothesis.parse("motor_2:stuck"))
    known = load_calibration("armpi_fpv", load_robot("armpi_fpv"))
    assert Plan(imperfections="armpi_fpv").imperfections == known.imperfections
    assert len(Plan().hypotheses) == 9
