from __future__ import annotations

import numpy as np
import pytest

from failuretwin.inference.observation.evidence import settled_evidence

TARGETS = [[0.5, -0.3], [-0.4, 0.2], [0.1, 0.6]]
POINTS = np.array([[0.1, 0.0, 0.2], [0.0, 0.1, 0.3], [-0.1, 0.05, 0.25]])
"""Where the tool rests after each movement [m]."""


def travelling(time):
    """The tool is under way for 0.8 s of every 2 s, then rests at `POINTS`."""
    knots = np.concatenate([[s, s + 0.8] for s in (0.0, 2.0, 4.0)])
    values = np.repeat(np.vstack([[[0.0, 0.0, 0.31]], POINTS]), 2, axis=0)[1:-1]
    return np.stack([np.interp(time, knots, v) for v in values.T], axis=-1)


@pytest.fixture
def runs(run_of):
    return run_of(TARGETS, travelling)


def with_measured(runs, change):
    runs = runs.copy(deep=True)
    change(runs["time"].values, runs["measured"].values[0])
    return runs


def test_points_are_where_the_tool_rests(runs):
    found = settled_evidence(runs)
    np.testing.assert_allclose(found.point[0], POINTS, rtol=0, atol=1e-12)
    assert found.usable.tolist() == [[True] * 3]
    np.testing.assert_allclose(found.movements.start, [[0.0, 2.0, 4.0]], atol=1e-9)
    np.testing.assert_allclose(found.end, [[2.0, 4.0, 6.0]], atol=0.011)


def test_a_few_wild_readings_move_no_point(runs):
    def spoil(time, measured):
        measured[(time > 1.55) & (time < 1.75)] += 0.2

    found = settled_evidence(with_measured(runs, spoil))
    np.testing.assert_allclose(found.point[0], POINTS, rtol=0, atol=1e-12)


def test_points_are_medians_of_the_end_of_the_plateau(runs):
    """Nothing before the last 0.6 s counts, and there the middle of the readings does."""

    def creep(time, measured):
        measured[(time > 0.8) & (time < 1.39)] += 0.05
        measured[(time > 1.395) & (time < 1.995), 2] += np.linspace(-1e-3, 1e-3, 60)

    found = settled_evidence(with_measured(runs, creep))
    np.testing.assert_allclose(found.point[0], POINTS, rtol=0, atol=1e-4)


def test_a_single_reading_at_rest_is_enough(run_of):
    def keep_one(time, measured):
        measured[np.arange(len(time)) % 200 != 180] = np.nan

    found = settled_evidence(with_measured(run_of(TARGETS, travelling, rate=10.0), keep_one))
    assert found.usable.all()
    np.testing.assert_allclose(found.point[0], POINTS, rtol=0, atol=1e-12)


def test_movement_without_a_reading_at_rest_is_not_used(runs):
    def gap(time, measured):
        measured[(time > 2.5) & (time < 4.0)] = np.nan

    found = settled_evidence(with_measured(runs, gap))
    assert found.usable.tolist() == [[True, False, True]]
    assert not found.moving.any()


@pytest.mark.parametrize("axis", range(3))
def test_a_reading_without_one_coordinate_is_none(runs, axis):
    def lose(time, measured):
        measured[time > 2.5, axis] = np.nan

    assert settled_evidence(with_measured(runs, lose)).usable.tolist() == [[True, False, False]]


def test_tool_that_does_not_rest_is_moving(runs):
    def drift(time, measured):
        measured[time > 4.0, 0] += 0.05 * (time[time > 4.0] - 4.0)

    found = settled_evidence(with_measured(runs, drift))
    assert found.moving.tolist() == [[False, False, True]]
    assert found.usable.tolist() == [[True, True, False]]


def test_late_start_does_not_spoil_the_point(run_of):
    """The arm sets out 0.5 s late and rests for the last 0.7 s of the plateau."""
    found = settled_evidence(run_of(TARGETS, lambda time: travelling(np.maximum(time - 0.5, 0))))
    assert found.usable.all()
    np.testing.assert_allclose(found.point[0], POINTS, rtol=0, atol=1e-12)


def test_readings_that_end_early_end_the_last_plateau(runs):
    def stop(time, measured):
        measured[time > 5.2] = np.nan

    found = settled_evidence(with_measured(runs, stop))
    assert found.usable.all()
    assert found.end[0, 2] == pytest.approx(5.21, abs=0.011)


def test_movements_after_the_last_reading_are_not_used(runs):
    def stop(time, measured):
        measured[time > 3.5] = np.nan

    found = settled_evidence(with_measured(runs, stop))
    assert found.usable.tolist() == [[True, True, False]]


def test_without_any_reading_nothing_is_used(runs):
    found = settled_evidence(with_measured(runs, lambda time, measured: measured.fill(np.nan)))
    assert not found.usable.any()
    assert not found.moving.any()


def test_movements_without_a_plateau_are_not_used(run_of):
    found = settled_evidence(run_of(TARGETS, travelling, ramp_s=1.95))
    assert found.usable.tolist()[0][:2] == [False, False]


def test_parts_are_those_of_the_whole(runs):
    import xarray as xr

    both = xr.concat([runs, runs.assign_coords(run=["other"])], "run", data_vars="minimal")
    both["measured"][1] += 0.01
    part = settled_evidence(both)[1:]
    np.testing.assert_allclose(part.point[0], POINTS + 0.01, rtol=0, atol=1e-12)
    assert part.usable.shape == part.movements.start.shape == (1, 3)
