"""What may change in a log without changing the answer, and how far it may change it."""

from __future__ import annotations

from dataclasses import replace

import exact_runs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from failuretwin import BayesDiagnoser, DigitalTwin, Priors, SetupPrior
from failuretwin.core.hypothesis import paper_hypotheses, single_faults
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration

MODES = ("stuck", "steady_state_error", "lost_commands")


@pytest.fixture(scope="module")
def known(armpi):
    return load_calibration(None, armpi).imperfections


@pytest.fixture(scope="module")
def motions(twin, known):
    """Healthy, stuck and with errors: each motor once."""
    kinds = [("healthy", 0), ("stuck", 0), ("stuck", 2)]
    kinds += [("steady_state_error", 1), ("steady_state_error", 3)]
    return [exact_runs.move(twin, known, kind, k, 40 + i) for i, (kind, k) in enumerate(kinds)]


@pytest.fixture(scope="module")
def runs(twin, motions):
    """Seen at 10 Hz on a grid of 100 Hz."""
    return exact_runs.seen(twin, motions)


@pytest.fixture(scope="module")
def all_modes(twin):
    return BayesDiagnoser(twin, hypotheses=single_faults(twin.robot.motor_names, MODES))


@pytest.fixture(scope="module")
def usual(all_modes, runs):
    return all_modes.diagnose(runs)


def chances(diagnoses):
    return np.array([list(d.posterior.values()) for d in diagnoses])


def truths(motions):
    return [motion.truth for motion in motions]


def test_runs_of_known_motion_are_diagnosed(twin, runs, motions):
    """The ground on which the rest stands."""
    found = BayesDiagnoser(twin).diagnose(runs)
    assert [d.diagnosis for d in found] == truths(motions)


def renamed(robot, names):
    motors = tuple(
        replace(motor, name=name) for motor, name in zip(robot.motors, names, strict=True)
    )
    return replace(robot, profile=replace(robot.profile, motors=motors))


def test_names_of_motors_are_only_names(twin, known, all_modes, runs, usual):
    """The same numbers under other names: one that was another motor's, and in no order."""
    names = ["motor_3", "z -9", "_", "motor_1"]
    other = renamed(twin.robot, names)
    called = dict(zip(twin.robot.motor_names, names, strict=True))
    losses = tuple(
        replace(entry, motors=tuple(called[m] for m in entry.motors))
        for entry in known.lost_commands
    )
    hypotheses = single_faults(names, MODES)
    diagnoser = BayesDiagnoser(DigitalTwin(other), replace(known, lost_commands=losses), hypotheses)
    found = diagnoser.diagnose(runs.assign_coords(motor=list(names)))
    np.testing.assert_array_equal(chances(found), chances(usual))
    for one, before in zip(found, usual, strict=True):
        motor, _, mode = str(before.diagnosis).partition(":")
        assert one.diagnosis == (f"{called[motor]}:{mode}" if mode else before.diagnosis)
        assert (one.onset_90, one.magnitude_90) == (before.onset_90, before.magnitude_90)


def turned(robot, R):
    """Return the robot with its base turned by R (3, 3); gravity stays along -z."""
    first, T = robot.chain.joints[0], np.eye(4)
    T[:3, :3] = R
    joints = (replace(first, T_pj=T @ first.T_pj), *robot.chain.joints[1:])
    chain = replace(robot.chain, joints=joints)
    return replace(robot, chain=chain, loads=replace(robot.loads, chain=chain))


def test_quarter_turns_of_the_base_change_nothing(twin, known, all_modes, runs, usual):
    """About the vertical, sag and all: axes change places and signs, and nothing else."""
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    other = BayesDiagnoser(DigitalTwin(turned(twin.robot, R)), known, all_modes.hypotheses)
    path = runs["measured"].values @ R.T
    found = other.diagnose(runs.assign(measured=(runs["measured"].dims, path)))
    np.testing.assert_allclose(chances(found), chances(usual), rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module", params=[True, False], ids=["upright", "stiff"])
def not_turned(request, twin, known, all_modes, runs):
    """Whether the base stays upright, what is known then, and what is said of the runs."""
    stiff = replace(known.settling, compliance=(0.0,) * 4)
    healthy = known if request.param else replace(known, settling=stiff, variation=None)
    found = BayesDiagnoser(twin, healthy, all_modes.hypotheses, ONE_ROBOT).diagnose(runs)
    return request.param, healthy, chances(found)


ONE_ROBOT = Priors(setup=SetupPrior(another_rate=0.0))
"""Others of the class sag by its loads."""


@given(seed=st.integers(0, 10**6))
@settings(max_examples=1)
def test_turns_of_the_base_change_nothing(twin, all_modes, runs, not_turned, seed):
    """About the vertical with sag, about anything without; a tool at rest is one point, so that
    medians by axis do not depend on the axes."""
    rng = np.random.default_rng(1 + seed)
    upright, healthy, expected = not_turned
    R = Rotation.from_euler("z", rng.uniform(0, 6.3)) if upright else Rotation.random(rng=rng)
    path = runs["measured"].values @ R.as_matrix().T
    other = DigitalTwin(turned(twin.robot, R.as_matrix()))
    moved = runs.assign(measured=(runs["measured"].dims, path))
    found = BayesDiagnoser(other, healthy, all_modes.hypotheses, ONE_ROBOT).diagnose(moved)
    np.testing.assert_allclose(chances(found), expected, atol=1e-5)


@pytest.mark.parametrize("rows", [[2], [4, 0, 3, 0, 1, 3]])
def test_runs_are_judged_alone(all_modes, runs, usual, rows):
    """In any order, any number of times: each as it is judged among the others."""
    some = runs.isel(run=rows).assign_coords(run=[f"run {i}" for i in range(len(rows))])
    found = all_modes.diagnose(some)
    assert [d.run for d in found] == list(some["run"].values)
    np.testing.assert_allclose(chances(found), chances(usual)[rows], rtol=1e-9, atol=1e-15)
    assert [d.verdict for d in found] == [usual[i].verdict for i in rows]


def test_time_after_the_run_changes_nothing(all_modes, runs, usual):
    """Padding: the command held, no readings."""
    more = 700
    time = np.arange(runs.sizes["time"] + more) * 0.01
    longer = runs.pad(time=(0, more), mode="constant")
    held = runs["command"].pad(time=(0, more), mode="edge").values
    longer = longer.assign(command=(runs["command"].dims, held)).assign_coords(time=time)
    found = all_modes.diagnose(longer)
    np.testing.assert_allclose(chances(found), chances(usual), rtol=1e-9, atol=1e-15)
    assert [d.onset_90 for d in found] == [d.onset_90 for d in usual]


def test_longer_runs_beside_it_change_nothing(twin, all_modes, runs, usual):
    """Runs of two and of five movements, weighed together and apart."""
    short = runs.copy(deep=True)
    short["command"][0, 400:] = short["command"].values[0, 400]
    short["measured"][0, 400:] = np.nan
    together = all_modes.diagnose(short)
    alone = all_modes.diagnose(short.isel(run=[0]))
    np.testing.assert_allclose(chances(together)[0], chances(alone)[0], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(chances(together)[1:], chances(usual)[1:], rtol=1e-9, atol=1e-15)


def test_straight_lines_between_readings_are_no_evidence(twin, motions, all_modes):
    """Drawn out to the grid, with the true rate kept: the readings are where the lines meet."""
    lone = exact_runs.seen(twin, motions, first=7)
    assert_same(all_modes.diagnose(exact_runs.drawn_out(lone)), all_modes.diagnose(lone), 1e-6)


@given(
    seed=st.integers(0, 10**6),
    gaps=st.lists(st.tuples(st.floats(0.0, 9.0), st.floats(0.3, 4.0)), min_size=1, max_size=3),
)
@settings(max_examples=1)
def test_straight_lines_across_gaps_are_no_evidence(all_modes, runs, seed, gaps):
    """Of a sensor that flickers by a millimetre, whose readings stop anywhere; lines run on to both
    ends of the run, as if the first and the last reading were held."""
    path = runs["measured"].values.copy()
    path += np.random.default_rng(seed).normal(0.0, 0.001, path.shape)
    for begin, lasts in gaps:
        time = runs["time"].values
        path[:, (time > begin) & (time < begin + lasts)] = np.nan
    lone = runs.assign(measured=(runs["measured"].dims, path))
    expected, found = all_modes.diagnose(lone), all_modes.diagnose(exact_runs.drawn_out(lone))
    assert_same(found, expected, 1e-9)
    assert [d.quality for d in found] == [d.quality for d in expected]


def test_straight_lines_over_stalls_are_no_evidence(armpi, twin, known):
    """Whole counts, lost commands and silences of the bus, up to 6 s at a time. A tool at rest
    repeats itself to the last digit: readings missing there are taken to be there, and of a tool
    that has just come to rest, when the readings end, the last one counts more often."""
    units = replace(armpi.profile.servo_units, noise=0.0)
    quiet = replace(armpi, profile=replace(armpi.profile, servo_units=units))
    lone = simulate(Plan(quiet, paper_hypotheses(armpi.motor_names), 1, 5, known))
    lone = lone.isel(run=slice(None, None, 2))
    expected = BayesDiagnoser(twin).diagnose(lone)
    remarks = [[q for q in d.quality if "no readings from" in q] for d in expected]
    assert sum(map(bool, remarks)) > 1
    for held, atol in ((False, 1e-6), (True, 0.02)):
        found = BayesDiagnoser(twin).diagnose(exact_runs.drawn_out(lone, held=held))
        assert_same(found, expected, atol)
        assert remarks == [[q for q in d.quality if "no readings from" in q] for d in found]


def assert_same(found, expected, atol):
    np.testing.assert_allclose(chances(found), chances(expected), atol=atol)
    assert [d.diagnosis for d in found] == [d.diagnosis for d in expected]


@pytest.fixture(scope="module")
def settled(twin, runs):
    """What settled poses say at the usual rate."""
    return chances(BayesDiagnoser(twin, whole_run=False).diagnose(runs))


@pytest.mark.parametrize(("every", "grid"), [(1, 1), (40, 40)])
def test_more_readings_of_the_same_rest_make_no_surer(twin, motions, settled, every, grid):
    """5 to 200 Hz: a tool at rest is seen at one place, however often; the scatter of its motors
    is drawn once. Settled poses say the same at any rate; the way agrees with them."""
    runs = exact_runs.seen(twin, motions, every=every, grid=grid)
    got, expected = chances(BayesDiagnoser(twin, whole_run=False).diagnose(runs)), settled
    np.testing.assert_allclose(got, expected, atol=0.02)
    whole = BayesDiagnoser(twin).diagnose(runs)
    assert [d.diagnosis for d in whole] == truths(motions)


@pytest.mark.parametrize(
    ("seed", "kept", "whole_movements"), [(1, 0.05, False), (2, 0.3, False), (3, 0.6, True)]
)
def test_fewer_readings_mislead_nobody(twin, all_modes, runs, usual, seed, kept, whole_movements):
    """Readings that are lost take evidence away: what is said stays a probability, and nobody
    becomes sure of a fault that is not there, or of another than the one that is."""
    rng = np.random.default_rng(seed)
    measured = runs["measured"].values.copy()
    if whole_movements:
        gone = np.repeat(rng.random((len(measured), 6)) > kept, 203, axis=1)
        gone = gone[:, : measured.shape[1]]
    else:
        gone = rng.random(measured.shape[:2]) > kept
    measured[gone] = np.nan
    found = all_modes.diagnose(runs.assign(measured=(runs["measured"].dims, measured)))
    chance = chances(found)
    assert np.isfinite(chance).all()
    np.testing.assert_allclose(chance.sum(axis=1), 1.0, atol=1e-9)
    for d, before in zip(found, usual, strict=True):
        if d.undecided:
            continue
        truth = d.run.split("/")[0]
        motor = truth.split(":")[0]
        others = sum(
            p for h, p in d.posterior.items() if not h.startswith(motor) and h != "healthy"
        )
        was = sum(
            p for h, p in before.posterior.items() if not h.startswith(motor) and h != "healthy"
        )
        assert others < max(0.9, 1.5 * was)
