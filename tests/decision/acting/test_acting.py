"""The closed loop on an arm at rest: reactions, latched beliefs, repairs, lost commands."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import SmallWorld, believed, carry_out, task_of

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.decision.acting.belief import Belief
from failuretwin.decision.acting.believed_arm import BelievedArm
from failuretwin.decision.acting.task import ActingSettings
from failuretwin.failure_behavior.mode import Reaction
from failuretwin.failure_behavior.registry import MODES


def reached(actor):
    return sum(result.reached for result in actor.results)


def moves(actor):
    return sum(result.movements for result in actor.results)


def test_a_healthy_arm_is_left_alone(model, armpi):
    actor = carry_out(SmallWorld(model, 1), Belief(model), task_of(armpi, 6))
    assert reached(actor) == 6
    assert actor.belief.believed is None
    assert moves(actor) <= 9


def test_a_stuck_motor_is_planned_round(model, armpi):
    truth = believed(armpi, 2, "stuck", -0.2, -0.2)
    task = task_of(armpi, 8, 3)
    ours = carry_out(SmallWorld(model, 2, truth), Belief(model), task)
    alone = carry_out(SmallWorld(model, 2, truth), None, task)
    assert str(ours.belief.believed.fault) == "motor_3:stuck"
    assert ours.belief.believed.angle == pytest.approx(-0.2, abs=0.02)
    assert reached(ours) > reached(alone)
    assert moves(ours) < 0.6 * moves(alone)
    assert any("held" in text for text in ours.said)
    assert any("targets left can be reached" in text for text in ours.said)


def test_a_stuck_motor_is_told_to_stay_where_it_stands(model, armpi):
    truth = believed(armpi, 1, "stuck", 0.3, 0.3)
    world = SmallWorld(model, 2, truth)
    belief = Belief(model, believed=truth)
    carry_out(world, belief, task_of(armpi, 3, 3), ActingSettings(probe_every=100))
    told = [order.target[1] for _, order in world.orders]
    at_rest = np.abs(np.array(told) - 0.3) < np.deg2rad(0.24)
    assert at_rest.mean() > 0.5  # what is out of reach is tried once as if it were not stuck


def test_what_is_out_of_reach_is_said_and_tried_once(model, armpi):
    truth = believed(armpi, 0, "stuck", 1.2, 1.2)
    belief = Belief(model, believed=truth, lead=8.0)
    actor = carry_out(SmallWorld(model, 2, truth), belief, task_of(armpi, 5, 1))
    given_up = [result for result in actor.results if not result.reached]
    assert len(given_up) >= 4
    assert all(not result.reachable and result.movements <= 2 for result in given_up)
    assert sum("out of reach" in text for text in actor.said) >= len(given_up)


def test_a_repair_is_noticed_by_probing(model, armpi):
    truth = believed(armpi, 2, "stuck", 0.1, 0.1)
    world = SmallWorld(model, 2, truth)

    def repair(number):
        if number == 12:
            world.truth = None

    actor = carry_out(
        world,
        Belief(model),
        task_of(armpi, 14, 4),
        ActingSettings(probe_every=4),
        each=repair,
    )
    assert any("taken for motor_3:stuck" in text for text in actor.said)
    assert any("let go of motor_3:stuck" in text for text in actor.said)
    assert actor.belief.believed is None
    assert sum(result.reached for result in actor.results[-3:]) == 3


def test_evidence_is_not_forgotten_by_the_reaction(model, armpi):
    truth = believed(armpi, 3, "stuck", 0.4, 0.4)
    actor = carry_out(SmallWorld(model, 5, truth), Belief(model), task_of(armpi, 8, 6))
    said = [text for text in actor.said if "let go" in text or "given up" in text]
    assert said == []
    assert str(actor.belief.believed.fault) == "motor_4:stuck"


@pytest.mark.parametrize("wrong", [(1, "stuck"), (1, "steady_state_error")])
def test_a_wrong_belief_costs_a_healthy_arm_nothing(model, armpi, wrong):
    motor, mode = wrong
    angle = 0.5 if mode == "stuck" else np.nan
    belief = Belief(model, believed=believed(armpi, motor, mode, angle, angle))
    actor = carry_out(SmallWorld(model, 7), belief, task_of(armpi, 4, 2))
    assert reached(actor) == 4
    assert moves(actor) <= 8


def test_the_belief_in_another_stuck_motor_is_replaced(model, armpi):
    truth = believed(armpi, 3, "stuck", 0.3, 0.3)
    belief = Belief(model, believed=believed(armpi, 1, "stuck", 0.2, 0.2))
    actor = carry_out(SmallWorld(model, 7, truth), belief, task_of(armpi, 5, 2))
    assert str(actor.belief.believed.fault) == "motor_4:stuck"
    assert reached(actor) >= 3


def test_random_errors_are_parked_and_not_renamed_stuck(model, armpi):
    truth = believed(armpi, 1, "steady_state_error")
    task = task_of(armpi, 10, 8)
    ours = carry_out(SmallWorld(model, 3, truth), Belief(model), task)
    alone = carry_out(SmallWorld(model, 3, truth), None, task)
    assert reached(ours) > reached(alone) + 2
    assert str(ours.belief.believed.fault) == "motor_2:steady_state_error"
    assert not any("motor_2:stuck" in text for text in ours.said)


@pytest.mark.parametrize(("mode", "size"), [("encoder_bias", 0.15), ("encoder_scale", -0.35)])
def test_constant_errors_are_taken_off_the_commands(model, armpi, mode, size):
    truth = believed(armpi, 1, mode, size)
    task = task_of(armpi, 6, 9)
    ours = carry_out(SmallWorld(model, 3, truth), Belief(model), task)
    alone = carry_out(SmallWorld(model, 3, truth), None, task)
    assert str(ours.belief.believed.fault) == f"motor_2:{mode}"
    assert ours.belief.believed.size == pytest.approx(size, abs=0.05)
    assert moves(ours) < moves(alone)
    assert reached(ours) >= reached(alone)


def test_a_constant_error_is_taken_off_before_it_is_told_from_one_drawn_anew(model, armpi):
    """After two movements an error that was the same twice may still be drawn anew each time."""
    truth = believed(armpi, 2, "encoder_bias", 0.15)
    first = []
    for seed in range(3):
        world = SmallWorld(model, seed, truth)
        actor = carry_out(world, Belief(model), task_of(armpi, 3, seed))
        taken = [text for text in actor.said if text.startswith("taken for")]
        assert taken
        assert "motor_3" in taken[0]
        first.append(taken[0])
    early = [text for text in first if "looks alike" in text]
    assert len(early) >= 2
    assert all("encoder" in text for text in early)


def test_a_lost_command_is_sent_again_not_corrected_twice(model, armpi):
    world = SmallWorld(model, 3, lost={3})
    actor = carry_out(world, None, task_of(armpi, 5, 9))
    assert reached(actor) == 5
    again = [text for text in actor.said if "sent again" in text]
    assert len(again) == 1
    np.testing.assert_array_equal(world.orders[3][1].target, world.orders[2][1].target)


def test_a_drift_is_followed_and_taken_off_ahead(model, armpi):
    """What has slipped is many times what the latest movements show; the rate is what counts."""
    truth = believed(armpi, 1, "drift", 0.015)
    task = task_of(armpi, 9, 9)
    world = SmallWorld(model, 1, truth)
    ours = carry_out(world, Belief(model), task)
    alone = carry_out(SmallWorld(model, 1, truth), None, task)
    drift = ours.belief.believed
    assert str(drift.fault) == "motor_2:drift"
    assert drift.size == pytest.approx(0.015, rel=0.2)
    assert drift.size * (world.time_s - drift.since_s) == pytest.approx(
        0.015 * world.time_s, abs=0.03
    )
    assert reached(ours) >= reached(alone) + 4
    assert moves(ours) < 0.8 * moves(alone)


def test_commands_that_get_lost_again_are_sent_again(model, armpi):
    world = SmallWorld(model, 3, lost={3, 4})
    twice = ActingSettings(most_repeats=2)
    actor = carry_out(world, None, task_of(armpi, 5, 9), twice)
    orders = [order.target for _, order in world.orders]
    again = [bool(np.array_equal(order, orders[2])) for order in orders[3:]]
    assert again.index(False) == 2
    assert reached(actor) == 5


def test_open_loop_moves_once_for_each_target(model, armpi):
    truth = believed(armpi, 1, "stuck", 0.5, 0.5)
    world = SmallWorld(model, 3, truth)
    actor = carry_out(world, None, task_of(armpi, 6, 9), ActingSettings(feedback=False))
    assert [result.movements for result in actor.results] == [1] * 6


# The believed arm: its inverse, and what every mode says is to be done.


@pytest.mark.parametrize(
    ("mode", "size"),
    [("encoder_bias", 0.2), ("encoder_scale", 0.6), ("encoder_scale", -0.6), ("drift", 0.02),
     ("backlash", 0.1), ("torque_loss", 0.6)],
)  # fmt: skip
def test_a_command_undoes_what_the_fault_does(model, armpi, mode, size):
    arm = BelievedArm(model, believed(armpi, 1, mode, size))
    wanted, previous = np.array([0.3, -0.4, 0.5, 0.2]), np.array([-0.2, 0.3, 0.0, -0.5])
    command = arm.command_for(wanted, previous, 3.0)
    settled = arm.settle(command, previous, 3.0)
    np.testing.assert_allclose(
        settled, wanted, atol=np.deg2rad(0.24) * 0.5 * (1.0 + abs(size)) + 1e-3
    )
    healthy = BelievedArm(model).command_for(wanted, previous, 3.0)
    assert abs(command[1] - healthy[1]) > 0.01


def test_a_motor_that_rests_is_left_alone(model, armpi):
    held = BelievedArm(model, believed(armpi, 2, "stuck", 0.6, 0.6))
    parked = BelievedArm(model, believed(armpi, 2, "steady_state_error", np.nan, 0.6))
    wanted, previous = np.array([0.3, -0.4, 0.6, 0.2]), np.full(4, 0.1)
    assert held.command_for(wanted, previous, 0.0)[2] == pytest.approx(0.6, abs=0.0025)
    assert parked.command_for(wanted, previous, 0.0)[2] == pytest.approx(0.1, abs=0.0025)
    assert held.settle(wanted, previous, 0.0)[2] == 0.6


def test_commands_are_whole_counts_within_limits(model, armpi):
    arm = BelievedArm(model)
    units = armpi.servo_units
    command = arm.rounded(np.array([3.0, -3.0, 0.1234, 0.0]))
    counts = units.to_counts(command)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    low, high = arm.limits
    assert np.all((command >= low) & (command <= high))


def test_every_mode_says_what_is_to_be_done():
    told = {name: mode.reaction for name, mode in MODES.items()}
    assert told["stuck"] is Reaction.LOCK
    assert told["steady_state_error"] is told["intermittent"] is Reaction.PARK
    assert told["encoder_bias"] is told["encoder_scale"] is told["drift"] is Reaction.INVERT
    assert told["slow"] is told["lag"] is Reaction.WAIT
    assert told["lost_commands"] is Reaction.REPEAT
    assert told["torque_loss"] is Reaction.SPARE


def test_a_belief_can_name_faults_that_are_weighed_only(model):
    judge_of = Belief(model)
    assert judge_of.window == []
    assert Hypothesis.parse("motor_2:stuck", model.motor_names).faults[0].mode in MODES
