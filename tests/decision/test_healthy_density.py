"""The healthy density of the fault filter, against integrals over every motor by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from failuretwin.core.movements import Movements
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import LostCommand, Timing
from failuretwin.inference.movements.healthy_density import healthy_log_density, wide_scatter
from failuretwin.inference.movements.joint_likelihood import movement_likelihoods
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

LOST = 0.05
TARGETS = np.array(
    [[0.4, 0.2, -0.3, 0.1], [-0.5, -0.2, 0.3, 0.4], [0.7, 0.3, 0.1, -0.4], [0.0, -0.4, 0.5, 0.2]]
)


@pytest.fixture(scope="module")
def model(armpi):
    """An arm whose motors are read themselves; motor 1 loses commands."""
    known = load_calibration(armpi.name, armpi)
    lost = (LostCommand(("motor_1",), LOST, LOST),)
    own = replace(known.imperfections, lost_commands=lost, timing=Timing(), variation=None)
    return HealthyModel(known.twin, own).seen_by(("encoders",))


def seen(model, off, usable=(True, True, True, True), lost=()):
    """Return movements whose motors settle so far off where healthy ones do, (movement, motor)."""
    count = len(off)
    at = 2.0 * np.arange(count)[None]
    ramps = np.full((1, count, 4), 0.8)
    told = Movements(np.zeros((1, 4)), TARGETS[None, :count], ramps, at)
    base, origin = TARGETS[:count].copy(), np.zeros(4)
    stood = np.concatenate([origin[None], base[:-1]])
    direction = np.sign(base - stood)
    for m in lost:
        base[m, 0], direction[m, 0] = base[m - 1, 0], direction[m - 1, 0]
    angle = model.settle(base, direction, model.none_held) + off
    return SettledEvidence(
        movements=told,
        point=model.sensors.value(angle)[None],
        usable=np.array(usable[:count])[None],
        moving=np.zeros((1, count), dtype=bool),
        begin=at + 1.0,
        end=at + 1.9,
        first_reading_delay=np.zeros((1, count)),
        arrived=np.full((1, count, 4), np.nan),
        too_seldom=np.zeros(1, dtype=bool),
    )


def by_itself(model, off):
    """Log density of readings if each motor scatters by itself: t and normal, convolved."""
    noise = model.path_noise / model.sensors._scale[0]
    found = 0.0
    for x, s in zip(off, model.scatter, strict=True):
        grid = np.linspace(-60.0 * s, 60.0 * s, 60_001)
        density = stats.t.pdf(grid / s, model.settling.tail_dof) / s
        found += np.log(np.trapezoid(density * stats.norm.pdf(x - grid, scale=noise), grid))
    return found - 4.0 * np.log(model.sensors._scale[0])


@pytest.mark.parametrize("wide", [0.0, 3.0, 6.0, 10.0])
def test_a_motor_that_scatters_far_alone_is_no_joint_event(model, wide):
    for motor in range(4):
        off = model.scatter * np.array([0.5, -0.7, 0.3, 0.9])
        off[motor] = wide * model.scatter[motor]
        evidence = seen(model, off[None])
        found = movement_likelihoods(evidence, model)
        expected = by_itself(model, off) + np.log((1.0 - LOST) * 0.99)
        got = healthy_log_density(evidence, found)[0, 0]
        assert got == pytest.approx(expected, abs=0.9)
        if wide == 10.0:
            together = np.logaddexp.reduce(found.terms[0, 0])
            assert together < expected - 2.0


def test_how_often_one_motor_scatters_far():
    share, variance = wide_scatter(6.0)
    drawn = 6.0 / np.random.default_rng(0).chisquare(6.0, 1_000_000)
    assert share[:-1].sum() == pytest.approx(0.01)
    for at in range(2):
        wider = (drawn > variance[at]).mean()
        expected = share[at + 1 : -1].sum() + 0.5 * share[at]
        assert wider == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("dof", [4.0, np.inf])
def test_a_motor_may_settle_anywhere_once(model, dof):
    """As in one movement of 40,000: a hand on the arm is not yet a fault, however normal it is."""
    settling = replace(model.settling, tail_dof=dof)
    model = replace(model, imperfections=replace(model.imperfections, settling=settling))
    off = np.zeros(4)
    off[1] = 27.0 * model.scatter[1]
    evidence = seen(model, np.stack([np.zeros(4), off]))
    usual, blip = healthy_log_density(evidence, movement_likelihoods(evidence, model))[0]
    width = np.hypot(20.0 * model.scatter[1], model.path_noise / model.sensors._scale[0])
    usual_width = np.hypot(model.scatter[1], model.path_noise / model.sensors._scale[0])
    expected = np.log(2.5e-5) - 0.5 * (off[1] / width) ** 2 - np.log(width / usual_width)
    assert blip - usual == pytest.approx(expected, abs=0.1 if np.isinf(dof) else 1.6)


def test_a_motor_that_missed_a_command_stays_where_it_was_seen(model):
    """Also if the movement that took it there was not seen: x ~ N(mu, v) by the first reading."""
    s, noise = model.scatter[0], model.path_noise / model.sensors._scale[0]
    far, usable = 3.5 * s, (True, False, True, True)
    density = {}
    for name, last in (("stays", far), ("moves", -far)):
        off = np.zeros((4, 4))
        off[1:, 0] = far, far, last
        evidence = seen(model, off, usable, lost=(2, 3))
        # The second loss in a row: the target that it stays at is that of the second movement.
        stayed = model.settle(
            np.where(np.arange(4) == 0, TARGETS[1], TARGETS[3]),
            np.sign(np.array([TARGETS[1, 0], 0.0, 0.0, 0.0]) - np.array([TARGETS[0, 0], 0, 0, 0])),
            model.none_held,
        )[0]  # fmt: skip
        point = evidence.point.copy()
        point[0, 3, 0] = model.sensors._scale[0] * (stayed + last)
        evidence = replace(evidence, point=point)
        density[name] = healthy_log_density(evidence, movement_likelihoods(evidence, model))[0, 3]
    variance = 1.0 / (1.0 / s**2 + 1.0 / noise**2)
    scale = np.sqrt(variance + model.held_scatter[0] ** 2 + noise**2)
    mean = far * variance / noise**2
    # What is left at the mode is a Student t of four motors, narrower than one that moved anew.
    anew = np.hypot(s, noise)
    gain = density["stays"] - density["moves"]
    assert gain > 4.0
    evidence = seen(model, np.zeros((1, 4)))
    usual = healthy_log_density(evidence, movement_likelihoods(evidence, model))[0, 0]
    fall = (
        -0.5
        * (model.settling.tail_dof + 4)
        * np.log1p(((far - mean) / scale) ** 2 / model.settling.tail_dof)
    )
    expected = usual + np.log(LOST / (1.0 - LOST)) + np.log(anew / scale) + fall
    assert density["stays"] == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize("wide", [4.0, 10.0])
def test_a_motor_that_scattered_far_stays_there_when_it_misses_a_command(model, wide):
    """Else two movements in a row would look as if it were stuck where it had scattered to."""
    model, off = model.seen_by(("tool",)), np.zeros((4, 4))
    off[2:4, 0] = wide * model.scatter[0]
    evidence = seen(model, off, lost=(3,))
    far = healthy_log_density(evidence, movement_likelihoods(evidence, model))[0, 3]
    off[2:4, 0] = 0.0
    evidence = seen(model, off, lost=(3,))
    usual = healthy_log_density(evidence, movement_likelihoods(evidence, model))[0, 3]
    assert far == pytest.approx(usual, abs=0.8)


def test_what_was_not_seen_says_nothing(model):
    evidence = seen(model, np.zeros((4, 4)), (True, False, True, False))
    found = healthy_log_density(evidence, movement_likelihoods(evidence, model))
    np.testing.assert_array_equal(found[0, [1, 3]], 0.0)
    assert (found[0, [0, 2]] != 0.0).all()
