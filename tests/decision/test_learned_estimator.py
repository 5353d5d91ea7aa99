from __future__ import annotations

import copy
import itertools
from contextlib import closing

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import cross_val_score
from sklearn.utils.estimator_checks import parametrize_with_checks

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision import training_data as stream_module
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser, best_temperature
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, expectation_of, signals_of
from failuretwin.decision.learned.networks import Standard
from failuretwin.decision.training_data import CHUNK_RUNS, Stream, TrainingData
from user_modes import code_on_the_page, registered_from


@parametrize_with_checks([LearnedDiagnoser(iterations=60, learning_rate=5e-3, random_state=0)])
def test_it_is_an_estimator(estimator, check):
    check(estimator)


@pytest.fixture(scope="module")
def encoder(armpi, measured_armpi):
    return FeatureEncoder("robust", armpi, expectation_of(armpi, measured_armpi))


@pytest.fixture(scope="module")
def runs(armpi, measured_armpi):
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 30, 2, measured_armpi))


@pytest.fixture(scope="module")
def trained(encoder, runs):
    return LearnedDiagnoser("cnn", encoder, iterations=100, random_state=0).fit(runs)


def test_stuck_motors_are_soon_learned(armpi, measured_armpi, trained):
    stuck = paper_hypotheses(armpi.motor_names)[1:5]
    others = simulate(Plan(armpi, stuck, 10, 99, measured_armpi))
    assert np.mean(trained.predict(others) == others["fault"].values) > 0.5  # chance: 0.11


def test_diagnoses_are_those_of_the_contract(runs, trained):
    diagnoses = trained.diagnose(runs)
    chances = trained.predict_proba(runs)
    for diagnosis, chance in zip(diagnoses, chances, strict=True):
        assert sum(diagnosis.posterior.values()) == pytest.approx(1.0)
        assert diagnosis.posterior[diagnosis.diagnosis] == pytest.approx(chance.max())
        assert diagnosis.protocol == "P0c"
        assert diagnosis.onset_s is None
        assert "most probable" in diagnosis.verdict or "sure" in diagnosis.verdict
    assert [d.truth for d in diagnoses] == list(runs["fault"].values)
    assert "healthy behaviour" in diagnoses[0].method


def test_it_works_from_commands_and_tool_path_alone(runs, trained):
    bare = runs[["command", "measured", "duration"]]
    for one, other in zip(trained.diagnose(bare), trained.diagnose(runs), strict=True):
        assert one.truth is None
        assert one.posterior == other.posterior


def test_a_log_without_readings_gets_no_verdict(runs, trained):
    silent = runs.isel(run=[0]).copy(deep=True)
    silent["measured"].values[:] = np.nan
    (diagnosis,) = trained.diagnose(silent)
    assert diagnosis.diagnosis is None
    assert "cannot tell" in diagnosis.verdict
    assert set(diagnosis.posterior.values()) == {1 / 9}


def test_runs_of_an_unknown_kind_are_told(runs, trained):
    """Half of the movements: the network says something, and that it means little."""
    short = runs.isel(run=[0], time=slice(0, 450))[["command", "measured"]]
    (diagnosis,) = trained.diagnose(short)
    assert any("learned from runs of 5" in remark for remark in diagnosis.quality)
    (whole,) = trained.diagnose(runs.isel(run=[0]))
    assert not any("learned from" in remark for remark in whole.quality)


def test_run_sets_need_an_encoder(runs):
    with pytest.raises(InputError, match="takes arrays"):
        LearnedDiagnoser(iterations=1).fit(runs)


def test_it_can_be_cloned_and_cross_validated(encoder, runs, trained):
    fresh = clone(trained)
    assert fresh.get_params()["network"] == "cnn"
    assert not hasattr(fresh, "network_")
    features = encoder.encode(signals_of(runs))
    quick = LearnedDiagnoser("cnn", iterations=20, random_state=0)
    scores = cross_val_score(quick, features, runs["fault"].values, cv=2)
    assert len(scores) == 2
    assert np.all((scores >= 0.0) & (scores <= 1.0))


def test_the_share_of_right_ones_is_that_of_the_truth_in_the_run_set(runs, trained):
    right = np.mean(trained.predict(runs) == runs["fault"].values)
    assert trained.score(runs) == pytest.approx(right)


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"batch_runs": 0}])
def test_learning_from_nothing_is_refused(encoder, runs, wrong):
    with pytest.raises(InputError, match="Expected one at least"):
        LearnedDiagnoser("cnn", encoder, **wrong).fit(runs)


def test_features_of_another_kind_are_refused(armpi, runs, trained):
    with pytest.raises(InputError, match="7 channels"):
        trained.predict_proba(np.zeros((2, 100, 7), dtype=np.float32))


def test_temperature_of_scores_that_are_too_sure():
    """Scores three times the logs of honest chances need a temperature of three."""
    rng = np.random.default_rng(0)
    chances = rng.dirichlet([0.5] * 4, 4000)
    truth = np.array([rng.choice(4, p=p) for p in chances])
    assert best_temperature(3.0 * np.log(chances + 1e-12), truth) == pytest.approx(3.0, rel=0.1)


def test_calibration_changes_no_verdict(runs, trained):
    before = trained.predict(runs)
    other = copy.deepcopy(trained).calibrate(runs)
    assert other.temperature_ != trained.temperature_
    np.testing.assert_array_equal(other.predict(runs), before)
    truth = runs["fault"].values
    place = [list(other.classes_).index(t) for t in truth]
    nats = [
        -np.log(d.predict_proba(runs)[np.arange(len(truth)), place]).mean()
        for d in (trained, other)
    ]
    assert nats[1] <= nats[0] + 1e-9


def test_calibration_on_unknown_classes_is_refused(runs, trained):
    with pytest.raises(InputError, match="does not know motor_9:stuck"):
        trained.calibrate(runs, ["motor_9:stuck"] * runs.sizes["run"])


@pytest.fixture(scope="module")
def stream(armpi, measured_armpi, encoder):
    return Stream(TrainingData(armpi, measured_armpi, 3), encoder, batch_runs=32, uses=2)


def counted_chunks(count):
    """Chunks whose features are the numbers of their runs."""
    for number in range(count):
        first = number * CHUNK_RUNS
        numbers = np.arange(first, first + CHUNK_RUNS)
        yield numbers.astype(np.float32)[:, None, None], numbers


def test_every_run_is_used_as_often_as_asked(stream):
    seen = np.concatenate([classes for _, classes in stream.batches(counted_chunks(5))])
    times = np.bincount(seen, minlength=5 * CHUNK_RUNS).reshape(5, CHUNK_RUNS).sum(axis=1)
    np.testing.assert_array_equal(times / CHUNK_RUNS, [2.0, 2.0, 2.0, 2.0, 1.0])


def test_fresh_runs_come_from_other_processes_in_order(
    armpi, measured_armpi, encoder, monkeypatch, tmp_path
):
    """Runs of a mode that a user has registered, too."""
    monkeypatch.setattr(stream_module, "CHUNK_RUNS", 24)
    with registered_from(code_on_the_page(), tmp_path, "shaft_to_learn"):
        states = parse_hypotheses(["healthy", "motor_2:bent_shaft"], armpi.motor_names)
        recipe = TrainingData(armpi, measured_armpi, 3, hypotheses=states)
        with closing(Stream(recipe, encoder, batch_runs=12).chunks()) as chunks:
            streamed = list(itertools.islice(chunks, 2))
        expected = [recipe.chunk(number, 24, encoder) for number in range(2)]
    for (features, classes), (same_features, same_classes) in zip(streamed, expected, strict=True):
        np.testing.assert_array_equal(features, same_features)
        np.testing.assert_array_equal(classes, same_classes)
        assert set(classes) == {0, 1}


def test_learning_from_a_stream_is_repeatable(stream, encoder, runs, monkeypatch):
    monkeypatch.setattr(stream_module, "CHUNK_RUNS", 64)
    names = [str(h) for h in stream.data.hypotheses]
    chunk = stream.data.chunk(0, 64, encoder)

    def learn():
        diagnoser = LearnedDiagnoser("cnn", encoder, iterations=5, random_state=1)
        batches = stream.batches(itertools.repeat(chunk))
        return diagnoser.fit_batches(batches, Standard.of(chunk[0]), names, (5, 5))

    first, second = learn(), learn()
    np.testing.assert_array_equal(first.predict_proba(runs), second.predict_proba(runs))
    assert list(first.classes_) == names
