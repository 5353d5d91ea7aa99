from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import xarray as xr

from failuretwin import BayesDiagnoser, DigitalTwin, SetupPrior
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import HEALTHY, Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference import prepared
from failuretwin.inference.faults import fault_sizes, stuck
from failuretwin.inference.faults.priors import Priors, priors_of
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence

PAPER = [str(h) for h in paper_hypotheses([f"motor_{k}" for k in range(1, 5)])]
COUNT = np.deg2rad(0.24)


def posteriors(diagnoses):
    return np.array([list(d.posterior.values()) for d in diagnoses])


def known(diagnoses, mode):
    """Return the rows of runs with a fault of this mode that were diagnosed right."""
    return [i for i, d in enumerate(diagnoses) if d.truth == d.diagnosis and mode in d.truth]


@pytest.fixture(scope="module")
def few(imperfect):
    """A run of each class, and a second of the first three."""
    return imperfect.isel(run=sorted([*range(0, 72, 8), 1, 9, 17]))


@pytest.fixture(scope="module")
def told_of_few(twin, few):
    return BayesDiagnoser(twin).diagnose(few)


@pytest.fixture(scope="module", params=[8, pytest.param(20, marks=pytest.mark.slow)])
def study(request, twin, armpi, imperfect, diagnoses):
    """Some runs of each class, and what is said of them."""
    if request.param == 8:
        return imperfect, diagnoses
    known = load_calibration("armpi_fpv", armpi).imperfections
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), request.param, 5, known))
    return runs, BayesDiagnoser(twin).diagnose(runs)


@pytest.fixture(scope="module")
def blind(few):
    """Some of them without a single reading."""
    return few.isel(run=[0, 3, 8]).assign(measured=np.nan * few["measured"])


@pytest.fixture(scope="module")
def told_of_blind(twin, blind):
    return BayesDiagnoser(twin).diagnose(blind)


def test_posteriors_are_probabilities_of_the_papers_classes(diagnoses):
    assert all(list(d.posterior) == PAPER for d in diagnoses)
    chance = posteriors(diagnoses)
    assert ((chance >= 0) & (chance <= 1)).all()
    np.testing.assert_allclose(chance.sum(axis=1), 1.0, rtol=0, atol=1e-12)


def test_imperfect_runs_are_diagnosed(study):
    runs, diagnoses = study
    right = sum(d.truth == d.diagnosis for d in diagnoses)
    assert len(diagnoses) == runs.sizes["run"]
    assert right >= 0.9 * len(diagnoses)


def test_runs_of_the_published_twin_are_diagnosed(twin, armpi):
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 1, 2))
    found = BayesDiagnoser(twin, priors=Priors(setup=SetupPrior.known())).diagnose(runs)
    assert sum(d.truth == d.diagnosis for d in found) >= 8


def test_command_and_measured_are_enough(twin, few, diagnoses):
    bare = xr.Dataset(
        {name: few[name][::4] for name in ("command", "measured")},
        attrs={"measured_rate_hz": few.attrs["measured_rate_hz"]},
    )
    found = BayesDiagnoser(twin).diagnose(bare)

    expected = {d.run: d for d in diagnoses}
    for diagnosis in found:  # movements begin where the corners of their commands are found
        known = dataclasses.replace(expected[diagnosis.run], truth=None)
        assert diagnosis.verdict == known.verdict
        assert diagnosis.posterior == pytest.approx(known.posterior, abs=1e-9)
        assert [e.nats for e in diagnosis.evidence] == pytest.approx(
            [e.nats for e in known.evidence], abs=1e-2
        )
        assert (diagnosis.truth, diagnosis.quality) == (None, known.quality)


def test_readings_of_motors_and_the_truth_change_nothing(twin, few, told_of_few):
    rng = np.random.default_rng(0)
    noise = {
        name: (("run", "time", "motor"), rng.normal(size=few["command"].shape))
        for name in ("position", "temperature", "voltage")
    }
    wrong = {n: few[n] + 1.0 for n in ("target", "ramp_duration", "movement_start", "magnitude")}
    lied = few["fault"].values[::-1].copy()
    scrambled = few.assign(noise | wrong | {"fault": ("run", lied)})
    before = scrambled.copy(deep=True)
    expected = [
        dataclasses.replace(d, truth=truth) for d, truth in zip(told_of_few, lied, strict=True)
    ]
    assert BayesDiagnoser(twin).diagnose(scrambled) == expected
    xr.testing.assert_identical(scrambled, before)


def test_a_run_is_judged_alone(monkeypatch, twin, few, told_of_few):
    rows = [0, 3, 8]
    some = few.isel(run=rows)
    backwards = BayesDiagnoser(twin).diagnose(some.isel(run=slice(None, None, -1)))
    twice = few.isel(run=[3, 3, 8]).assign_coords(run=["a", "b", "c"])
    again = BayesDiagnoser(twin).diagnose(twice)
    monkeypatch.setattr(prepared, "CHUNK_RUNS", 1)
    singly = BayesDiagnoser(twin).diagnose(some)

    expected = posteriors(told_of_few)
    np.testing.assert_allclose(posteriors(backwards)[::-1], expected[rows], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(posteriors(again), expected[[3, 3, 8]], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(posteriors(singly), expected[rows], rtol=1e-9, atol=1e-15)


def test_stuck_angle_is_found(study):
    runs, diagnoses = study
    rows = known(diagnoses, "stuck")
    truth = runs["magnitude"].values[rows]
    estimate = np.array([diagnoses[i].magnitude for i in rows])
    low, high = np.array([diagnoses[i].magnitude_90 for i in rows]).T

    assert len(rows) >= 0.39 * len(diagnoses)
    assert np.median(np.abs(estimate - truth)) < np.deg2rad(0.5)
    assert 0.86 < np.mean((low <= truth) & (truth <= high)) < 0.97  # reached: 29 of 32, 75 of 79
    assert np.median(high - low) < np.deg2rad(3)


def test_onset_of_a_stuck_motor_is_found(study):
    _, diagnoses = study
    rows = known(diagnoses, "stuck")
    onset = np.array([diagnoses[i].onset_s for i in rows])
    low, high = np.array([diagnoses[i].onset_90 for i in rows]).T
    assert np.median(np.abs(onset - 0.49)) < 0.1
    assert 0.88 < np.mean((low <= 0.49) & (high >= 0.49)) < 0.99  # reached: 29 of 32, 78 of 79
    assert ((low <= onset) & (onset <= high)).all()


def test_size_of_steady_state_errors_is_found(study):
    runs, diagnoses = study
    rows = known(diagnoses, "steady_state_error")
    truth = runs["magnitude"].values[rows]
    estimate = np.array([diagnoses[i].magnitude for i in rows])
    low, high = np.array([diagnoses[i].magnitude_90 for i in rows]).T

    assert len(rows) >= 0.39 * len(diagnoses)
    assert np.median(np.abs(estimate - truth)) < np.deg2rad(1)
    most = 0.89 if len(rows) < 40 else 0.87  # reached: 28 of 32, 66 of 80
    assert 0.78 < np.mean((low <= truth) & (truth <= high)) < most
    assert np.median(high - low) < np.deg2rad(3)


def test_healthy_runs_have_no_onset_and_no_size(diagnoses):
    healthy = [d for d in diagnoses if d.diagnosis == "healthy"]
    assert len(healthy) > 5
    for d in healthy:
        assert (d.onset_s, d.onset_90, d.magnitude, d.magnitude_unit, d.magnitude_90) == (None,) * 5


def test_method_and_protocol_say_what_was_used(diagnoses):
    assert {d.protocol for d in diagnoses} == {"P0c"}
    named = "bayes, whole run; healthy behaviour: armpi_fpv"
    another = "bayes, settled poses; healthy behaviour: generic, not calibrated"
    methods = [d.method for d in diagnoses]
    assert set(methods) <= {named, another}
    assert methods.count(named) > 0.9 * len(methods)


def test_without_evidence_nothing_is_learnt(told_of_blind):
    chance = posteriors(told_of_blind)
    np.testing.assert_allclose(chance, chance[[0] * len(chance)], rtol=1e-9)
    np.testing.assert_allclose(chance, 1 / 9, atol=0.01)


@pytest.mark.parametrize("onset_s", [None, 0.49, 3.0])
@pytest.mark.parametrize("motor", range(4))
def test_density_of_the_held_angle_has_area_one(twin, blind, motor, onset_s):
    """Where no movement says anything, integrating the prior of angle and onset gives one."""
    likelihood = RunLikelihood(settled_evidence(blind), BayesDiagnoser(twin).healthy_model)
    prior = priors_of(twin.robot, None, onset_s).onset
    mass = np.exp(stuck.stuck_model(likelihood, motor, prior).log_prior).sum(axis=(1, 2))
    np.testing.assert_allclose(mass, 1.0, rtol=0, atol=1e-9)


def test_without_evidence_the_verdict_is_that_nobody_can_tell(told_of_blind):
    for d in told_of_blind:
        assert d.verdict.startswith("cannot tell, because ")
        assert any(line.startswith("movement 1 not used: no reading") for line in d.quality)


def test_verdicts_say_what_was_found(diagnoses):
    for d in diagnoses:
        if d.verdict.startswith("cannot tell, because "):
            continue
        said = d.verdict.removeprefix("cannot tell yet; most probable: ")
        if d.diagnosis == "healthy":
            assert said.startswith("healthy, ")
        else:
            motor = d.diagnosis[: len("motor_1")].replace("_", " ")
            assert motor in d.verdict
            assert (
                f" {round(float(np.rad2deg(d.magnitude)))} deg" in d.verdict
                or "by about" in d.verdict
            )
        assert ("% sure" in d.verdict) == (d.state != "cannot tell") == (said == d.verdict)
        assert "100 %" not in d.verdict


@pytest.mark.parametrize("onset_s", [None, 0.49])
def test_finer_quadrature_changes_no_posterior(monkeypatch, twin, few, onset_s):
    priors = dataclasses.replace(priors_of(twin.robot, None, onset_s), setup=SetupPrior.known())
    diagnoser = BayesDiagnoser(twin, priors=priors)
    one_of_each = few.isel(run=[0, 3, 5, 7, 9, 11])
    coarse = posteriors(diagnoser.diagnose(one_of_each))
    monkeypatch.setattr(stuck, "COARSE_NODES", 601)
    monkeypatch.setattr(fault_sizes, "ERROR_NODES", 150)
    monkeypatch.setattr(prepared, "CHUNK_RUNS", 3)
    np.testing.assert_allclose(posteriors(diagnoser.diagnose(one_of_each)), coarse, atol=0.02)


def test_hypotheses_may_be_few(twin, few):
    """The fewer hypotheses, the more a wrong set-up explains: it is known here."""
    known = Priors(setup=SetupPrior.known())
    two = (HEALTHY, Hypothesis.parse("motor_3:stuck", twin.robot.motor_names))
    of_nine = BayesDiagnoser(twin, priors=known).diagnose(few)
    whole = posteriors(of_nine)
    found = BayesDiagnoser(twin, hypotheses=two, priors=known).diagnose(few)
    assert list(found[0].posterior) == ["healthy", "motor_3:stuck"]
    share = whole[:, [0, 3]] / whole[:, [0, 3]].sum(axis=1, keepdims=True)
    told = whole[:, [0, 3]].sum(axis=1) > 1e-5  # of two that are excluded only few rows are weighed
    assert told.sum() >= 4
    np.testing.assert_allclose(posteriors(found)[told], share[told], rtol=0, atol=2e-4)


def test_a_single_hypothesis_is_certain(twin, few):
    found = BayesDiagnoser(twin, hypotheses=(HEALTHY,)).diagnose(few.isel(run=[0, 1]))
    np.testing.assert_array_equal(posteriors(found), 1.0)
    assert {d.runner_up for d in found} == {None}


def test_known_onset_helps_and_is_reported(twin, imperfect, diagnoses):
    rows = [i for i, d in enumerate(diagnoses) if "stuck" in d.truth][::2]
    runs = imperfect.isel(run=rows)
    found = BayesDiagnoser(twin, priors=priors_of(twin.robot, None, 0.49)).diagnose(runs)

    def surprise(some):
        return -np.mean([np.log(d.posterior[d.truth]) for d in some])

    assert surprise(found) < surprise([diagnoses[i] for i in rows])
    right = [d for d in found if d.truth == d.diagnosis]
    assert len(right) >= 0.95 * len(rows)
    assert {round(d.onset_s, 6) for d in right} == {0.49}


def test_wrong_onset_misleads(twin, imperfect, diagnoses):
    """A motor that stood still from 0.49 s on hardly got stuck at 7 s: the onset is believed."""
    some = slice(8, 40, 2)
    priors = dataclasses.replace(priors_of(twin.robot, None, 7.0), setup=SetupPrior.known())
    late = BayesDiagnoser(twin, priors=priors).diagnose(imperfect.isel(run=some))
    right = sum(d.truth == d.diagnosis for d in late)
    assert right < 0.6 * len(known(diagnoses[some], "stuck"))


def test_ranges_of_errors_are_in_servo_units(armpi):
    each = ((5 * COUNT, 20 * COUNT),)
    expected = {"motor_1": each, "motor_2": each, "motor_3": each, "motor_4": each}
    assert priors_of(armpi, (5, 20), None).error_ranges == expected
    assert priors_of(armpi, None, 1.5).onset.known_s == 1.5
    assert priors_of(armpi, None, None) == Priors()


@pytest.mark.parametrize("counts", [(20, 5), (5, 5), (-1, 5), (np.nan, 5), (0, np.inf)])
def test_error_range_must_be_in_order(armpi, counts):
    with pytest.raises(InputError, match=r"--sse-range is .*, expected 0 <= LOW < HIGH"):
        priors_of(armpi, counts, None)


@pytest.mark.parametrize("onset_s", [-1.0, np.nan, np.inf])
def test_onset_must_be_a_time_of_the_run(armpi, onset_s):
    with pytest.raises(InputError, match=rf"--onset is {onset_s:g} s, expected 0 or more"):
        priors_of(armpi, None, onset_s)


@pytest.mark.parametrize(
    ("hypothesis", "message"),
    [
        ("motor_1:stuck+motor_2:stuck+motor_3:stuck", "has 3 faults. Expected 2 at most"),
        ("motor_1:lag+motor_2:stuck", r"'lag' cannot be weighed in .* Expected one of stuck, "),
    ],
)
def test_hypothesis_that_cannot_be_weighed_is_refused(twin, hypothesis, message):
    with pytest.raises(InputError, match=message):
        BayesDiagnoser(
            twin, hypotheses=(HEALTHY, Hypothesis.parse(hypothesis, twin.robot.motor_names))
        )


def test_hypotheses_may_be_given_as_text(twin):
    texts = ["healthy", "motor_3:stuck", "motor_1:stuck+motor_2:drift"]
    told = BayesDiagnoser(twin, hypotheses=texts)
    assert told.hypothesis_set == tuple(Hypothesis.parse(text) for text in texts)


@pytest.mark.parametrize(
    ("hypotheses", "message"),
    [
        (["motor_9:stuck"], "unknown motor 'motor_9'"),
        ([Hypothesis.parse("motor_9:stuck")], "unknown motor 'motor_9'"),
        (["stuck"], "not of the form MOTOR:MODE"),
        ("healthy,motor_1:stuck", "Expected a list"),
        ([], "no hypotheses given"),
        ([HEALTHY, "healthy"], "given twice"),
    ],
)
def test_hypotheses_that_cannot_be_read_are_refused(twin, hypotheses, message):
    with pytest.raises(InputError, match=message):
        BayesDiagnoser(twin, hypotheses=hypotheses)


def test_run_set_of_another_robot_is_refused(twin, few):
    other = few.assign_coords(motor=["hip", "knee", "ankle", "toe"])
    with pytest.raises(InputError, match=r"motors hip, knee, ankle, toe; robot 'armpi_fpv' has"):
        BayesDiagnoser(twin).diagnose(other)


def test_runs_without_a_movement_are_refused(twin, few):
    still = few.assign(command=0.0 * few["command"])
    with pytest.raises(InputError, match="no run holds a movement: `command` never leaves"):
        BayesDiagnoser(twin).diagnose(still)


def test_dataset_that_is_no_run_set_is_refused(twin, few):
    with pytest.raises(InputError, match="no variable `measured`"):
        BayesDiagnoser(twin).diagnose(few.drop_vars("measured"))


def test_robot_of_which_nothing_is_known_is_judged_with_wide_offsets(armpi, imperfect):
    unknown = dataclasses.replace(
        armpi, profile=dataclasses.replace(armpi.profile, imperfections=None)
    )
    assert load_calibration(None, unknown).imperfections.protocol == "P0"
    found = BayesDiagnoser(DigitalTwin(unknown)).diagnose(imperfect.isel(run=slice(1, None, 8)))
    assert {d.protocol for d in found} == {"P0"}
    assert "not calibrated" in found[0].method
    right = np.mean([d.truth == d.diagnosis for d in found])
    assert right > 0.85
