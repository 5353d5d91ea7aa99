from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.runs import (
    VARIABLES,
    RunTable,
    Truth,
    check_runs,
    concatenate,
    measured_rate,
    run_set,
    time_step,
    truth_of,
)

MOTORS = ("motor_1", "motor_2")


def table(names=("a", "b"), samples=11, step=0.1, **changes):
    runs = len(names)
    plain = RunTable(
        run=names,
        motor=MOTORS,
        time=np.arange(samples) * step,
        command=np.ones((runs, samples, 2)),
        measured=np.ones((runs, samples, 3)),
        measured_rate_hz=10.0,
    )
    return replace(plain, **changes)


def everything(names=("a", "b"), samples=11, movements=2):
    runs = len(names)
    return table(
        names,
        samples,
        duration=np.full(runs, 0.9),
        movements=Movements(
            initial=np.zeros((runs, 2)),
            target=np.ones((runs, movements, 2)),
            ramp_duration=np.full((runs, movements, 2), 0.5),
            start=np.tile(np.arange(movements) / 1.0, (runs, 1)),
        ),
        truth=Truth(
            fault=["motor_1:stuck"] * runs,
            detail=[{"motor": "motor_1"}] * runs,
            onset=np.full(runs, 0.3),
            magnitude=np.full(runs, 0.1),
        ),
        position=np.zeros((runs, samples, 2)),
        attributes={"robot": "armpi_fpv"},
    )


@pytest.fixture
def runs():
    return table().to_dataset()


def test_table_becomes_a_run_set_with_the_names_of_the_contract():
    runs = everything().to_dataset()

    sensed = {"tool_orientation", "accelerometer", "gyroscope", "wire"}
    others = {"temperature", "voltage", "goal"} | sensed
    assert {str(name) for name in runs.data_vars} == VARIABLES.keys() - others
    assert {name: runs[name].dims for name in runs.data_vars} == {
        name: VARIABLES[str(name)][0] for name in runs.data_vars
    }
    assert runs["motor"].values.tolist() == list(MOTORS)
    assert runs["axis"].values.tolist() == ["x", "y", "z"]
    assert runs["measured"].attrs["units"] == "m"
    assert runs.attrs == {"robot": "armpi_fpv", "measured_rate_hz": 10.0}
    assert [json.loads(text) for text in runs["fault_detail"].values] == [{"motor": "motor_1"}] * 2


def test_duration_is_the_whole_grid_unless_said(runs):
    np.testing.assert_allclose(runs["duration"], [1.0, 1.0])


def test_truth_is_none_where_the_run_set_does_not_say(runs):
    assert truth_of(runs) is None
    assert truth_of(everything().to_dataset()) == ["motor_1:stuck"] * 2


def test_sensor_rate_is_the_grids_own_without_the_attribute():
    runs = table(step=0.01).to_dataset()

    assert time_step(runs) == pytest.approx(0.01)
    assert measured_rate(runs) == 10.0
    del runs.attrs["measured_rate_hz"]
    assert measured_rate(runs) == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("missing", "left"), [("measured", "command, duration"), ("command", "duration, measured")]
)
def test_missing_variable_is_named(runs, missing, left):
    with pytest.raises(InputError) as error:
        check_runs(runs.drop_vars(missing), "log.nc")
    assert str(error.value) == (
        f"log.nc: no variable `{missing}`; it holds {left}. A run set needs "
        "`command` (run, time, motor) [rad] and `measured` (run, time, axis) [m]."
    )


def test_wrong_dimensions_are_named(runs):
    with pytest.raises(InputError) as error:
        check_runs(runs.transpose("time", "run", ...), "log.nc")
    assert str(error.value) == (
        "log.nc: `command` has dimensions ('time', 'run', 'motor'), "
        "expected ('run', 'time', 'motor')."
    )


@pytest.mark.parametrize("name", ["time", "motor", "run"])
def test_missing_coordinate_is_named(runs, name):
    with pytest.raises(InputError, match=name):
        check_runs(runs.drop_vars(name), "log.nc")


def test_wrong_axes_are_named(runs):
    with pytest.raises(InputError, match=r"`axis` is \['z' 'y' 'x'\], expected x, y, z\."):
        check_runs(runs.assign_coords(axis=["z", "y", "x"]), "log.nc")


def test_text_where_numbers_belong_is_refused(runs):
    with pytest.raises(InputError, match=r"`command` holds .*, expected numbers"):
        check_runs(runs.assign(command=runs["command"].astype(str)), "log.nc")


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ([0.0], "`time` has 1 samples, expected at least two"),
        ([0.0, 0.1, 0.1], "`time` does not increase"),
        ([0.0, 0.1, np.nan], "`time` does not increase"),
        ([0.0, 0.1, 0.3], r"not a uniform grid .* starts at 0 s with steps of 0\.1 to 0\.2 s"),
        ([1.0, 1.1, 1.2], r"not a uniform grid .* starts at 1 s"),
    ],
)
def test_time_must_be_a_uniform_grid_from_zero(time, message):
    with pytest.raises(InputError, match=message):
        table(samples=len(time), time=np.array(time)).to_dataset()


def test_uniform_time_is_accepted_to_within_rounding():
    time = np.linspace(0, 10, 1000)
    assert table(samples=1000, time=time).to_dataset().sizes["time"] == 1000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "a")}, "run names are not unique"),
        ({"names": ()}, "holds no runs"),
    ],
)
def test_runs_must_exist_and_have_names_of_their_own(changes, message):
    with pytest.raises(InputError, match=message):
        table(**changes).to_dataset()


@pytest.mark.parametrize(
    "changes",
    [
        {"command": np.zeros((2, 10, 2))},
        {"measured": np.zeros((2, 11, 2))},
        {"motor": ("motor_1",)},
        {"duration": np.zeros(3)},
    ],
)
def test_shapes_that_do_not_fit_are_refused(changes):
    with pytest.raises(InputError):
        table(**changes).to_dataset()


def test_shorter_runs_are_padded_when_joined():
    short = everything(("a",), samples=11, movements=1).to_dataset()
    long = everything(("b",), samples=21, movements=3).to_dataset()
    short["command"][0, -1] = 0.25

    whole = check_runs(concatenate([short, long]), "whole")

    np.testing.assert_allclose(whole["time"], np.arange(21) * 0.1)
    assert (whole["command"].values[0, 10:] == 0.25).all()
    assert np.isnan(whole["measured"].values[0, 11:]).all()
    assert np.isnan(whole["position"].values[0, 11:]).all()
    assert np.isnan(whole["target"].values[0, 1:]).all()
    assert np.isnan(whole["movement_start"].values[0, 1:]).all()
    np.testing.assert_allclose(whole["duration"], [0.9, 0.9])
    assert truth_of(whole) == ["motor_1:stuck"] * 2
    for name in long.data_vars:
        np.testing.assert_array_equal(whole[name].values[1], long[name].values[0])


def test_parts_stay_as_they_were_when_joined():
    short, long = table(("a",)).to_dataset(), table(("b",), samples=21).to_dataset()
    before = short.copy(deep=True)
    concatenate([short, long])
    assert short.identical(before)


def test_a_single_part_is_the_whole(runs):
    assert concatenate([runs]).identical(runs)


def test_only_what_every_part_knows_is_kept():
    known = everything(("a",)).to_dataset()
    whole = concatenate([known, table(("b",)).to_dataset()])
    assert {str(name) for name in whole.data_vars} == {"command", "measured", "duration"}


@pytest.mark.parametrize(
    ("names", "unique"),
    [
        ([("a", "b"), ("a", "c"), ("a",)], ["a", "b", "a#2", "c", "a#3"]),
        ([("a", "a#2"), ("a",)], None),
    ],
)
def test_names_that_repeat_get_a_number(names, unique):
    parts = [table(part).to_dataset() for part in names]
    got = concatenate(parts)["run"].values.tolist()
    assert len(set(got)) == len(got)
    assert unique is None or got == unique


def test_the_lowest_of_several_sensor_rates_is_kept(runs):
    other = table(("c",), measured_rate_hz=5.0).to_dataset()

    assert concatenate([runs, other]).attrs["measured_rate_hz"] == 5.0
    assert concatenate([other, runs]).attrs["measured_rate_hz"] == 5.0


def test_parts_of_other_motors_cannot_be_joined(runs):
    other = table(("c",), motor=("motor_1", "wrist")).to_dataset()
    told = "motors ['motor_1', 'motor_2'] and ['motor_1', 'wrist'] cannot form one run set."
    with pytest.raises(InputError, match=re.escape(told)):
        concatenate([runs, other])


def test_gaps_that_are_filled_by_lines_stay_gaps_on_a_finer_grid():
    time = np.arange(41) * 0.1
    path = np.stack([np.interp(time, time[::5], one) for one in np.eye(9)[:3]], axis=-1)
    filled = table(("c",), samples=41, measured=path[None], measured_rate_hz=2.0).to_dataset()
    joined = concatenate([filled, table(("d",), samples=81, step=0.04).to_dataset()])
    grid = joined["time"].values
    inside = grid <= time[-1]
    for axis in range(3):
        expected = np.interp(grid[inside], time, path[:, axis])
        assert joined["measured"].values[0, inside, axis] == pytest.approx(expected)


@pytest.mark.parametrize("step", [0.2, 0.13])
def test_parts_are_put_on_the_finest_grid(runs, step):
    rng = np.random.default_rng(0)
    told, read = rng.normal(size=(1, 11, 2)), rng.normal(size=(1, 11, 3))
    other = table(("c",), step=step, command=told, measured=read).to_dataset()
    joined = concatenate([other, runs])
    time, given = joined["time"].values, other["time"].values
    assert np.diff(time) == pytest.approx(0.1)
    own = joined.isel(run=0)
    for motor in range(2):
        expected = np.interp(time, given, told[0, :, motor])
        assert own["command"].values[:, motor] == pytest.approx(expected)
    there = np.flatnonzero(np.isfinite(own["measured"].values).all(axis=1))
    assert own["measured"].values[there] == pytest.approx(read[0])
    assert np.abs(time[there] - given).max() <= 0.05 + 1e-9
    assert joined.attrs["measured_rate_hz"] == other.attrs["measured_rate_hz"]


def test_plain_arrays_become_a_run_set_in_one_call():
    time = np.arange(4) * 0.1
    runs = run_set(time, np.arange(8.0).reshape(4, 2), np.zeros((4, 3)))
    assert runs["run"].values.tolist() == ["run_1"]
    assert runs["motor"].values.tolist() == ["motor_1", "motor_2"]
    assert runs["command"].values[0, 2].tolist() == [4.0, 5.0]
    assert runs.attrs["measured_rate_hz"] == pytest.approx(10.0)
    assert runs["duration"].values.tolist() == [pytest.approx(0.3)]


def test_plain_arrays_keep_their_names_and_rate():
    shape = (2, 4)
    runs = run_set(
        np.arange(4) * 0.1,
        np.zeros((*shape, 1)),
        np.zeros((*shape, 3)),
        motors=["shoulder"],
        names=["a", "b"],
        measured_rate_hz=5.0,
    )
    assert runs["motor"].values.tolist() == ["shoulder"]
    assert runs["run"].values.tolist() == ["a", "b"]
    assert runs.attrs["measured_rate_hz"] == 5.0


def test_plain_arrays_of_other_shapes_are_refused():
    with pytest.raises(InputError, match=r"\(4, 2\) \(command\).*Expected \(time,\)"):
        run_set(np.arange(4) * 0.1, np.zeros((4, 2)), np.zeros((1, 4, 3)))
