from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worn_robot import CALIBRATION, evidence_of, follow_all, fresh, truth

from failuretwin.connection.tracked_diagnosis import append_history, history_path, read_history
from failuretwin.connection.wear import RunEvidence, WearLimits
from failuretwin.core.errors import InputError, OutputError

RUNS = 90


@pytest.fixture(scope="module")
def evidence(armpi):
    return evidence_of(armpi, truth(RUNS), 0)


@pytest.fixture(scope="module")
def fault_probability():
    """Some doubtful runs, one without a verdict, and a fault that is declared and repaired."""
    chance = np.full(RUNS, 0.1)
    chance[[12, 30]] = 0.999, np.nan
    chance[50:58] = 0.999
    return chance


def written(path, start, evidence, fault_probability, pieces):
    """Follow runs in pieces, each with a tracker that knows the file alone."""
    first = 0
    for last in pieces:
        history = read_history(path, start)
        _, steps = follow_all(history.tracker, evidence[first:last], fault_probability[first:last])
        append_history(history, steps)
        first = last
    return path.read_bytes()


def assert_same(one, other):
    """Compare two trackers, bit for bit."""
    for name in ("cusum", "arrived", "learned_at", "alarm"):
        assert getattr(one, name) == getattr(other, name)
    states = zip((one.state, *one.past), (other.state, *other.past), strict=True)
    for mine, yours in states:
        np.testing.assert_array_equal(mine.mean, yours.mean)
        np.testing.assert_array_equal(mine.covariance, yours.covariance)
    for mine, yours in zip(one.window, other.window, strict=True):
        assert (mine.number, mine.open) == (yours.number, yours.open)
        assert (mine.evidence.run, mine.evidence.key) == (yours.evidence.run, yours.evidence.key)
        np.testing.assert_array_equal(mine.evidence.error, yours.evidence.error)
        np.testing.assert_array_equal(mine.evidence.design, yours.evidence.design)


@pytest.mark.parametrize("pieces", [[40, RUNS], [1, 26, 27, 51, 60, RUNS], [RUNS]])
def test_going_on_from_the_file_is_going_on(armpi, evidence, fault_probability, tmp_path, pieces):
    """The same file, byte for byte, and the same tracker as without a break."""
    start = fresh(armpi)
    through, steps = follow_all(start, evidence, fault_probability)
    append_history(read_history(tmp_path / "through.history.jsonl", start), steps)
    path = tmp_path / "pieces.history.jsonl"
    assert (
        written(path, start, evidence, fault_probability, pieces)
        == (tmp_path / "through.history.jsonl").read_bytes()
    )
    assert_same(read_history(path, start).tracker, through)


def test_a_line_a_run_with_its_name_state_and_deviations(
    armpi, evidence, fault_probability, tmp_path
):
    path = tmp_path / "cal.history.jsonl"
    written(path, fresh(armpi), evidence, fault_probability, [RUNS])
    head, *rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert head["history_of"] == "armpi_fpv"
    assert [row["run"] for row in rows] == [f"run {i}" for i in range(RUNS)]
    assert rows[30]["probability_faulty"] is None
    outcomes = dict(tuple(outcome) for row in rows for outcome in row["fates"])
    assert outcomes[1] == "learned"
    assert outcomes[13] == outcomes[31] == outcomes[55] == "discarded"
    variance = np.zeros((8, 8))
    variance[np.tril_indices(8)] = rows[-1]["covariance"]
    deviation = rows[-1]["bias_deviation"] + rows[-1]["compliance_deviation"]
    np.testing.assert_allclose(np.sqrt(np.diag(variance)), deviation)


def test_the_history_lies_beside_the_calibration():
    assert history_path(Path("a/cal.toml")) == Path("a/cal.history.jsonl")


def test_where_there_is_none_it_begins(armpi, tmp_path):
    start = fresh(armpi)
    history = read_history(tmp_path / "cal.history.jsonl", start)
    assert (history.tracker, history.steps) == (start, ())


def test_a_line_cut_anywhere_is_a_shorter_history(armpi, evidence, fault_probability, tmp_path):
    """Whatever a killed writer leaves: read as far as it goes, and the next one goes on."""
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    whole = written(path, start, evidence, fault_probability, [RUNS])
    ends = np.flatnonzero(np.frombuffer(whole, np.uint8) == ord("\n"))
    rng = np.random.default_rng(0)
    for cut in [1, ends[0], ends[0] + 1, *rng.integers(ends[0], len(whole), 12), len(whole) - 1]:
        path.write_bytes(whole[:cut])
        history = read_history(path, start)
        complete = int(np.sum(ends < cut))
        assert len(history.steps) == max(complete - 1, 0)
        done = len(history.steps)
        _, steps = follow_all(history.tracker, evidence[done:], fault_probability[done:])
        append_history(history, steps)
        assert path.read_bytes() == whole


WRITER = """
import sys
from pathlib import Path
import numpy as np
from failuretwin import load_robot
from worn_robot import evidence_of, follow_all, fresh, truth
from failuretwin.connection.tracked_diagnosis import append_history, read_history
robot = load_robot("armpi_fpv")
start = fresh(robot)
evidence = evidence_of(robot, truth(90), 0)
print("ready", flush=True)
while True:
    for run in evidence:
        history = read_history(Path(sys.argv[1]), start)
        _, steps = follow_all(history.tracker, [run])
        append_history(history, steps)
"""


def test_a_writer_that_is_killed_does_no_harm(armpi, evidence, tmp_path):
    path = tmp_path / "cal.history.jsonl"
    folders = [str(Path(__file__).parent), *sys.path]
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
    )
    with writer:
        assert writer.stdout.readline() == b"ready\n"
        while not path.exists() or path.stat().st_size < 20_000:
            assert writer.poll() is None
            time.sleep(0.001)
        writer.send_signal(signal.SIGKILL)
    history = read_history(path, fresh(armpi))
    assert history.steps
    expected, _ = follow_all(fresh(armpi), [evidence[i % RUNS] for i in range(len(history.steps))])
    assert_same(history.tracker, expected)


def test_a_run_that_says_nothing_is_kept_too(armpi, tmp_path):
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    empty = RunEvidence("empty", "key", np.zeros((0, 3)), np.zeros((0, 3, 8)))
    _, steps = follow_all(start, [empty])
    append_history(read_history(path, start), steps)
    history = read_history(path, start)
    assert history.steps[0].outcomes == ((1, "discarded"),)
    assert history.keys == {"key"}


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda lines: [lines[0], lines[1], "{", *lines[3:]], "line 3: is damaged"),
        (lambda lines: [lines[0], "[1]", *lines[2:]], "line 2: is damaged"),
        (lambda lines: [lines[0], '{"number": 1}', *lines[2:]], "line 2: is damaged"),
        (lambda lines: lines[1:], "no history of a calibration"),
        (lambda lines: ["\x00\xff", *lines[1:]], "line 1: is damaged"),
    ],
)
def test_damage_is_named(armpi, evidence, fault_probability, tmp_path, spoil, told):
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    lines = written(path, start, evidence, fault_probability, [5]).decode().splitlines()
    path.write_text("".join(f"{line}\n" for line in spoil(lines)), encoding="latin-1")
    with pytest.raises(InputError, match=told):
        read_history(path, start)


@pytest.mark.parametrize("what", ["settling", "doubt", "limits"])
def test_a_history_of_another_calibration_is_refused(
    armpi, evidence, fault_probability, tmp_path, what
):
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    written(path, start, evidence, fault_probability, [3])
    settling = replace(CALIBRATION.settling, bias=(0.0,) * 4)
    other = {
        "settling": fresh(armpi, replace(CALIBRATION, settling=settling)),
        "doubt": fresh(armpi, replace(CALIBRATION, variation=None)),
        "limits": fresh(armpi, limits=WearLimits(rate=0.1)),
    }[what]
    with pytest.raises(InputError, match="history of another calibration"):
        read_history(path, other)


def test_two_at_a_time_are_refused(armpi, evidence, fault_probability, tmp_path):
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    late = read_history(path, start)
    before = written(path, start, evidence, fault_probability, [3])
    _, steps = follow_all(late.tracker, evidence[:2])
    with pytest.raises(OutputError, match="has changed since it was read"):
        append_history(late, steps)
    assert path.read_bytes() == before


def test_a_full_disk_leaves_the_history_as_it_was(
    armpi, evidence, fault_probability, tmp_path, monkeypatch
):
    path, start = tmp_path / "cal.history.jsonl", fresh(armpi)
    before = written(path, start, evidence, fault_probability, [3])
    history, write = read_history(path, start), os.write

    def some(descriptor, text):
        if os.fstat(descriptor).st_size > len(before):
            raise OSError(28, "No space left on device")
        return write(descriptor, text[:100])

    monkeypatch.setattr(os, "write", some)
    _, steps = follow_all(history.tracker, evidence[3:5])
    with pytest.raises(OutputError, match="No space left on device"):
        append_history(history, steps)
    assert path.read_bytes() == before
