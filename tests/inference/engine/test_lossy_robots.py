"""Robots that lose more commands: what the shares of outcomes say is what other weights say."""

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Schedule, with_rates
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.engine.moments import LOSSY
from failuretwin.inference.engine.registration import robot_weighing
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood

ENDLESS = RandomMovements(count=6, period_s=1.2, ramp_shares=(1.0,))
FAULTS = ["motor_2:stuck", "motor_3:steady_state_error"]
OFFERED = ["healthy", *FAULTS, "motor_2:steady_state_error", "motor_3:stuck", "motor_4:stuck"]


def weighed(robot, runs, times, share):
    """Runs of a robot that loses commands so often, with a share of robots that lose more."""
    usual = generic_imperfections(robot)
    lossy = replace(usual, lost_commands=with_rates(usual, times).lost_commands)
    diagnoser = ft.BayesDiagnoser(robot, lossy)
    seen = diagnoser.seen(runs)
    likelihood = RunLikelihood(seen.settled, seen.healthy)
    hypotheses = [Hypothesis.parse(name, robot.motor_names) for name in OFFERED]
    weighing = robot_weighing(likelihood, hypotheses, Priors())
    return replace(weighing, components=replace(weighing.components, lossy=share))


def probability(log_joint):
    return np.exp(log_joint - log_sum(log_joint, axis=1)[:, None])


@pytest.mark.parametrize(("name", "movements"), [("armpi_fpv", None), ("ur5e", ENDLESS)])
def test_shares_of_outcomes_say_what_other_weights_say(name, movements):
    """At rest and on the way, with lost commands and without, for every likely hypothesis."""
    robot, share = load_robot(name), 0.15
    own = with_rates(generic_imperfections(robot), LOSSY)
    if movements is not None:
        own = replace(own, schedule=Schedule(period_s=(1.2, 1.2)))
    runs = simulate(Plan(robot, OFFERED[:3], 6, 4, imperfections=own, movements=movements))
    usual, more, both = (
        weighed(robot, runs, *told).evidence for told in ((1.0, 0.0), (LOSSY, 0.0), (1.0, share))
    )
    one, other = np.log1p(-share) + usual.by_hypothesis, np.log(share) + more.by_hypothesis
    exact = np.logaddexp(one, other)
    expected = probability(exact + usual.log_odds)
    found = probability(both.by_hypothesis + both.log_odds)
    assert np.abs(found - expected).max() < 0.05
    lossy = np.sum(expected * np.exp(other - exact), axis=1)
    assert lossy.min() < share < 0.5 < lossy.max()  # some runs lose commands, some do not
    off = np.abs(np.sum(found * both.lossy, axis=1) - lossy)
    assert np.median(off) < 0.03  # with a stuck motor a lost command may count twice


def test_a_robot_that_loses_many_commands_is_told_so():
    robot = load_robot("armpi_fpv")
    own = with_rates(generic_imperfections(robot), 4.0)
    runs = simulate(Plan(robot, ["healthy"], 12, 1, imperfections=own))
    said = " ".join(str(d) for d in ft.diagnose(runs, robot, "generic"))
    assert f"about {LOSSY:g} times as often as with such arms; judged so" in said
