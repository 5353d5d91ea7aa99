"""The state of a robot over all its runs, and the one thing to do next."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import (
    FAULTY_STATE,
    HEALTHY_STATE,
    OPEN_STATE,
    Diagnosis,
    Hypothesis,
    MovementEvidence,
    state_of,
)
from failuretwin.decision.robot_state import robot_state
from failuretwin.failure_behavior.registry import MODES
from failuretwin.failure_behavior.repair import ADVICE, advice_for
from failuretwin.inference.advice import (
    NOTHING_TO_DO,
    UNKNOWN_ADVICE,
    next_steps,
    rests_on_one_movement,
    sureness,
)
from failuretwin.inference.together.fault_course import FaultCourse

ROBOT = load_robot("armpi_fpv")


def run(name, undecided="", nats=(), **chances):
    posterior = {"healthy": 0.0, "motor_1:stuck": 0.0, "motor_2:stuck": 0.0}
    posterior |= {key.replace("__", ":"): value for key, value in chances.items()}
    posterior["healthy"] = 1.0 - sum(posterior.values()) + posterior["healthy"]
    evidence = tuple(MovementEvidence(m, n) for m, n in enumerate(nats, 1))
    return Diagnosis(name, posterior, undecided=undecided, evidence=evidence)


def faulty_run(name):
    return run(name, motor_1__stuck=0.999)


LARGE = "nothing explains it; motor 2 alone explains it, up to +34 deg off: more than considered"


def test_healthy_runs_do_not_hide_one_that_a_motor_alone_explains():
    found = robot_state([run("1", healthy=1.0), run("2", LARGE), run("3", healthy=1.0)], ROBOT)
    assert found.state.kind == OPEN_STATE
    assert found.headline.endswith("no fault that is considered explains 1 of 3 runs")
    assert found.remark == "motor 2 alone explains it, up to +34 deg off"
    assert "`--hypotheses` with drift or unknown" in found.step
    sure = robot_state([faulty_run("1"), run("2", LARGE), faulty_run("3")], ROBOT)
    assert (sure.state.kind, sure.state.motors) == (FAULTY_STATE, ("motor_1",))


def test_runs_that_agree_are_never_surer_together_than_the_surest():
    chances = (0.97, 0.99, 0.96)
    runs = [run(f"{i}", motor_2__stuck=p) for i, p in enumerate(chances)]
    found = robot_state(runs, ROBOT)
    assert (found.state.kind, found.state.motors) == (FAULTY_STATE, ("motor_2",))
    assert found.state.probability == pytest.approx(np.mean(chances))
    assert found.step == MODES["stuck"].advice
    assert [row.faulty for row in found.motors] == [0, 3, 0, 0]
    assert [row.kind for row in found.motors] == [
        HEALTHY_STATE,
        FAULTY_STATE,
        HEALTHY_STATE,
        HEALTHY_STATE,
    ]


def test_runs_that_are_unsure_stay_so_however_many_they_are():
    found = robot_state([run(f"{i}", motor_2__stuck=0.87) for i in range(50)], ROBOT)
    assert found.state.kind == OPEN_STATE
    assert found.sureness == "likely, but not sure (87 %)"
    assert found.step.startswith("Record again, with motor 2 moving")
    assert "Replace" not in found.step
    assert found.step.endswith("--self-calibrate.")


def test_runs_that_were_weighed_together_are_not_told_to_be():
    unsure = [run(f"{i}", motor_2__stuck=0.87) for i in range(5)]
    assert "--self-calibrate" not in robot_state(unsure, ROBOT, learned=()).step
    apart = [run("a", motor_1__stuck=0.99), run("b")]
    assert "--self-calibrate" in robot_state(apart, ROBOT).step
    assert "leave out --independent" in robot_state(apart, ROBOT, learned=()).step


def test_a_zero_that_may_be_a_fault_of_every_run_is_no_healthy_robot():
    odd = "bias of motor_2: +4.1 deviations off: a zero that is off, or a fault that every run has"
    found = robot_state([run("a"), run("b")], ROBOT, learned=("most was learned from a", odd))
    assert found.state.kind == OPEN_STATE
    assert found.headline == "Cannot tell yet; healthy, but for a zero that may be a fault"
    assert "+4.1 deviations off" in found.remark
    assert found.step.startswith("Look at the zero mark")
    assert robot_state([run("a")], ROBOT, learned=("most was learned",)).state.kind == HEALTHY_STATE


def test_a_log_whose_set_up_is_uncertain_is_not_plainly_healthy():
    doubt = (
        "the log does not fit the profile (97.0 % sure): motor 2 turns the other way: reverse it"
    )
    healthy, faulty = (replace(one, quality=(doubt,)) for one in (run("a"), faulty_run("b")))
    found = robot_state([healthy], ROBOT)
    assert found.headline == "Healthy, but its set-up is uncertain"
    assert found.state.kind == "cannot tell"
    assert {row.kind for row in found.motors} == {"cannot tell"}
    assert found.step.startswith("Put the set-up right first")
    assert found.step.endswith("reverse it.")
    repair = robot_state([faulty_run("b")], ROBOT).step
    assert robot_state([faulty], ROBOT).step.endswith(repair)
    perhaps = replace(faulty, quality=("the log may not fit the profile (11 %): " + doubt[-28:],))
    assert robot_state([perhaps], ROBOT).step.startswith(
        f"{repair} Look at the set-up too: the log"
    )


def test_a_fault_that_began_is_told_by_the_runs_since_then():
    runs = [run("a"), run("b"), run("c", motor_1__stuck=0.98), run("d", motor_1__stuck=0.99)]
    found = robot_state(runs, ROBOT)
    assert found.state.kind == FAULTY_STATE
    assert found.state.probability == pytest.approx(0.985)
    assert "since run 3 of 4 (c)" in found.line


def test_one_run_of_several_alone_is_recorded_again():
    found = robot_state([run("a"), run("b"), run("c", motor_1__stuck=0.999)], ROBOT)
    assert found.step.startswith("One run alone shows it: record again, with motor 1 moving")


def test_runs_that_contradict_each_other_are_counted():
    runs = [run("a", motor_1__stuck=0.99), run("b"), run("c", motor_2__stuck=0.99), run("d")]
    found = robot_state(runs, ROBOT)
    assert found.state.kind == OPEN_STATE
    assert found.state.probability is None
    for told in ("healthy in 2 runs", "motor 1 faulty in 1 run", "motor 2 faulty in 1 run"):
        assert told in found.line
    assert "--self-calibrate" in found.step


def test_runs_without_a_verdict_say_nothing():
    blind = run("a", undecided="the log holds no readings")
    assert "no readings" in robot_state([blind], ROBOT).headline
    assert "Log again" in robot_state([blind], ROBOT).step
    assert {row.kind for row in robot_state([blind], ROBOT).motors} == {OPEN_STATE}
    found = robot_state([blind, run("b", motor_2__stuck=0.99)], ROBOT)
    assert found.state.probability == pytest.approx(0.99)
    with pytest.raises(InputError, match="one run at least"):
        robot_state([], ROBOT)


def test_runs_that_were_weighed_together_have_the_state_of_their_course():
    runs = [run(f"{i}", motor_2__stuck=0.87) for i in range(4)]
    course = FaultCourse.of(runs)
    found = robot_state(runs, ROBOT, course)
    at = [str(h) for h in course.hypotheses].index("motor_2:stuck")
    assert found.state.probability == pytest.approx(course.posterior[-1, at])
    assert found.state.kind == FAULTY_STATE
    assert found.remark == "; ".join(course.verdict)


def test_a_motor_is_sure_before_its_fault_is():
    posterior = {"healthy": 0.01, "motor_2:stuck": 0.6, "motor_2:drift": 0.39}
    assert state_of(posterior) == FAULTY_STATE
    (step,) = next_steps(posterior)
    assert step.startswith("Which fault of motor 2 it is stays open: record again")
    assert "Replace" not in step


def test_unknown_faults_leave_no_motor_healthy():
    found = robot_state([Diagnosis("a", {"healthy": 0.02, "unknown": 0.98})], ROBOT)
    assert found.state.kind == OPEN_STATE
    assert found.step == UNKNOWN_ADVICE
    assert {row.kind for row in found.motors} == {OPEN_STATE}


# One movement alone: without it another would be the most probable.


@pytest.mark.parametrize(
    ("nats", "alone"),
    [((2.0, 2.5), False), ((0.1, 4.7), True), ((4.5,), True), ((), False), ((0.1, 4.5), False)],
)
def test_a_verdict_that_one_movement_carries(nats, alone):
    found = run("a", motor_2__stuck=0.99, nats=nats)
    assert math.log(0.99 / 0.01) == pytest.approx(4.595, abs=1e-3)
    assert rests_on_one_movement(found) is alone


def test_a_runner_up_of_the_same_motor_leaves_no_doubt_about_it():
    posterior = {"motor_2:stuck": 0.9, "motor_2:drift": 0.1}
    evidence = (MovementEvidence(1, 9.0), MovementEvidence(2, 0.1))
    assert not rests_on_one_movement(Diagnosis("a", posterior, evidence=evidence))


# Steps by sureness and by actuator.


@pytest.mark.parametrize(("chance", "repair"), [(0.87, False), (0.949, False), (0.951, True)])
def test_nothing_is_repaired_below_95_per_cent(chance, repair):
    for mode in MODES:
        posterior = {"healthy": 1.0 - chance, f"motor_2:{mode}": chance}
        (step,) = next_steps(posterior, "hobby servo")
        assert (step == MODES[mode].advice) is repair
        assert ("Record again, with motor 2 moving" in step) is not repair


def test_healthy_is_left_alone_when_sure_and_asked_about_when_not():
    assert next_steps({"healthy": 0.96, "motor_1:stuck": 0.04}) == [NOTHING_TO_DO]
    (step,) = next_steps({"healthy": 0.9, "motor_1:stuck": 0.1})
    assert step.startswith("Record again, with motor 1 moving")


@pytest.mark.parametrize("mode", list(MODES.values()), ids=lambda mode: mode.mode)
def test_industrial_drives_have_no_horn_and_no_servo_to_replace(mode):
    told = advice_for(mode, "industrial")
    assert told.endswith(".")
    assert not any(word in told.lower() for word in ("servo", "horn", "solder"))
    assert advice_for(mode, "hobby servo") == advice_for(mode, "") == mode.advice


def test_a_stuck_joint_with_a_brake_is_not_turned_by_hand():
    (step,) = next_steps({"motor_1:stuck": 1.0}, "industrial")
    assert "holding brake" in step
    assert "turn the joint by hand" not in step
    assert set(ADVICE) == {"industrial", "cable-driven"}
    assert all(name in MODES for table in ADVICE.values() for name in table)


@pytest.mark.parametrize(
    ("chance", "words"),
    [(0.9995, "all but certain"), (0.95, "sure"), (0.87, "likely, but not sure"),
     (0.6, "more likely than not"), (0.3, "open")],
)  # fmt: skip
def test_sureness_in_words(chance, words):
    assert sureness(chance) == words


def test_two_faults_are_repaired_one_by_one():
    steps = next_steps({"motor_1:stuck+motor_2:drift": 0.99, "healthy": 0.01})
    assert steps == [MODES["stuck"].advice, MODES["drift"].advice]
    assert Hypothesis.parse("motor_1:stuck+motor_2:drift").faults[1].mode == "drift"
