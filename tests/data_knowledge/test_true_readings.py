"""Which samples are readings, of paths drawn out by straight lines and of others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.log_quality import log_quality
from failuretwin.inference.observation.readings import measured_samples

STARTS = np.array([0.03, 2.05, 4.06, 6.07])
TARGETS = np.array([[0.5, -0.3], [-0.4, 0.2], [0.1, 0.6], [0.7, -0.5]])
COMMAND = Movements(np.zeros((1, 2)), TARGETS[None], np.full((1, 4, 2), 0.8), STARTS[None])
END_S = 8.0
STEP_S = 0.01


def turning(angle):
    """The tool of two joints that turn [m]."""
    reach = 0.2 + 0.1 * np.cos(angle[:, 1])
    x, y = np.cos(angle[:, 0]) * reach, np.sin(angle[:, 0]) * reach
    return np.stack([x, y, 0.1 * np.sin(angle[:, 1])], axis=-1)


def sliding(angle):
    """The tool of a slide [m]: it moves on a straight line, and never stops bending in time."""
    return angle[:, :1] * np.array([0.1, 0.2, -0.1])


def followed(time, lag_s=0.03):
    """The angles of servos that follow the reference with a lag, (time, motor) [rad]."""
    fine = np.arange(0.0, END_S + 1.0, 0.001)
    wanted, angle = COMMAND.reference(fine)[0], np.zeros((len(fine), 2))
    for i in range(1, len(fine)):
        angle[i] = angle[i - 1] + (wanted[i] - angle[i - 1]) * 0.001 / lag_s
    angle[np.abs(wanted - angle) < 1e-5] = wanted[np.abs(wanted - angle) < 1e-5]
    return np.stack([np.interp(time, fine, a) for a in angle.T], axis=-1)


def grid(step_s=STEP_S):
    return np.arange(round(END_S / step_s)) * step_s


def run_set(measured, rate_hz, time=None):
    time = grid() if time is None else time
    return RunTable(
        run=["run"],
        motor=("motor_1", "motor_2"),
        time=time,
        command=COMMAND.reference(time),
        measured=measured[None],
        measured_rate_hz=rate_hz,
    ).to_dataset()


def drawn(time, read, point, *, held=False):
    """Return straight lines between readings; beyond them nothing, or the same value on and on."""
    ends = {} if held else {"left": np.nan, "right": np.nan}
    return np.stack([np.interp(time, time[read], p, **ends) for p in point.T], axis=-1)


def readings(noise_m=0.0, first=3, every=10, gap=(0.0, 0.0), last=END_S):
    """Return which times of the grid are read, and where the tool is seen there [m]."""
    at = np.arange(first, len(grid()), every)
    at = at[((grid()[at] < gap[0]) | (grid()[at] > gap[1])) & (grid()[at] < last)]
    noise = np.random.default_rng(1).normal(0.0, noise_m, (len(at), 3))
    return at, turning(followed(grid()[at])) + noise


GAPS = [(0.0, 0.0), (2.4, 4.9), (3.3, 5.0), (4.5, 6.3)]


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("noise_m", [0.0, 0.001])
def test_readings_are_where_lines_meet(noise_m, gap, held):
    """The very readings come back, and no others; also where values are held at both ends."""
    at, point = readings(noise_m, gap=gap)
    found = measured_samples(run_set(drawn(grid(), at, point, held=held), 10.0))
    np.testing.assert_array_equal(np.flatnonzero(found.seen[0]), at)
    np.testing.assert_allclose(found.point[0, at], point, rtol=0, atol=1e-15)
    assert np.isnan(found.point[0, ~found.seen[0]]).all()
    assert not found.filled.any()
    assert found.assumed.any() == (noise_m == 0.0)


@settings(max_examples=30)
@given(first=st.integers(0, 9), begin=st.floats(0.5, 6.0), lasts=st.floats(0.5, 2.5))
def test_lines_across_a_gap_are_no_evidence(first, begin, lasts):
    """Settled points, what cannot be used and what is remarked, as with the gap left open."""
    at, point = readings(0.001, first, gap=(begin, begin + lasts))
    lone = np.full((len(grid()), 3), np.nan)
    lone[at] = point
    runs = [run_set(path, 10.0) for path in (lone, drawn(grid(), at, point))]
    expected, found = map(settled_evidence, runs)
    for name in ("usable", "moving", "begin", "end", "first_reading_delay"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    np.testing.assert_allclose(found.point, expected.point, atol=1e-12)
    assert log_quality(runs[1]) == log_quality(runs[0])


def test_single_precision_is_straight_enough():
    at, point = readings(0.001, gap=(2.4, 4.9))
    path = drawn(grid(), at, point).astype(np.float32)
    runs = run_set(path, 10.0, grid().astype(np.float32).astype(float))
    found = measured_samples(runs)
    np.testing.assert_array_equal(np.flatnonzero(found.seen[0]), at)


def test_readings_between_two_times_of_the_grid_count_once():
    """Lines bend there at two samples; the nearer is the reading."""
    at = np.arange(0.034, END_S, 0.1)
    at = at[(at < 2.4) | (at > 4.9)]
    point = turning(followed(at)) + np.random.default_rng(1).normal(0.0, 0.001, (len(at), 3))
    path = np.stack([np.interp(grid(), at, p) for p in point.T], axis=-1)
    path[(grid() < at[0]) | (grid() > at[-1])] = np.nan
    found = measured_samples(run_set(path, 10.0))
    seen = grid()[found.seen[0]]
    assert len(seen) == pytest.approx(len(at), abs=2)
    assert np.abs(seen[:, None] - at).min(axis=1).max() < STEP_S


@pytest.mark.parametrize("tool", [turning, sliding])
@pytest.mark.parametrize("rate_hz", [5, 10, 20, 50, 100, 200])
def test_the_motion_itself_is_never_taken_for_lines(tool, rate_hz):
    """Exact paths without noise: on the sensor's own grid, on a finer one with nothing between, and
    where each time of a finer grid is read and only the rate is given too low."""
    time = grid(0.005)
    path, every = tool(followed(time)), 200 // rate_hz
    own = measured_samples(run_set(path[::every], rate_hz, time[::every]))
    assert own.seen.all()
    lone = np.full_like(path, np.nan)
    lone[::every] = path[::every]
    assert measured_samples(run_set(lone, rate_hz, time)).seen[0].sum() == len(time[::every])
    dense = measured_samples(run_set(path, rate_hz, time))
    assert dense.seen.all()
    assert dense.filled.all() == (every > 1)


def test_a_steady_slide_that_is_drawn_out_counts_as_a_line():
    """Nothing tells it from a gap; where it sets out and where it stops there are readings."""
    at = np.arange(0, len(grid()), 10)
    point = sliding(followed(grid()[at]))
    found = measured_samples(run_set(drawn(grid(), at, point), 10.0))
    lost = np.setdiff1d(at, np.flatnonzero(found.seen[0]))
    assert 0 < len(lost) < 0.4 * len(at)
    since = grid()[lost][:, None] - STARTS
    assert ((since > 0.0) & (since < 0.8)).any(axis=1).all()


@pytest.mark.parametrize(
    ("last", "rests"),
    [(6.5, False), (6.7, False), (7.3, True)],
)
def test_a_value_held_while_motors_travel_is_no_rest(last, rests):
    """From amid the last ramp on: the tool does not rest there, whatever the sensor says."""
    at, point = readings(last=last)
    found = settled_evidence(run_set(drawn(grid(), at, point, held=True), 10.0))
    assert found.usable.tolist() == [[True, True, True, rests]]


def test_a_value_held_by_a_sensor_that_flickers_is_no_rest():
    """It never said the same twice before, so that the end is not its own."""
    at, point = readings(noise_m=0.001, last=7.0)
    found = measured_samples(run_set(drawn(grid(), at, point, held=True), 10.0))
    assert grid()[found.seen[0]].max() < 7.0


def test_paths_filled_otherwise_pass_as_they_are():
    """Drawn out between the angles of the motors, as published: the tool's path bends."""
    at = np.arange(0, len(grid()), 10)
    angle = followed(grid()[at])
    filled = np.stack([np.interp(grid(), grid()[at], a) for a in angle.T], axis=-1)
    found = measured_samples(run_set(turning(filled), 10.0))
    assert found.filled.all()
    assert found.seen.all()
    assert np.isnan(settled_evidence(run_set(turning(filled), 10.0)).first_reading_delay).all()


def test_without_a_lower_rate_every_sample_is_a_reading():
    at, point = readings(0.001, gap=(2.4, 4.9))
    path = drawn(grid(), at, point)
    found = measured_samples(run_set(path, 100.0))
    np.testing.assert_array_equal(found.seen[0], np.isfinite(path).all(axis=1))


def test_runs_are_judged_alone():
    """One drawn out, one not, one without any reading."""
    import xarray as xr

    at, point = readings(0.001, gap=(2.4, 4.9))
    lone = np.full((len(grid()), 3), np.nan)
    lone[at] = point
    paths = [drawn(grid(), at, point), lone, np.full_like(lone, np.nan)]
    runs = [run_set(path, 10.0).assign_coords(run=[str(i)]) for i, path in enumerate(paths)]
    before = paths[0].copy()
    found = measured_samples(xr.concat(runs, "run", data_vars="minimal"))
    np.testing.assert_array_equal(found.seen[0], found.seen[1])
    assert not found.seen[2].any()
    np.testing.assert_array_equal(runs[0]["measured"].values[0], before)
