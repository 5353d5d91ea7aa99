"""One robot as a stream: long operation, repairs, dead sensors, saved states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, DigitalTwin, Plan, load_robot
from failuretwin.connection.links.base import OK, STALE
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import simulate
from failuretwin.decision.streaming.diagnoser import (
    StreamingDiagnoser,
)
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS

PERIOD_S = 2.04
STEP_S = 0.1


def rows_of(answers):
    """Return the time of each answer and the probabilities of healthy and of motor 2 stuck."""
    rows = []
    for answer in answers:
        if answer.diagnosis is not None:
            posterior = answer.diagnosis.posterior
            rows.append((answer.time, posterior["healthy"], posterior["motor_2:stuck"]))
    return np.array(rows)


def delay(rows, first):
    """Return the time from the onset until it is sure [s]; before it no fault is probable."""
    onset = 0.5 + PERIOD_S * first
    assert (rows[rows[:, 0] < onset, 1] > 0.5).all()
    return rows[(rows[:, 2] > 0.9) & (rows[:, 0] > onset), 0][0] - onset


def test_a_late_fault_is_found_as_fast_as_an_early_one(told_of_repaired, watcher, work):
    """The movements after the onset, until it is sure, are as few after 12 as after 6."""
    early = delay(rows_of(told_of_repaired), 6)
    late = delay(rows_of(watcher.update(*s) for s in work(16, stuck=[(1, 12, 16)])), 12)
    assert late < early + 1.5 * PERIOD_S
    assert max(late, early) < 4 * PERIOD_S


def test_a_repaired_robot_becomes_healthy_again(told_of_repaired):
    rows = rows_of(told_of_repaired)
    repaired = 0.5 + PERIOD_S * 12
    assert rows[rows[:, 0] < repaired, 2].max() > 0.9
    after = rows[rows[:, 0] > repaired + 5.5 * PERIOD_S]
    assert (after[:, 1] > 0.9).all()


def test_the_onset_of_an_old_fault_stands(watcher, work):
    diagnoser, samples = watcher, work(8, stuck=[(1, 3, 8)])
    for sample in samples:
        answer = diagnoser.update(*sample)
    assert answer.diagnosis.diagnosis == "motor_2:stuck"
    low, high = answer.diagnosis.onset_90
    onset = 0.5 + PERIOD_S * 3
    assert low - PERIOD_S < onset < high + PERIOD_S
    assert f"since {answer.diagnosis.onset_s:.1f} s" in answer.diagnosis.verdict
    assert answer.diagnosis.evidence[-1].movement == 8


def test_silence_is_stale_and_what_was_known_is_kept(watcher, work):
    diagnoser = watcher
    for sample in work(6):
        answer = diagnoser.update(*sample)
    assert answer.state == OK
    silent = diagnoser.update(answer.time + 5.2, None, None)
    assert silent.state == STALE
    assert silent.diagnosis is answer.diagnosis
    assert diagnoser.update(answer.time + 5.3, None, sample[2]).state == OK


def test_a_frozen_sensor_is_never_healthy_and_believed_again_when_it_comes_back(watcher, work):
    samples = work(13)
    for time, command, point in samples:
        answer = watcher.update(time, command, samples[60][2] if 6.0 < time < 12.0 else point)
        if time < 12.0:
            last = answer
    assert last.diagnosis.undecided.startswith("the tool stands still")
    assert last.diagnosis.posterior["healthy"] < 0.8  # the prior of who watches
    assert last.diagnosis.probability is None
    assert answer.diagnosis.diagnosis == "healthy"
    assert answer.diagnosis.probability > 0.9


def test_commands_may_be_given_by_name(twin, work):
    samples, names = work(4), twin.robot.motor_names
    by_array, by_name = (monitor(twin, NO_IMPERFECTIONS) for _ in range(2))
    for time, command, point in samples:
        one = by_array.update(time, command, point)
        two = by_name.update(time, dict(zip(names, command.tolist(), strict=True)), point)
    assert one.diagnosis == two.diagnosis
    with pytest.raises(InputError, match="motor_4"):
        by_name.update(99.0, dict.fromkeys(names[:3], 0.0), None)


def test_a_saved_stream_goes_on_as_if_nothing_had_happened(twin, work, tmp_path):
    samples, path = work(8, stuck=[(2, 4, 8)]), tmp_path / "stream.npz"
    method = BayesDiagnoser(twin)
    one, first = StreamingDiagnoser(method), StreamingDiagnoser(method)
    middle = len(samples) // 2
    for sample in samples[:middle]:
        one.update(*sample)
        first.update(*sample)
    first.save(path)
    other = StreamingDiagnoser.load(path, method)
    answers = [(one.update(*s), other.update(*s)) for s in samples[middle:]]
    for expected, answer in [*answers, (one.conclude(), other.conclude())]:
        assert answer.time == expected.time and answer.state == expected.state
        found, wanted = answer.diagnosis, expected.diagnosis
        assert found.verdict == wanted.verdict
        assert found.posterior == pytest.approx(wanted.posterior, abs=1e-4)


def test_a_stream_can_be_saved_before_it_has_seen_anything(twin, tmp_path):
    path, method = tmp_path / "stream.npz", BayesDiagnoser(twin)
    StreamingDiagnoser(method, 10.0, 3).save(path)
    fleet = StreamingDiagnoser.load(path, method)._fleet
    assert (fleet.rate_hz, fleet.movements) == (10.0, 3)


@pytest.mark.parametrize("spoil", ["other method", "no file", "other file", "suffix"])
def test_what_is_no_saved_stream_is_refused(twin, tmp_path, spoil):
    path, method = tmp_path / "stream.npz", BayesDiagnoser(twin)
    StreamingDiagnoser(method).save(path)
    if spoil == "other method":
        with pytest.raises(InputError, match="calibration"):
            StreamingDiagnoser.load(path, BayesDiagnoser(twin, whole_run=False))
    elif spoil == "suffix":
        with pytest.raises(InputError, match="npz"):
            StreamingDiagnoser(method).save(tmp_path / "stream.bin")
    else:
        if spoil == "no file":
            path.unlink()
        else:
            path.write_bytes(b"something else")
        with pytest.raises(InputError, match="cannot be read"):
            StreamingDiagnoser.load(path, method)


@pytest.mark.parametrize("noise", [1e-8, 3e-6])
def test_references_may_be_noisy(watcher, work, rng, noise):
    for time, command, point in work(6):
        answer = watcher.update(time, command + rng.normal(0.0, noise, 4), point)
    assert answer.diagnosis.diagnosis == "healthy"
    assert answer.diagnosis.probability > 0.9


def test_clocks_may_count_from_1970(watcher, work):
    """Stamps that large are exact to a quarter of a microsecond only."""
    time = 1.7e9
    for _, command, point in work(6):
        answer = watcher.update(time, command, point)
        time += STEP_S
    assert answer.time == pytest.approx(time - STEP_S)
    assert answer.diagnosis.diagnosis == "healthy"
    assert answer.diagnosis.probability > 0.9


def test_a_sample_from_long_ago_is_refused(watcher, work):
    for sample in work(3):
        watcher.update(*sample)
    watcher.update(3600.0, None, None)
    with pytest.raises(InputError, match="begin a new stream"):
        watcher.update(8.0, None, [0.1, 0.1, 0.1])


@pytest.mark.parametrize("step", [31.0, 3600.0])
def test_samples_far_apart_tell_of_no_movement(watcher, rng, step):
    for k in range(5):
        answer = watcher.update(step * k, rng.uniform(-0.5, 0.5, 4), [0.1, 0.1, 0.2])
    assert answer.diagnosis is None
    assert watcher.conclude().diagnosis is None


def test_between_two_judgements_nothing_said_changes(twin, work):
    """A fleet can be asked at any time, also while a movement is under way."""
    fleet = StreamingFleet(BayesDiagnoser(twin, NO_IMPERFECTIONS, whole_run=False), 1)
    said = None
    for time, command, point in work(6, stuck=[(1, 2, 6)]):
        changed = fleet.update(time, command[None], point[None])
        found = fleet.diagnosis(0)
        if said is not None and not len(changed):
            assert found == said
        said = found
    assert said.diagnosis == "motor_2:stuck"


@pytest.mark.parametrize("kwargs", [{"robots": 0}, {"robots": 1, "movements": 0},
                                    {"robots": 1, "rate_hz": 0.0}])  # fmt: skip
def test_a_stream_of_nothing_is_refused(twin, kwargs):
    with pytest.raises(InputError, match="Expected one"):
        StreamingFleet(BayesDiagnoser(twin), **kwargs)


@pytest.mark.parametrize(("name", "rate_hz"), [("ur5e", 10.0), ("so101", 100.0)])
def test_other_arms_are_streamed_as_they_are_recorded(name, rate_hz):
    robot = load_robot(name)
    hypotheses = paper_hypotheses(robot.motor_names)
    generic = load_calibration("none", robot).imperfections
    known = replace(generic, variation=None)  # what is doubted of a robot, streams count as scatter
    runs = simulate(Plan(robot, hypotheses, 1, 3, generic)).isel(run=[0, 2])
    method = BayesDiagnoser(DigitalTwin(robot), known, whole_run=False)
    fleet = StreamingFleet(method, 2, rate_hz)
    every = round(1.0 / (rate_hz * 0.01))
    points = runs["measured"].values
    points[:, np.arange(points.shape[1]) % every != 0] = np.nan
    for i, time in enumerate(runs["time"].values):
        fleet.update(time, runs["command"].values[:, i], points[:, i])
    fleet.conclude()
    thinned = runs.assign(measured=(runs["measured"].dims, points))
    thinned.attrs["measured_rate_hz"] = rate_hz
    expected = [list(d.posterior.values()) for d in method.diagnose(thinned)]
    np.testing.assert_allclose(fleet.posterior, expected, rtol=0.0, atol=1e-9)
