"""Columns of the shared unknowns against differences, and what is believed of them before a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from failuretwin import SetupPrior
from failuretwin.digital_model.nonidealities import Imperfections, Variation
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.engine.registration import displaced_components
from failuretwin.inference.engine.theta import (
    AS_TOLD,
    KNOWN,
    Layout,
    Motion,
    columns,
    loads,
    offset_deviation,
    offsets_doubted,
    offsets_of,
    robot_components,
    typical_load,
)
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import (
    registered,
    registered_evidence,
    registered_samples,
)

RIGID = Settling(
    bias=(0.01, -0.02, 0.03, -0.01),
    compliance=(0.0,) * 4,
    friction=(0.005, 0.006, 0.007, 0.008),
    scatter=(0.004, 0.005, 0.006, 0.007),
    payload=0.05,
)
YIELDING = replace(RIGID, compliance=(0.0, 0.1, 0.15, 0.2))
REACH = 0.310509
"""Of the ArmPi FPV, by its links [m]."""


def model_of(twin, settling, variation=None):
    known = Imperfections("made up", "test", settling=settling, variation=variation)
    return HealthyModel(twin, known)


def places(twin, count=6):
    """Return poses that motors go for and the directions of their travel."""
    rng = np.random.default_rng(2)
    base = rng.uniform(-0.8, 0.8, (count, 4))
    return base, rng.choice([-1.0, 1.0], (count, 4))


def seen_at(model, base, direction, theta):
    """Return the tool in the sensor's frame: what theta is, by scipy and the twin."""
    moved = replace(model.imperfections, settling=offsets_of(theta, model.settling))
    pose = HealthyModel(model.twin, moved).settle(base, direction, np.zeros(4, dtype=bool))
    turned = Rotation.from_rotvec(theta[3:6]).apply(model.twin.path(pose))
    return (1.0 + theta[6]) * turned + theta[:3]


def differences(model, base, direction, step=1e-5):
    """Return the derivative of the tool's place by theta, (pose, 3, theta)."""
    found = []
    for row in step * np.eye(19):
        ahead, behind = (seen_at(model, base, direction, sign * row) for sign in (1.0, -1.0))
        found.append((ahead - behind) / (2.0 * step))
    return np.stack(found, axis=-1)


def found_columns(model, base, direction):
    pose = model.settle(base, direction, np.zeros(4, dtype=bool))
    still = np.zeros_like(pose)
    shown, motion = model.sensors.expected(pose), Motion(direction, still, still)
    return columns(model, pose, shown, motion, Layout(4, geometry=False))


def test_columns_are_the_derivative_of_where_the_tool_is_seen(twin):
    model, (base, direction) = model_of(twin, RIGID), places(twin)
    expected = differences(model, base, direction)
    found = found_columns(model, base, direction)
    assert found.shape == (6, 3, 19)
    np.testing.assert_allclose(found, expected, atol=2e-7)
    # Each of the four kinds of column moves the tool by a fair amount, but for motor 1's sag.
    assert (np.abs(expected).max(axis=(0, 1))[[0, 3, 6, 7, 12, 15]] > 0.02).all()


def test_of_a_yielding_arm_they_are_so_nearly(twin):
    """How the load changes as the arm gives way is left out: a few hundredths."""
    model, (base, direction) = model_of(twin, YIELDING), places(twin)
    expected = differences(model, base, direction)
    top = np.abs(expected).max(axis=(0, 1))
    off = np.abs(found_columns(model, base, direction) - expected).max(axis=(0, 1))
    assert (off < 0.05 * top + 1e-6).all()


def test_a_motor_gives_way_by_its_load_in_the_logs_sense(twin):
    """Motor 3 of this arm turns the other way in logs; a payload adds to the load."""
    pose = np.array([[0.2, 0.3, -0.4, 0.1]])
    by_hand = np.array([1.0, 1.0, -1.0, 1.0]) * twin.robot.loads.torque(
        pose * [1.0, 1.0, -1.0, 1.0], 0.05
    )
    np.testing.assert_allclose(loads(model_of(twin, RIGID), pose), by_hand, atol=1e-12)
    bare = model_of(twin, replace(RIGID, payload=0.0))
    assert np.abs(loads(bare, pose) - by_hand).max() > 0.05


def test_layout_of_theta():
    plain, whole = Layout(4, geometry=False), Layout(4, geometry=True, moving=True)
    assert (plain.size, whole.size) == (19, 48)
    assert [plain.own(motor) for motor in (0, 3)] == [[7, 11, 15], [10, 14, 18]]
    assert (whole.offsets, whole.frames, whole.lags) == (slice(7, 19), slice(19, 43), slice(43, 47))
    assert whole.bend == slice(47, 48)
    place = whole.place(np.ones(48))
    np.testing.assert_array_equal(place[:19], 1.0)
    np.testing.assert_array_equal(place[whole.lags], 1.0)
    assert place.sum() == 23.0  # frames and the bend stay linear


def test_offsets_are_added_to_those_that_are_known():
    theta = np.arange(19.0)
    found = offsets_of(theta, RIGID)
    np.testing.assert_allclose(found.bias, [7.01, 7.98, 9.03, 9.99])
    np.testing.assert_allclose(found.compliance, [11.0, 12.0, 13.0, 14.0])
    np.testing.assert_allclose(found.friction, [15.005, 16.006, 17.007, 18.008])
    assert (found.scatter, found.payload) == (RIGID.scatter, 0.05)


# Registering what was seen.


@pytest.fixture(scope="module")
def frames():
    """Two frames of a sensor that are far off, and points of the arm."""
    rng = np.random.default_rng(5)
    theta = np.concatenate([rng.normal(0.0, 0.3, (2, 6)), [[0.2], [-0.1]]], axis=1)
    theta = np.concatenate([theta, rng.normal(size=(2, 12))], axis=1)
    return theta, rng.uniform(-0.3, 0.3, (2, 3, 5, 3))


def as_seen(theta, point):
    seen = [
        (1.0 + row[6]) * Rotation.from_rotvec(row[3:6]).apply(some.reshape(-1, 3)) + row[:3]
        for row, some in zip(theta, point, strict=True)
    ]
    return np.array(seen).reshape(point.shape)


def test_registered_points_are_those_of_the_arm(frames):
    theta, point = frames
    seen = as_seen(theta, point)
    np.testing.assert_allclose(registered(seen, theta), point, atol=1e-12)
    np.testing.assert_allclose(registered(seen[:, 0], theta[:, :7]), point[:, 0], atol=1e-12)


def test_registering_evidence_moves_its_points_alone(frames):
    theta, point = frames
    seen = as_seen(theta, point)
    evidence = SettledEvidence.empty(run=2, movement=5, motor=4, axis=3)
    evidence = replace(evidence, point=seen[:, 0], usable=~evidence.usable)
    there = registered_evidence(evidence, theta)
    np.testing.assert_allclose(there.point, point[:, 0], atol=1e-12)
    assert there.usable.all()
    way = TransientSamples.empty(run=2, movement=3, reading=5, axis=3)
    way = replace(way, point=seen, since=way.since + 2.0)
    there = registered_samples(way, theta)
    np.testing.assert_allclose(there.point, point, atol=1e-12)
    assert (there.since == 2.0).all()


# What is believed before a run is seen.


def test_doubt_is_the_sum_of_the_rates():
    assert SetupPrior().doubt == pytest.approx(0.16 + 0.16 + 0.07 + 0.08 + 0.08)
    assert SetupPrior.known().doubt == 0.0
    assert SetupPrior(0.01, origin_rate=0.1, turn_rate=0.0, scale_rate=0.05).doubt == pytest.approx(
        0.31
    )


PLAIN = Layout(4, geometry=False)


def believed(model, prior):
    """Return what is believed of a robot whose sensor may be displaced, and how wide it is."""
    usual = robot_components(model, PLAIN, AS_TOLD)
    found = displaced_components(model, prior, PLAIN, usual)
    variance = np.diagonal(found.covariance, axis1=1, axis2=2)
    return found, np.sqrt(variance)[found.normal]


@pytest.mark.parametrize("prior", [SetupPrior(), SetupPrior.known(), SetupPrior(turn_rate=0.3)])
@pytest.mark.parametrize("doubt", [Variation(bias=(0.02,) * 4), None])
def test_probabilities_of_all_components_sum_to_one(twin, prior, doubt):
    found, _ = believed(model_of(twin, YIELDING, doubt), prior)
    assert np.exp(found.log_weight).sum() == pytest.approx(1.0, abs=1e-12)
    as_told = np.exp(found.log_weight[: 1 if doubt is None else 2])
    well = 1.0 - prior.doubt
    assert as_told.tolist() == pytest.approx([well] if doubt is None else [0.9 * well, 0.1 * well])
    assert found.mean.shape[-1] == 19


def test_components_are_as_wide_as_the_prior_says(twin):
    model = model_of(twin, RIGID)
    found, table = believed(model, SetupPrior())
    weights = np.exp(found.log_weight)
    np.testing.assert_allclose(weights, [0.45, 0.04, 0.04, 0.08, 0.08, 0.08, 0.08, 0.08, 0.07])
    assert found.displaced.tolist() == [False] * 3 + [True] * 6
    origin = np.array([0.0, 0.0, 0.0, 0.01625, 0.0065, 0.026, 0.0, 0.0, 0.0]) * REACH
    turn = np.array([0.0, 0.0, 0.0, 0.02185, 0.0, 0.0, 0.0087, 0.035, 0.0])
    scale = np.array([0.0, 0.0, 0.0, 0.015, 0.0, 0.0, 0.0, 0.0, 0.015])
    for place, expected in ((slice(3), origin), (slice(3, 6), turn), (slice(6, 7), scale)):
        narrow = table[:, place].max(axis=1)
        np.testing.assert_allclose(narrow, expected, rtol=1e-5, atol=2.0 * KNOWN)
        assert (table[:, place] == narrow[:, None]).all()
        assert (table[:, place] > 0.0).all()
    noise = np.hypot(model.path_noise, np.array([0.0, 0.004, 0.01] + [0.0] * 6) * REACH)
    np.testing.assert_allclose(found.noise_m, noise, rtol=1e-5)


def test_offsets_are_as_wide_as_the_doubt_of_the_robot(twin):
    """Compliance is doubted as a share of itself; an odd robot differs three times as far."""
    doubt = Variation(bias=(0.02,) * 4, compliance=(0.5,) * 4, friction=(0.01, 0.02, 0.03, 0.04))
    model = model_of(twin, YIELDING, doubt)
    wide = [0.02] * 4 + [0.0, 0.05, 0.075, 0.1] + [0.01, 0.02, 0.03, 0.04]
    np.testing.assert_allclose(offset_deviation(model), wide)
    _, (usual, odd, *others) = believed(model, SetupPrior())
    own = usual[7:]
    np.testing.assert_allclose(np.delete(own, 4), np.delete(wide, 4))
    assert 0.0 < own[4] < 0.002  # of a motor without a load nothing shows it
    np.testing.assert_allclose(np.delete(odd[7:], 4), np.delete(3.0 * own, 4))
    np.testing.assert_array_equal(odd[:7], usual[:7])
    for part in others:
        np.testing.assert_array_equal(part[7:], own)
    assert offset_deviation(model_of(twin, YIELDING)).tolist() == [0.0] * 12


@pytest.mark.parametrize(
    ("doubt", "matters"),
    [
        (Variation(bias=(0.0019, 0.0024, 0.0029, 0.0034)), False),
        (Variation(bias=(0.0, 0.0, 0.0, 0.0036)), True),
        (Variation(friction=(0.0019, 0.0024, 0.0029, 0.0034)), False),
        (Variation(friction=(0.0021, 0.0, 0.0, 0.0)), True),
        (Variation(compliance=(1.0, 0.1, 0.1, 0.1)), False),
        (Variation(compliance=(0.0, 0.18, 0.0, 0.0)), True),
        (Variation(scatter=(1.0,) * 4), False),
        (None, False),
    ],
)
def test_offsets_are_in_doubt_from_half_the_scatter_on(twin, doubt, matters):
    """Of motor 2: 0.1 rad/(N m) under 0.166 N m, so 18 % of that is 0.0030 rad of 0.005."""
    model = model_of(twin, replace(YIELDING, payload=0.0), doubt)
    assert offsets_doubted(model) == matters


def test_typical_load_is_the_rms_over_the_range(twin):
    rng = np.random.default_rng(9)
    low, high = np.array([motor.movement_range for motor in twin.robot.motors]).T
    torque = twin.robot.loads.torque(rng.uniform(low, high, (40_000, 4)) * [1, 1, -1, 1], 0.05)
    rms = np.sqrt(np.mean(torque**2, axis=0))
    np.testing.assert_allclose(typical_load(model_of(twin, RIGID)), rms, rtol=0.05, atol=1e-9)
