from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import InputError, load_robot
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.signals import noise_free_path
from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
from failuretwin.decision.test_motions.design import Designer
from failuretwin.decision.test_motions.health_check import checking
from failuretwin.decision.test_motions.motions import Motions
from failuretwin.decision.test_motions.outlook import Member, Outlook, of_priors
from failuretwin.digital_model.clearance import segment_distance
from failuretwin.failure_behavior.fault import STEP
from failuretwin.failure_behavior.injection import Injection
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.observation.healthy_model import HealthyModel

COUNT_RAD = np.deg2rad(0.24)


def movements(told, since_s):
    """Return movements one after the other, the start first in `told`."""
    return told[1:], told[:-1], since_s, np.arange(len(told) - 1)


def settled_by_simulation(model, told, hypothesis, size):
    """Return where the servo engine's tool stands after each movement, nothing by chance."""
    fault, count = hypothesis.faults[0], len(told) - 1
    mode = MODES[fault.mode]
    mode = replace(mode, onset_s=(0.0, 0.0), profiles=(STEP,))
    if hasattr(mode, "magnitude"):
        mode = replace(mode, magnitude=(size, size))
        if mode.signed:
            mode = replace(mode, both_signs=False)
    time = np.arange(0.0, 3.0 * count + 0.005, 0.01)
    start = 3.0 * np.arange(count)
    movements = Movements(
        told[:1], told[None, 1:], np.full((1, count, told.shape[1]), 0.8), start[None]
    )
    value = mode.draw(fault.motor, count, float(time[-1]), np.random.default_rng(0))
    injection = Injection([[value]], model.motor_names, MODES)
    path = noise_free_path(model.twin, model.imperfections, movements, time, injection)
    return path[0, np.searchsorted(time, start + 2.95)]


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("motor_2:encoder_bias", 0.1),
        ("motor_3:encoder_scale", -0.3),
        ("motor_4:backlash", 0.15),
        ("motor_3:torque_loss", 0.6),
        ("motor_2:stuck", 0.0),
    ],
)
def test_expected_places_are_those_of_the_simulated_fault(model, fault, size):
    told = np.deg2rad([[0, 0, 0, 0], [40, 30, -20, 35], [-30, -20, 40, -30], [10, 35, 5, 45]])
    hypothesis = Hypothesis.parse(fault)
    outlook = Outlook(model, [Member(HEALTHY, np.nan, 0.5), Member(hypothesis, size, 0.5)])
    mean, _ = outlook.expected(*movements(told, 3.0 * np.arange(1, 4)))
    if fault.endswith("stuck"):  # where the healthy motor settled at zero
        held = model.settle(told[:1], 0.0 * told[:1], model.none_held)[0, 1]
        members = [Member(HEALTHY, np.nan, 0.5), Member(hypothesis, held, 0.5)]
        mean, _ = Outlook(model, members).expected(*movements(told, 3.0 * np.arange(1, 4)))
    seen = settled_by_simulation(model, told, hypothesis, size)
    away = np.linalg.norm(mean[:, 0] - seen, axis=-1)
    assert np.linalg.norm(mean[:, 1] - seen, axis=-1).max() < 0.0015
    assert away.max() > 0.003


def test_an_error_drawn_anew_is_scatter_of_its_motor(model):
    hypothesis = Hypothesis.parse("motor_3:steady_state_error")
    outlook = Outlook(model, [Member(HEALTHY, np.nan, 0.5), Member(hypothesis, 0.05, 0.5)])
    told = np.deg2rad([[0, 0, 0, 0], [20, 30, -20, 35]])
    mean, spread = outlook.expected(*movements(told, np.ones(1)))
    np.testing.assert_array_equal(mean[0, 0], mean[0, 1])
    pose = model.settle(told[1], np.sign(told[1]), model.none_held)
    _, jacobian = model.twin.path_and_jacobian(pose)
    more = 0.05**2 * np.outer(jacobian[:, 2], jacobian[:, 2])
    np.testing.assert_allclose(spread[0, 1] - spread[0, 0], more, atol=1e-12)


def test_movements_fit_into_the_time_and_come_from_both_sides(designed):
    assert sum(movement.seconds for movement in designed) <= 20.0
    assert len(designed) >= 10
    travel = np.array([movement.order.target - movement.previous for movement in designed])
    up = (travel > 0.0).mean(axis=0)
    assert np.all((up >= 0.25) & (up <= 0.75))


def test_ways_are_safe_even_if_a_motor_stays_where_it_stood(armpi, gate, designed):
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    assert any(np.any((m.order.target < low) | (m.order.target > high)) for m in designed)
    physical = gate.clearance
    for movement in designed:
        share = np.linspace(0.0, 1.0, 40)[:, None]
        way = movement.previous + share * (movement.order.target - movement.previous)
        speed = np.abs(movement.order.target - movement.previous) / movement.order.duration
        assert np.all(speed <= 0.5 * np.array([m.speed_limit for m in armpi.motors]) + 1e-9)
        for held in (None, 0, 1, 2, 3):
            poses = way.copy()
            if held is not None:
                poses[:, held] = 0.0
            points = physical.points(poses)
            assert points[..., 2:, 2].min() > 0.0
            elbow = segment_distance(points[:, 0], points[:, 1], points[:, -2], points[:, -1])
            assert elbow.min() > 0.0


def test_small_errors_of_the_hardest_motor_show_more_than_in_random_movements(
    model, gate, outlook, designed
):
    random = Designer(gate, outlook, seed=3, usual=True).random(np.zeros(4), 20.0, len(designed))
    small = [
        Member(Hypothesis.parse(f"{motor}:steady_state_error"), 5.0 * COUNT_RAD, 0.2)
        for motor in model.motor_names
    ]
    errors = Outlook(model, [Member(HEALTHY, np.nan, 0.2), *small])
    found = []
    for made in (designed, random):
        told = np.array([made[0].previous, *(m.order.target for m in made)])
        nats = errors.distances(*movements(told, np.zeros(len(made)))).sum(axis=0)
        found.append((nats + np.where(np.eye(5), np.inf, 0.0)).min())
    assert found[0] > 1.5 * found[1]


def test_no_motor_is_left_alone_at_the_end(designed):
    """One that rests then may be stuck unseen."""
    last = np.array([movement.order.target for movement in designed[-4:]])
    assert np.all(np.abs(np.diff(last, axis=0)).max(axis=0) > np.deg2rad(5.0))


def test_the_hardest_motor_gets_poses_that_show_it(model, designed):
    """Motor 4 of the ArmPi shows least; poses with it far out tell more of it than random ones."""

    def shown(poses):
        _, jacobian = model.twin.path_and_jacobian(poses)
        others = np.where(np.arange(4) == 3, 0.0, model.scatter)
        root = jacobian * others
        spread = root @ np.swapaxes(root, -1, -2) + model.path_noise**2 * np.eye(3)
        lever = jacobian[..., 3]
        found = np.linalg.solve(spread, lever[..., None])[..., 0]
        return np.einsum("ma,ma->m", lever, found)

    low, high = np.array([motor.movement_range for motor in model.twin.robot.motors]).T
    random = np.random.default_rng(0).uniform(low, high, (400, 4))
    chosen = np.array([movement.order.target for movement in designed])
    assert np.median(shown(chosen)) > 2.0 * np.median(shown(random))


@pytest.mark.parametrize("name", ["ur5e", "panda", "so101"])
def test_any_arm(name):
    robot = load_robot(name)
    model, gate = HealthyModel.of(robot), SafetyGate(robot)
    asked = paper_hypotheses(model.motor_names)
    members = of_priors(model, asked, checking(model, asked))
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    start = np.clip(0.0, low, high)
    made = Designer(gate, Outlook(model, members), 0).sequence(start, 20.0, 3)
    assert len(made) == 3
    for movement in made:
        assert not gate.wrong(movement.order, [(movement.previous, movement.order.target)])


def test_no_time_and_no_room_are_told(armpi, gate, outlook):
    with pytest.raises(InputError, match="no safe movement"):
        Designer(gate, outlook).sequence(np.zeros(4), 0.5)
    high = SafetyGate(armpi, SafetyLimits(floor_m=1.0))
    with pytest.raises(InputError, match="--floor"):
        Designer(high, outlook)


def test_motions_hold_what_was_designed(armpi, designed):
    motions = Motions.of(armpi, designed)
    time, command = motions.reference()
    assert command.shape == (len(time), 4)
    for begin, movement in zip(motions.start_s, designed, strict=True):
        end = begin + movement.order.duration[0]
        reached = command[np.searchsorted(time, end + 0.005)]
        np.testing.assert_allclose(reached, movement.order.target, atol=1e-9)


def test_as_much_time_is_left_for_coming_to_rest_as_is_asked_for(gate, outlook):
    usual = Designer(gate, outlook, seed=0)
    longer = Designer(gate, outlook, seed=0, least_rest_s=2.0)
    shorter = Designer(gate, outlook, seed=0, least_rest_s=0.1)
    assert (longer.rest_s, shorter.rest_s) == (2.0, usual.rest_s)
    for movement in longer.sequence(np.zeros(4), 8.0):
        assert movement.seconds == pytest.approx(2.0 + movement.order.duration.max())
