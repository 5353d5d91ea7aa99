from __future__ import annotations

import json

from failuretwin.core.hypothesis import Diagnosis

POSTERIOR = {"healthy": 0.2, "motor_3:stuck": 0.7, "unknown": 0.1}


def test_the_most_probable_hypothesis_is_the_diagnosis():
    diagnosis = Diagnosis("run 1", POSTERIOR)

    assert diagnosis.ranked == ["motor_3:stuck", "healthy", "unknown"]
    assert diagnosis.diagnosis == "motor_3:stuck"
    assert diagnosis.probability == 0.7
    assert diagnosis.runner_up == "healthy"


def test_a_single_hypothesis_has_no_runner_up():
    assert Diagnosis("run 1", {"healthy": 1.0}).runner_up is None


def test_record_is_the_contract():
    record = Diagnosis("run 1", POSTERIOR, onset_s=0.5, onset_90=(0.4, 0.6)).to_record()

    assert json.loads(json.dumps(record)) == {
        "run": "run 1",
        "truth": None,
        "diagnosis": "motor_3:stuck",
        "probability": 0.7,
        "state": "cannot tell",
        "posterior": POSTERIOR,
        "runner_up": "healthy",
        "onset_s": 0.5,
        "onset_90": [0.4, 0.6],
        "magnitude": None,
        "magnitude_unit": None,
        "magnitude_90": None,
        "verdict": "",
        "explanation": [],
        "evidence": [],
        "quality": [],
        "protocol": "P0",
        "method": "",
    }
