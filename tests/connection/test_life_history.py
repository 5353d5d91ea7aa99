"""Files of a robot's life: going on from them is going on, and nothing half-written counts."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worn_robot import CALIBRATION, life, seen, truth

from executed import command_line
from failuretwin.connection.tracked_diagnosis import (
    History,
    history_path,
    keep_history,
    open_history,
)
from failuretwin.core.errors import InputError, OutputError
from failuretwin.inference.together.wear_limits import WearLimits
from full_disks import full_disk

RUNS = 9


@pytest.fixture(scope="module")
def evidence(armpi):
    return seen(armpi, truth(RUNS), 3)


@pytest.fixture
def calibration(tmp_path):
    return tmp_path / "cal.toml"


def row(number):
    return {"number": number, "run": f"run {number}", "key": f"key {number}"}


def go_on(robot, calibration, evidence, runs):
    """Judge some runs with what the files hold, and keep that."""
    history = open_history(calibration, life(robot), cold=False)
    found = history.life
    found.follow(evidence[runs])
    keep_history(history, found, [row(i + 1) for i in range(runs.start, runs.stop)])
    return found


def same(one, other):
    there, here = one.to_arrays(), other.to_arrays()
    assert there.keys() == here.keys()
    for name, array in there.items():
        np.testing.assert_array_equal(array, here[name], err_msg=name)


def test_going_on_from_the_files_is_going_on(armpi, evidence, calibration):
    straight = life(armpi)
    for runs in (slice(0, 3), slice(3, 7), slice(7, 9)):
        straight.follow(evidence[runs])
        kept = go_on(armpi, calibration, evidence, runs)
    same(straight, kept)
    history = open_history(calibration, life(armpi), cold=False)
    same(straight, history.life)
    assert history.keys == tuple(f"key {i}" for i in range(1, RUNS + 1))
    lines = history_path(calibration).read_text().splitlines()
    assert len(lines) == RUNS + 1


def test_other_hypotheses_may_go_on(armpi, evidence, calibration):
    go_on(armpi, calibration, evidence, slice(0, 4))
    more = open_history(calibration, life(armpi, ("healthy", "motor_2:stuck")), cold=False).life
    assert more.follow(evidence[4:6]).log_posterior.shape == (2, 2)


def test_lines_that_no_state_counts_are_overlooked(armpi, evidence, calibration):
    """As a writer leaves them that is killed after the lines and before the state."""
    go_on(armpi, calibration, evidence, slice(0, 3))
    path = history_path(calibration)
    before = path.read_bytes()
    path.write_bytes(before + b'{"number": 4, "run": "r"')
    go_on(armpi, calibration, evidence, slice(3, 5))
    assert path.read_bytes().startswith(before)
    assert open_history(calibration, life(armpi), cold=False).keys[-1] == "key 5"


WRITER = """
import sys
from pathlib import Path
from failuretwin import load_robot
sys.path[:0] = sys.argv[2:]
from test_life_history import go_on, seen, truth
robot = load_robot("armpi_fpv")
evidence = seen(robot, truth(4), 3)
print("ready", flush=True)
while True:
    go_on(robot, Path(sys.argv[1]), evidence, slice(0, 1))
"""


def test_a_writer_that_is_killed_does_no_harm(armpi, calibration):
    here = Path(__file__).parent
    folders = here, here.parent, here.parents[1] / "docs"
    writer = command_line().begin(calibration, *folders, code=WRITER)
    path = history_path(calibration)
    with writer:
        assert writer.stdout.readline() == "ready\n"
        while not path.exists() or path.read_bytes().count(b"\n") < 4:
            assert writer.poll() is None
            time.sleep(0.001)
        writer.send_signal(signal.SIGKILL)
    history = open_history(calibration, life(armpi), cold=False)
    assert history.life.arrived == len(history.keys) >= 2


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda text: text.replace(b'{"number": 2', b'["number": 2'),
            "line 3: cannot be read",
        ),
        (lambda text: text[:-30], "is shorter than it was"),
        (lambda text: text.replace(b"history_of", b"story_of__"), "no history of a calibration"),
        (lambda text: b"\xff" + text[1:], "It is damaged"),
    ],
)
def test_damage_is_named(armpi, evidence, calibration, spoil, told):
    go_on(armpi, calibration, evidence, slice(0, 5))
    path = history_path(calibration)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=told):
        open_history(calibration, life(armpi), cold=False)


def test_a_state_of_another_version_is_named(armpi, evidence, calibration):
    go_on(armpi, calibration, evidence, slice(0, 5))
    state = history_path(calibration).with_suffix(".npz")
    with np.load(state) as stored:
        np.savez(state, **{name: stored[name] for name in stored.files if name != "seen/begin"})
    with pytest.raises(InputError, match="'seen/begin'; another version of failuretwin kept it"):
        open_history(calibration, life(armpi), cold=False)


@pytest.mark.parametrize("what", ["settling", "doubt", "limits"])
def test_a_history_of_another_calibration_is_refused(armpi, evidence, calibration, what):
    go_on(armpi, calibration, evidence, slice(0, 2))
    settling = replace(CALIBRATION.settling, bias=(0.0,) * 4)
    doubt = replace(CALIBRATION.variation, bias=(0.002,) * 4)
    other = {
        "settling": life(armpi, calibration=replace(CALIBRATION, settling=settling)),
        "doubt": life(armpi, calibration=replace(CALIBRATION, variation=doubt)),
        "limits": life(armpi, limits=WearLimits(rate=0.1)),
    }[what]
    with pytest.raises(InputError, match="history of another calibration"):
        open_history(calibration, other, cold=False)


def test_two_at_a_time_are_refused(armpi, evidence, calibration):
    late = open_history(calibration, life(armpi), cold=False)
    go_on(armpi, calibration, evidence, slice(0, 2))
    before = history_path(calibration).read_bytes()
    with pytest.raises(OutputError, match="has changed since it was read"):
        keep_history(late, late.life, [row(1)])
    assert history_path(calibration).read_bytes() == before


def test_a_full_disk_leaves_the_history_as_it_was(armpi, evidence, calibration):
    go_on(armpi, calibration, evidence, slice(0, 2))
    path = history_path(calibration)
    before = path.read_bytes()
    with full_disk(len(before) + 20), pytest.raises(OutputError, match="File too large"):
        go_on(armpi, calibration, evidence, slice(2, 4))
    assert path.read_bytes() == before


def test_nothing_is_kept_where_no_file_is_named(armpi, tmp_path):
    keep_history(History(life(armpi), cold=True), life(armpi), [row(1)])
    assert list(tmp_path.iterdir()) == []
