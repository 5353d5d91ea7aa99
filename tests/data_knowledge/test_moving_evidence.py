from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.inference.observation.evidence import Evidence

MOST_READINGS = 12

STARTS = np.array([0.03, 2.05, 4.06])
TARGETS = np.array([[0.5, -0.3], [-0.4, 0.2], [0.1, 0.6]])


def tool(time):
    """The tool follows its motors along an arc; it is known at any time [m]."""
    angle = reference().reference(np.asarray(time))[0]
    x = np.cos(angle[:, 0]) * (0.2 + 0.1 * np.cos(angle[:, 1]))
    y = np.sin(angle[:, 0]) * (0.2 + 0.1 * np.cos(angle[:, 1]))
    return np.stack([x, y, 0.1 * np.sin(angle[:, 1])], axis=-1)


def reference():
    return Movements(np.zeros((1, 2)), TARGETS[None], np.full((1, 3, 2), 0.8), STARTS[None])


def run_set(measured, rate_hz, step_s=0.01):
    time = np.arange(len(measured)) * step_s
    return RunTable(
        run=["run"],
        motor=("motor_1", "motor_2"),
        time=time,
        command=reference().reference(time),
        measured=measured[None],
        measured_rate_hz=rate_hz,
    ).to_dataset()


def sparse(first, every=10, count=600):
    """Readings at every so many grid times, nothing between."""
    measured = np.full((count, 3), np.nan)
    at = np.arange(first, count, every)
    measured[at] = tool(0.01 * at)
    return measured


def drawn_out(first, every=10, count=600):
    """The same with straight lines between the readings."""
    at = np.arange(first, count, every)
    points = tool(0.01 * at)
    grid = np.arange(count)
    return np.stack([np.interp(grid, at, values) for values in points.T], axis=-1)


def readings(runs):
    found = Evidence(runs)
    return found.settled, found.transient


@given(first=st.integers(0, 9))
def test_lines_between_readings_are_no_readings(first):
    """Drawn out or not, the same readings at the same times, whatever their phase on the grid."""
    _, lone = readings(run_set(sparse(first), 10.0))
    _, filled = readings(run_set(drawn_out(first), 10.0))
    assert lone.seen.sum() > 20
    np.testing.assert_array_equal(filled.seen, lone.seen)
    np.testing.assert_allclose(filled.since, lone.since, atol=1e-9)
    np.testing.assert_allclose(filled.point, lone.point, atol=1e-12)


def test_without_a_rate_every_sample_is_a_reading():
    runs = run_set(drawn_out(0), 10.0)
    del runs.attrs["measured_rate_hz"]
    _, found = readings(runs)
    assert (found.seen.sum(axis=-1) == MOST_READINGS).all()


@pytest.mark.parametrize("every", [1, 2, 5, 10, 20])
def test_readings_are_those_of_the_sensor_before_the_tool_rests(every):
    """True times and places; from the start of the movement to where settled readings begin."""
    settled, found = readings(run_set(sparse(3, every), 100.0 / every))
    seen = found.seen[0]
    at = (settled.movements.start[0][:, None] + found.since[0])[seen]
    np.testing.assert_allclose(found.point[0][seen], tool(at), atol=1e-9)
    assert (found.since[0][seen] >= -1e-9).all()
    last = np.repeat(settled.begin[0][:, None], MOST_READINGS, axis=1)[seen]
    assert (at < last).all()
    for movement in range(3):
        times = found.since[0, movement, seen[movement]]
        assert (np.diff(times) >= 0.9 * 0.01 * every).all()
        assert np.diff(times).max() < 0.01 * every + 0.15


def test_where_the_tool_never_rests_all_readings_are_on_the_way():
    measured = sparse(0)
    measured[430:600:10, 2] += np.linspace(0.0, 0.2, 17)
    settled, found = readings(run_set(measured, 10.0))
    assert settled.usable.tolist() == [[True, True, False]]
    at = 4.06 + found.since[0, 2, found.seen[0, 2]]
    assert at.max() > 5.85


def test_missing_readings_are_not_there():
    measured = sparse(0)
    measured[100:350] = np.nan
    measured[10, 1] = np.nan
    _, found = readings(run_set(measured, 10.0))
    assert found.seen[0, 1].sum() == 0
    np.testing.assert_array_equal(found.point[~found.seen], 0.0)
    np.testing.assert_allclose(found.since[0, 0, :2], [0.17, 0.27], atol=1e-9)


def test_parts_are_those_of_the_whole():
    import xarray as xr

    one, other = run_set(sparse(0), 10.0), run_set(sparse(4), 10.0)
    both = xr.concat([one, other.assign_coords(run=["other"])], "run", data_vars="minimal")
    _, whole = readings(both)
    _, alone = readings(other)
    part = whole[1:]
    for name in ("since", "point", "seen"):
        np.testing.assert_array_equal(getattr(part, name), getattr(alone, name))
