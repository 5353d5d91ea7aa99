"""Wrong set-ups: named as such, undone, and told from faults."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, SetupPrior, load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY_STATE, paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.robot_state import robot_state
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.set_up_posterior import SetUpPosterior, WeighedSetUp
from failuretwin.inference.set_up_weighing import SetUpWeighing, right_in_some
from failuretwin.inference.set_ups.log_correction import CorrectionTable, LogCorrection
from failuretwin.inference.set_ups.set_ups import FAULT_OF_EVERY_RUN, SetUp, mistakes, zero_off
from failuretwin.inference.set_ups.wrong_setup import ANOTHER

TRUTHS = ["healthy", "motor_2:stuck", "motor_3:steady_state_error"]
NONE = LogCorrection.none(4)
I4 = np.eye(4)
FITS = "fit the profile"
ERRORS = ["healthy", *(f"motor_{k}:steady_state_error" for k in (1, 2, 3, 4))]
"""What looks like a zero that is off; with motors that may be stuck it takes twice as long."""


@pytest.fixture(scope="module")
def known(armpi):
    return load_calibration("armpi_fpv", armpi).imperfections


@pytest.fixture(scope="module")
def runs(armpi, known):
    return simulate(Plan(armpi, TRUTHS, 1, 3, known, RandomMovements(count=6)))


@pytest.fixture(scope="module")
def some_faults(twin):
    return BayesDiagnoser(twin, hypotheses=TRUTHS)


@pytest.fixture(scope="module")
def as_told(some_faults, runs):
    return some_faults.diagnose(runs)


def made(robot, words):
    """Return what makes a log with a mistake of one that fits."""
    return next(one.correction.inverse for one in mistakes(robot) if words in one.what)


def remarks(diagnosis):
    return [line for line in diagnosis.quality if FITS in line]


def same_verdicts(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert one.diagnosis == other.diagnosis
        assert one.posterior == pytest.approx(other.posterior, abs=0.03)


def test_no_set_up_is_tried_by_which_joints_turn_round_and_round(some_faults, runs, armpi):
    """A tool said to be in millimetres is near whatever such commands ask for."""
    seen = some_faults.seen(runs)
    told = seen.sample.evidence.movements.target
    weighing = SetUpWeighing(seen.sample, seen.hypotheses, seen.priors)
    units = [one for one in mistakes(armpi) if one.kind == "unit"]
    tried = weighing.nearest([two.beside(one) for one in units for two in units])
    assert tried
    for one in tried:
        assert np.nanmax(np.abs(one.correction.command(told))) < 20.0
    wild = [one for one in units if "radians taken for degrees" in one.what]
    assert weighing.nearest(wild) == wild  # there is nothing else


# Corrections.


def some_correction():
    C, M = I4[[1, 0, 3, 2]] * [-1.0, 1.0, 1.0, -1.0], np.eye(3)[[2, 0, 1]] * [1e-3, -1e-3, 1e-3]
    return LogCorrection(C, np.array([0.1, 0.0, -0.2, 0.3]), M, np.array([0.3, -0.1, 0.2]), 0.5)


def test_a_mistake_that_is_undone_is_gone(runs):
    there = some_correction()
    back = there.inverse.runs(there.runs(runs))
    np.testing.assert_allclose(back["command"], runs["command"], atol=1e-12)
    seen = np.isfinite(back["measured"].values)
    np.testing.assert_allclose(
        back["measured"].values[seen], runs["measured"].values[seen], atol=1e-12
    )
    assert seen.sum() > 500


def test_one_after_the_other_is_both():
    first, then = some_correction(), replace(some_correction(), z=np.ones(4), t=np.ones(3))
    u, s = np.array([0.3, -0.4, 0.5, 1.0]), np.array([0.1, 0.2, -0.3])
    both = then.after(first)
    np.testing.assert_allclose(both.command(u), then.command(first.command(u)))
    np.testing.assert_allclose(both.point(s), then.point(first.point(s)))
    assert both.late_s == 1.0
    assert pytest.approx(I4) == first.after(first.inverse).C


def test_evidence_is_corrected_as_its_runs_are(runs):
    there = replace(some_correction(), late_s=0.0)
    from_runs, corrected = (
        Evidence(there.runs(runs)).settled,
        there.evidence(Evidence(runs).settled),
    )
    np.testing.assert_allclose(from_runs.movements.target, corrected.movements.target, atol=1e-6)
    ramps = corrected.movements.ramp_duration
    np.testing.assert_allclose(from_runs.movements.ramp_duration, ramps, atol=0.02)


def test_a_correction_is_read_as_it_is_written():
    import tomllib

    table = tomllib.loads(some_correction().text("all wrong"))["correction"]
    rows = {k: tuple(map(tuple, v)) if k in ("commands", "tool") else v for k, v in table.items()}
    read = LogCorrection.from_file(CorrectionTable(**rows), 4, "map.toml: correction")
    for name in ("C", "z", "M", "t", "late_s"):
        np.testing.assert_allclose(getattr(read, name), getattr(some_correction(), name))
    with pytest.raises(InputError, match="expected 5 rows of 5 numbers"):
        LogCorrection.from_file(CorrectionTable(**rows), 5, "map.toml: correction")


def test_a_correction_that_forgets_a_motor_is_refused():
    table = CorrectionTable(((1.0, 0.0), (1.0, 0.0)), (0.0, 0.0), ((1, 0, 0),) * 3, (0, 0, 0))
    with pytest.raises(InputError, match="cannot be undone"):
        LogCorrection.from_file(table, 2, "map.toml: correction")


# What is believed.


def test_belief_is_prior_times_evidence():
    """Bayes' rule by hand; two ways to undo the same count once."""
    undo = replace(NONE, z=I4[0])
    ways = [
        WeighedSetUp(SetUp("", "", NONE, np.log(0.7)), np.array([-3.0, -4.0]), 0.1),
        WeighedSetUp(SetUp("a", "", undo, np.log(0.2)), np.array([-2.0, -4.0]), 0.1),
        WeighedSetUp(SetUp("b", "", undo, np.log(0.1)), np.array([-2.0, -4.0]), 0.1),
    ]
    found = SetUpPosterior.of(ways)
    assert found.wrong == pytest.approx(0.2 * np.e / (0.7 + 0.2 * np.e))
    assert [one.set_up.what for one in found.found] == ["", "a"]


def test_the_prior_of_a_zero_has_a_narrow_half_and_a_wide_one(armpi):
    angle = np.linspace(-np.pi, np.pi, 20001)
    density = np.exp([zero_off(armpi, 1, z).log_prior for z in angle])
    total = np.trapezoid(density, angle)
    assert total == pytest.approx(0.25 / 4, rel=0.01)
    far = np.abs(angle) > np.deg2rad(30.0)
    assert np.trapezoid(np.where(far, density, 0.0), angle) / total == pytest.approx(
        0.418, abs=0.02
    )


def test_a_log_that_fits_is_judged_as_if_no_set_up_was_asked(twin, runs, as_told):
    sure = Priors(setup=replace(SetupPrior(), wrong_rate=(0.0, 0.0)))
    found = BayesDiagnoser(twin, hypotheses=TRUTHS, priors=sure).diagnose(runs)
    for one, other in zip(found, as_told, strict=True):
        assert one.posterior == pytest.approx(other.posterior, abs=1e-9)
        assert not remarks(other)


@pytest.mark.parametrize(
    "words",
    ["motor 2 and motor 3 are swapped", "y of the tool", "millimetres"],
)
def test_a_mistake_is_named_and_the_diagnosis_goes_on(twin, some_faults, runs, as_told, words):
    found = some_faults.diagnose(made(twin.robot, words).runs(runs.isel(run=[1])))
    same_verdicts(found, as_told[1:2])
    assert all(words in remarks(d)[0] and "does not fit" in remarks(d)[0] for d in found)


def test_one_run_is_enough_for_a_sense(twin, some_faults, runs, as_told):
    (found,) = some_faults.diagnose(made(twin.robot, "motor 2 turns").runs(runs.isel(run=[0])))
    same_verdicts([found], as_told[:1])
    assert "motor 2 turns the other way" in remarks(found)[0]


def test_two_mistakes_at_once_are_named(twin, some_faults, runs, as_told):
    both = made(twin.robot, "motor 2 turns").after(made(twin.robot, "motor 3 and motor 4"))
    (found,) = some_faults.diagnose(both.runs(runs.isel(run=[0])))
    same_verdicts([found], as_told[:1])
    assert "motor 2 turns" in remarks(found)[0]
    assert "motor 3 and motor 4" in remarks(found)[0]


@pytest.mark.parametrize("late_s", [0.4, -0.3])
def test_a_clock_that_is_apart_is_named_with_its_sign(some_faults, runs, as_told, late_s):
    found = some_faults.diagnose(replace(NONE, late_s=-late_s).runs(runs))
    told = re.search(r"clock is ([\d.]+) s (behind|ahead)", remarks(found[0])[0])
    assert told is not None
    assert float(told[1]) == pytest.approx(abs(late_s), abs=0.05)
    assert told[2] == ("behind" if late_s > 0.0 else "ahead")
    same_verdicts(found, as_told)


@pytest.mark.parametrize(("late_s", "told"), [(0.14, 0), (0.4, 2)])
def test_an_arm_that_nobody_has_calibrated_may_trail_its_commands(late_s, told):
    """By how much is not known, so a clock that is a little behind is not blamed for it."""
    robot = load_robot("ur5e")
    runs = simulate(Plan(robot, ["healthy"], 2, 3, NO_IMPERFECTIONS, RandomMovements(count=6)))
    late = replace(LogCorrection.none(len(robot.motors)), late_s=-late_s).runs(runs)
    few = paper_hypotheses(robot.motor_names)[:3]
    found = BayesDiagnoser(robot, hypotheses=few).diagnose(late)
    assert sum("clock" in line for one in found for line in remarks(one)) == told


def test_what_every_run_has_is_set_up_and_what_one_has_is_a_fault(twin, armpi, known):
    runs = simulate(Plan(armpi, ["healthy"], 8, 5, known, RandomMovements(count=5)))
    names = ["healthy", "motor_3:encoder_bias", "motor_3:steady_state_error", "motor_2:stuck"]
    diagnoser = BayesDiagnoser(twin, hypotheses=names)
    zero = replace(NONE, z=-0.12 * I4[2])
    every = diagnoser.diagnose(zero.runs(runs))
    assert all("motor 3 stands" in remarks(d)[0] for d in every)
    right = diagnoser.diagnose(runs)
    assert [d.diagnosis for d in every] == [d.diagnosis for d in right]
    assert sum(d.diagnosis == "healthy" for d in every) > 5
    for told in (d for d in every if d.diagnosis == "healthy"):  # no verdict without its condition
        assert re.search(r"; but the log does not fit the profile: motor 3 stands \+", told.verdict)
    assert not any("does not fit" in d.verdict for d in right)
    one = runs.copy(deep=True)
    one["command"].values[0] = zero.runs(runs)["command"].values[0]
    found = diagnoser.diagnose(one)
    assert found[0].diagnosis == "motor_3:encoder_bias"
    assert not any(remarks(d) for d in found)


def test_what_most_runs_have_and_some_have_not_is_a_fault_of_those(twin, armpi, known):
    """Undoing it as a zero would call the healthy runs faulty and the faulty ones healthy."""
    runs = simulate(Plan(armpi, ["healthy"], 5, 5, known, RandomMovements(count=5)))
    late = runs.copy(deep=True)
    off = replace(NONE, z=-0.12 * I4[2]).runs(runs)["command"].values
    late["command"].values[2:] = off[2:]
    names = ["healthy", "motor_3:encoder_bias", "motor_3:steady_state_error"]
    found = BayesDiagnoser(twin, hypotheses=names).diagnose(late)
    assert not any(remarks(d) for d in found)
    assert [d.diagnosis for d in found[2:]] == ["motor_3:encoder_bias"] * 3
    right = BayesDiagnoser(twin, hypotheses=names).diagnose(runs)
    assert [d.diagnosis for d in found[:2]] == [d.diagnosis for d in right[:2]]


@pytest.mark.parametrize("off_rad", [0.0, 0.06])
def test_a_zero_far_off_what_such_robots_do_is_told_of_one_run(twin, armpi, known, off_rad):
    """Nobody has calibrated the robot: nine deviations of what hobby servos differ by."""
    seen = simulate(Plan(armpi, ["healthy"], 1, 6, known, RandomMovements(count=6)))
    seen = replace(NONE, z=-off_rad * I4[2]).runs(seen)
    names, priors = ["healthy", "motor_2:stuck"], Priors(setup=SetupPrior(wrong_rate=(0.0, 0.0)))
    (found,) = BayesDiagnoser(twin, "generic", names, priors).diagnose(seen)
    told = [line for line in found.quality if "off what such robots do" in line]
    assert found.diagnosis == "healthy"
    assert len(told) == (off_rad > 0.0)
    for line in told:
        assert re.match(r"motor 3 rests \+3\.\d deg off", line)  # 0.06 rad is 3.4 deg
        assert line.endswith(FAULT_OF_EVERY_RUN)
    state = robot_state([found], armpi)
    assert (state.state.kind == HEALTHY_STATE) == (off_rad == 0.0)
    assert ("zero mark" in state.step) == (off_rad > 0.0)


@pytest.mark.parametrize(("motor", "off_deg"), [(0, 3.0), (1, -10.0), (2, 3.0), (3, -10.0)])
def test_of_one_run_a_zero_is_never_surely_a_motor(armpi, known, motor, off_deg):
    """A fault of every movement and a zero show the same: the prior alone tells them apart."""
    run = simulate(Plan(armpi, ["healthy"], 1, 11 + motor, known, RandomMovements(count=5)))
    wrong = replace(NONE, z=np.deg2rad(off_deg) * I4[motor]).runs(run)
    (found,) = BayesDiagnoser("armpi_fpv").diagnose(wrong)
    name, size = max(found.posterior.items(), key=lambda item: item[1])
    assert name == "healthy" or size < 0.9
    assert size < 0.6 or any(f"motor {motor + 1} stands" in line for line in found.quality)


def test_of_one_run_a_fault_does_not_hide_a_zero(armpi, known):
    """From the fault on no single motor explains the movements."""
    truth = "motor_1:stuck"
    run = simulate(Plan(armpi, [truth], 1, 5, known, RandomMovements(count=5)))
    wrong = replace(NONE, z=np.deg2rad(8.0) * I4[2]).runs(run)
    (found,) = BayesDiagnoser("armpi_fpv").diagnose(wrong)
    other = {name: p for name, p in found.posterior.items() if name != truth}
    assert max(other.values()) < 0.9
    assert any("motor 3 stands" in line for line in found.quality)


@pytest.mark.parametrize(
    "wrong",
    [
        replace(NONE, z=np.deg2rad([5.0, 0.0, -5.0, 0.0])),
        replace(NONE, z=np.deg2rad([0.0, 10.0, 0.0, 0.0]), t=np.array([0.0, 0.0, 0.005])),
    ],
)
def test_two_zeros_or_one_and_a_shift_blame_no_motor(armpi, known, wrong):
    runs = simulate(Plan(armpi, ["healthy"], 2, 21, known, RandomMovements(count=5)))
    for found in BayesDiagnoser("armpi_fpv", hypotheses=ERRORS).diagnose(wrong.runs(runs)):
        assert found.diagnosis == "healthy" or max(found.posterior.values()) < 0.9
        assert any("motor" in line for line in remarks(found))


@pytest.mark.parametrize(("off_deg", "right"), [(0.1, True), (1.6, False), (5.0, False)])
def test_a_motor_is_right_within_its_deviation_not_within_half_a_zero(off_deg, right):
    away = np.deg2rad(np.array([[5.0, 5.1, 4.9, 5.0], [10.0, off_deg, -off_deg, off_deg]]))
    seen = np.ones(away.shape, dtype=bool)
    assert right_in_some(away, seen, np.deg2rad(5.0), np.deg2rad(0.2)) is right


@pytest.mark.parametrize(("off_rad", "sure"), [(0.02, False), (0.06, True)])
def test_a_zero_as_others_of_the_class_have_it_may_be_another_robot(armpi, known, off_rad, sure):
    z = off_rad * np.array([0.0, 1.0, 0.0, 0.0])
    runs = simulate(Plan(armpi, ["healthy"], 8, 3, known, RandomMovements(count=6)))
    made_so = LogCorrection(I4, -z, np.eye(3), np.zeros(3)).runs(runs)
    found = BayesDiagnoser(armpi, known, ERRORS).seen(made_so).set_ups()
    zeros = [one for one in found.found if one.set_up.kind == "zero"]
    assert any(np.allclose(one.set_up.correction.z, z, atol=0.01) for one in zeros)
    assert found.wrong > 0.99 if sure else found.wrong < 0.5


def test_errors_that_are_drawn_anew_are_no_zero(armpi, known):
    """Nothing is lost of what only a fault does."""
    truth = "motor_3:steady_state_error"
    runs = simulate(Plan(armpi, [truth], 6, 7, known, RandomMovements(count=5)))
    found = [BayesDiagnoser("armpi_fpv").diagnose(runs.isel(run=[run]))[0] for run in range(6)]
    assert np.mean([one.posterior[truth] for one in found]) > 0.93
    assert sum(bool(remarks(one)) for one in found) <= 1


def test_what_is_weighed_twice_fits_as_it_fits_best():
    """As it was told, and with a sensor that may stand elsewhere."""
    told = SetUp("", "", NONE)
    twice = [
        WeighedSetUp(told, np.array([-4.0]), 0.31),
        WeighedSetUp(told, np.array([-5.0]), 0.1, moved=True),
    ]
    found = SetUpPosterior.of(twice)
    assert found.fits
    assert [one.log_joint for one in found.found] == [-4.0]


def test_a_log_of_another_world_gets_no_motor(twin, runs):
    """Tool positions that have nothing to do with the commands: no set-up, and no motor either."""
    strange = runs.assign(measured=(runs["measured"].dims, np.roll(runs["measured"].values, 1, 0)))
    (found,) = BayesDiagnoser(twin, hypotheses=ERRORS).diagnose(strange.isel(run=[0]))
    assert found.undecided == ANOTHER or "nowhere near" in found.undecided
    assert "alone explains" not in found.undecided


def test_what_explains_nothing_is_not_undone():
    """A wrong guess, such as kilometres, would make a tool that moves look dead."""
    kilometres = replace(NONE, M=1e-3 * np.eye(3))
    guess = SetUp("tool positions look like km", "", kilometres, kind="unit")
    lost = SetUpPosterior.of([WeighedSetUp(guess, np.zeros(1), misfit=0.9)])
    assert lost.best.set_up.what == guess.what
    assert lost.best.set_up.correction.is_none
    held = SetUpPosterior.of([WeighedSetUp(guess, np.zeros(1), misfit=0.1)])
    np.testing.assert_array_equal(held.best.set_up.correction.M, 1e-3 * np.eye(3))
