"""Evaluation from Python, on diagnoses whose scores can be worked out by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.runs import RunTable, Truth
from failuretwin.decision.evaluation import compare, evaluate
from failuretwin.decision.results import Record, read_results, write_json_lines

STUCK = "motor_1:stuck"


def told(run, stuck, truth=None, **more):
    """A diagnosis that gives `stuck` to a stuck motor and the rest to a healthy robot."""
    return Diagnosis(run, {"healthy": 1.0 - stuck, STUCK: stuck}, truth, **more)


FOUND = [
    told("a", 0.25, "healthy"),
    told("b", 0.75, STUCK, onset_90=(1.0, 2.0), magnitude_90=(0.1, 0.2)),
    told("c", 0.25, STUCK),
    told("d", 0.75, STUCK, undecided="the log is too short"),
]


@pytest.fixture
def runs():
    truth = Truth(
        fault=["healthy", STUCK, STUCK, STUCK],
        detail=[{}] * 4,
        onset=np.array([np.nan, 1.5, 0.0, 0.0]),
        magnitude=np.array([np.nan, 0.3, 0.1, 0.1]),
    )
    table = RunTable(
        run=list("abcd"),
        motor=["motor_1"],
        time=np.arange(5.0),
        command=np.zeros((4, 5, 1)),
        measured=np.zeros((4, 5, 3)),
        measured_rate_hz=1.0,
        truth=truth,
    )
    return table.to_dataset()


def test_diagnoses_are_evaluated_as_they_come():
    scores = evaluate(FOUND)
    assert (scores.scores.right, scores.scores.runs) == (2, 4)
    # the truth has 3/4 in three runs and 1/4 in one
    assert scores.scores.log_score == pytest.approx(-(3 * math.log(0.75) + math.log(0.25)) / 4)
    assert scores.brier == pytest.approx((3 * 0.125 + 1.125) / 4)
    assert (scores.alarms.missed.count, scores.alarms.missed.total) == (2, 3)
    assert scores.alarms.faulty_abstained == 1
    assert scores.calibration.equal.error == pytest.approx(0.75 - 2 / 3)
    assert scores.coverage == []
    assert scores.judged.protocol == "P0"


def test_a_run_set_knows_the_truth_and_what_intervals_should_hold(runs):
    blind = [told(d.run, d.posterior[STUCK], None, onset_90=d.onset_90) for d in FOUND]
    scores = evaluate(blind, runs)
    assert scores.scores.right == 3
    (onset,) = scores.coverage
    assert (onset.quantity, onset.mode, onset.inside.count, onset.inside.total) == (
        *("onset", "stuck", 1, 1),
    )


def test_the_same_is_said_of_what_was_written_and_read(tmp_path):
    write_json_lines(FOUND, tmp_path / "found.jsonl")
    stored = read_results(tmp_path / "found.jsonl")
    assert stored.diagnoses[1] == Record(
        run="b",
        posterior={"healthy": 0.25, STUCK: 0.75},
        diagnosis=STUCK,
        truth=STUCK,
        onset_90=(1.0, 2.0),
        magnitude_90=(0.1, 0.2),
        protocol="P0",
    )
    assert stored.diagnoses[3].diagnosis is None
    direct, again = evaluate(FOUND), evaluate(stored)
    assert again.brier == direct.brier
    np.testing.assert_array_equal(again.scores.confusion, direct.scores.confusion)
    np.testing.assert_array_equal(again.calibration.by_chance, direct.calibration.by_chance)


def test_two_methods_are_compared_run_by_run():
    sure = [told(d.run, 0.0 if d.truth == "healthy" else 1.0) for d in FOUND]
    found = compare(FOUND, sure[::-1])  # matched by name; the truth is that of the first
    assert (found.split.both, found.split.second_only, found.runs) == (2, 2, 4)
    assert found.gain.mean == pytest.approx(-(3 * math.log(0.75) + math.log(0.25)) / 4)
    assert found.as_unknown == (0, 0)


def test_what_cannot_be_judged_is_refused(runs):
    blind = [told(d.run, 0.5) for d in FOUND]
    for call in (lambda: evaluate(blind), lambda: compare(blind, blind)):
        with pytest.raises(InputError, match="no run says what was true"):
            call()
    with pytest.raises(InputError, match=r"a given twice\. Expected each run once"):
        evaluate([*FOUND, FOUND[0]])
    with pytest.raises(InputError, match=r"holds no run 'e' of the results\. Expected the runs"):
        evaluate([told("e", 0.5)], runs)
    with pytest.raises(InputError, match="the second results: lacks 1 runs of the first results"):
        compare(FOUND, FOUND[:3])
    with pytest.raises(InputError, match="does not know the truth"):
        evaluate(blind, runs.drop_vars("fault"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"posterior": [1.0]}, "posterior is [1.0], expected a table"),
        ({"posterior": {"healthy": "x"}}, "posterior.healthy is 'x', expected a number"),
        ({"diagnosis": "b"}, "`posterior` has no `diagnosis` 'b'. Expected a probability"),
        ({"posterior": {"healthy": 0.5}}, "`posterior` sums to 0.5. Expected probabilities"),
        ({"posterior": {"healthy": 2.0, STUCK: -1.0}}, "Expected probabilities within 0 to 1"),
        ({"truth": 0}, "truth is 0, expected text"),
        ({"onset_90": 1.0}, "onset_90 is 1.0, expected a list"),
        ({"onset_90": [1.0]}, "onset_90 is [1.0], expected 2 values"),
    ],
)
def test_a_line_that_is_no_diagnosis_is_named(tmp_path, change, words):
    good = {"run": "a", "diagnosis": "healthy", "posterior": {"healthy": 1.0}, "more": "ignored"}
    path = tmp_path / "x.jsonl"
    path.write_text(json.dumps(good) + "\n\n" + json.dumps({**good, "run": "b", **change}) + "\n")
    with pytest.raises(InputError) as error:
        read_results(path)
    assert str(error.value).startswith(f"{path}: line 3: ")
    assert words in str(error.value)
