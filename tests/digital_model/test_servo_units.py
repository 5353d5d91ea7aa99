from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.digital_model.servo import ServoUnits

UNITS = ServoUnits(zero_deg=120.0, deg_per_count=0.24, low=0.0, high=1000.0)
RISING = ServoUnits(zero_deg=-150.0, deg_per_count=-0.29, low=0.0, high=1023.0)


@pytest.mark.parametrize(
    ("counts", "degrees"), [(0, 120), (500, 0), (1000, -120), (-32503, 120), (32447, -120)]
)
def test_counts_are_clamped_and_turned_into_angles(counts, degrees):
    assert UNITS.to_rad(counts) == pytest.approx(np.deg2rad(degrees), abs=1e-15)


@pytest.mark.parametrize("units", [UNITS, RISING])
@given(counts=st.floats(0.0, 1000.0))
def test_counts_come_back_from_angles(units, counts):
    assert units.to_counts(units.to_rad(counts)) == pytest.approx(counts, abs=1e-9)


@pytest.mark.parametrize("units", [UNITS, RISING])
def test_one_count_is_the_size_of_a_step_whatever_its_sign(units):
    assert units.rad_per_count == pytest.approx(abs(np.diff(units.to_rad([400, 401]))[0]))


def test_angles_beyond_the_scale_have_counts_too():
    np.testing.assert_allclose(UNITS.to_counts(np.deg2rad([144.0, -144.0])), [-100.0, 1100.0])


def test_shapes_are_kept():
    counts = np.full((2, 3, 4), 500)
    assert UNITS.to_rad(counts).shape == counts.shape
    assert UNITS.to_counts(counts).shape == counts.shape


def test_only_readings_within_the_scale_are_valid():
    readings = [-1.0, 0.0, 500.5, 1000.0, 1000.5, np.nan]
    np.testing.assert_array_equal(UNITS.valid(readings), [False, True, True, True, False, False])
