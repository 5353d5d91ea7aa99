"""Work of `watch`, `check`, `act` and `import` in a store, and robots followed day by day."""

from __future__ import annotations

import io
import json
import os
import shutil
import sqlite3
import threading
import time
from contextlib import closing, suppress

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.app.keepers import begin_watch
from failuretwin.app.remembering import RobotRecord
from failuretwin.app.shadow import Change, Snapshot
from failuretwin.connection.links.base import OK, Answer
from failuretwin.connection.tracked_diagnosis import read_rows
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import ALL_CLEAR, RAISED, Alarm
from failuretwin.data_knowledge.records.schema import Basis
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from store_places import diagnosis

NAME = ("--robot-name", "arm_7")
FAULT = ("--fault", "motor_3:stuck@10-18")
AMONG = ("--hypotheses", "healthy,motor_1:stuck,motor_2:stuck")
"""Where what is learned does not depend on what else is offered."""
on_sqlite = pytest.mark.parametrize("place", ["sqlite"], indirect=True)
on_postgresql = pytest.mark.parametrize("place", ["postgresql"], indirect=True)
"""Both engines take all that a command asks of a store: tests/data_knowledge/test_records.py."""


@pytest.fixture
def store(place):
    return ft.open_store(place.url, create=True)


@pytest.fixture
def run(failuretwin, tmp_path):
    """Run a command that must work in a folder of its own."""

    def call(*words, code=0):
        answer = failuretwin(*words, folder=tmp_path)
        assert answer.returncode == code, answer.stdout + answer.stderr
        return answer

    return call


@pytest.fixture
def calibrated(store, armpi):
    """A calibration of the arm in the store."""
    document = armpi.imperfections_file.read_text("utf-8")
    store.keep_calibration("arm_7", document, name="armpi_fpv", protocol="P0c", profile=armpi)


@pytest.fixture(scope="module")
def stuck_run(tmp_path_factory):
    """The run of the sample in which motor 3 sticks."""
    path = tmp_path_factory.mktemp("stuck") / "run.nc"
    save_run_set(ft.read_runs(ft.sample_log()).isel(run=[1]), path)
    return path


FOUND = "calibration of arm_7 from the store: armpi_fpv, valid from"


def texts(history, kind):
    return [one.text for one in history.timeline if one.kind == kind]


@on_postgresql
def test_work_of_every_command_is_in_the_history(run, store, place, calibrated, tmp_path):
    words = ("--store", place.url, *NAME)
    watch = run("watch", "emulated", "--speed", 0, "--seconds", 30, *FAULT, *words)
    assert FOUND in watch.stderr
    lines = [line.partition(" s  ")[2] for line in watch.stdout.splitlines() if " s  " in line]
    stored = texts(store.history("arm_7"), "watch")
    assert stored[1:-1] == lines
    assert (stored[0], stored[-1][:9]) == ("begins: emulated", "ends: OK:")
    assert [line.partition(":")[0] for line in lines if line[:2] in ("AL", "CL")] == [
        "ALARM",
        "CLEARED",
    ]
    assert [(one.motor, one.state) for one in store.history("arm_7").episodes] == [
        ("motor_3", "cleared")
    ]

    (tmp_path / "task.csv").write_text("x,y,z\n0.15,0.0,0.15\n")
    act = run("act", "task.csv", *words)
    assert FOUND in act.stderr
    assert act.stdout.count("remembered in") == 1
    (done,) = texts(store.history("arm_7"), "act")
    assert done.startswith("target (0.150, 0.000, 0.150) m: reached after")

    check = run("check", "--seconds", 8, *words)
    assert FOUND in check.stderr
    assert check.stdout.endswith(": 1 check of arm_7\n")
    assert len(texts(store.history("arm_7"), "check")) == 1
    rows = place.sql("SELECT count(*) FROM offsets WHERE name IN ('zero', 'play')")
    assert rows == [("8",)]

    told = run("import", ft.sample_log(), "--out", "out.nc", *words)
    assert told.stdout.endswith("3 runs of arm_7\n")
    assert texts(store.history("arm_7"), "import") == ["3 runs written to out.nc"]
    rows = place.sql("SELECT command, calibration_id FROM sessions ORDER BY id")
    assert rows == [("watch", "1"), ("act", "1"), ("check", "1"), ("import", "")]
    assert store.check().problems == ()


def test_a_fault_that_act_finds_begins_an_episode_and_a_short_task_clears_none(run, file, tmp_path):
    store = ft.open_store(file, create=True)
    targets = ("-0.064,0.160,0.168", "0.146,-0.122,0.212", "0.022,-0.181,0.208")
    (tmp_path / "task.csv").write_text("\n".join(("x,y,z", *targets)))
    words = ("act", "task.csv", "--store", file, *NAME)
    told = run(*words, "--fault", "motor_3:stuck=-0.4")
    (episode,) = store.history("arm_7").episodes
    assert (episode.motor, episode.mode, episode.state) == ("motor_3", "stuck", "raised")
    assert "episode 1: motor 3 stuck, raised, since" in told.stdout
    alarms = [text for text in texts(store.history("arm_7"), "act") if text.startswith("ALARM")]
    assert alarms
    assert all("motor 3 stuck at -2" in text for text in alarms)
    assert "episode" not in run(*words).stdout
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]


@on_sqlite
def test_a_check_that_was_recorded_is_stored_with_its_log(run, store, place, stuck_run):
    log = ("--log", stuck_run, "--store", place.url, *NAME)
    told = run("check", *log, "--recorded", "2026-03-02")
    assert ": 1 check of arm_7\n" in told.stdout
    assert place.sql("SELECT count(DISTINCT run_id) FROM diagnoses") == [("1",)]
    again = run("check", *log, "--recorded", "2026-03-02")
    assert ": 0 checks of arm_7, 1 known before\n" in again.stdout


@on_postgresql
def test_what_a_killed_watch_has_told_is_stored(begin, store, place, tmp_path):
    words = ("watch", "emulated", "--speed", 0, *FAULT, "--store", place.url, *NAME)
    with begin(*words, folder=tmp_path) as child:
        told = []
        while not told or "ALARM" not in told[-1]:
            told.append(child.stdout.readline())
            assert told[-1]
        child.kill()
    lines = [line.strip().partition(" s  ")[2] for line in told if " s  " in line]
    stored = texts(store.history("arm_7"), "watch")
    assert stored[1 : 1 + len(lines)] == lines
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]
    assert store.check().problems == ()


def test_a_killed_act_keeps_what_it_has_done(begin, file, tmp_path):
    store = ft.open_store(file, create=True)
    targets = ("-0.064,0.160,0.168", "0.146,-0.122,0.212", "0.022,-0.181,0.208") * 40
    (tmp_path / "task.csv").write_text("\n".join(("x,y,z", *targets)))
    words = ("act", "task.csv", "--store", file, *NAME, "--fault", "motor_3:stuck=-0.4")
    with begin(*words, folder=tmp_path) as child:
        told = ""
        while "target (" not in told:
            assert child.poll() is None
            time.sleep(0.05)
            with suppress(InputError):  # the robot is not known yet
                told = "\n".join(texts(store.history("arm_7"), "act"))
        child.kill()
    assert [one.motor for one in store.history("arm_7").episodes] == ["motor_3"]
    assert "ALARM: motor 3 stuck" in told
    assert store.check().problems == ()


def test_work_goes_on_while_its_store_is_locked(run, file, tmp_path):
    store = ft.open_store(file, create=True)
    (tmp_path / "task.csv").write_text("x,y,z\n0.15,0.0,0.15\n")
    with closing(sqlite3.connect(file, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        release = threading.Timer(5.0, other.rollback)
        release.start()
        told = run("act", "task.csv", "--store", file, *NAME)
        release.join()
    assert "remembered in" in told.stdout
    (done,) = texts(store.history("arm_7"), "act")
    assert done.startswith("target (0.150, 0.000, 0.150) m: reached after")


# The keeper of a watch.

HEALTHY = Answer(1.0, OK, diagnosis("stream", "healthy"), ALL_CLEAR)
STUCK = Answer(2.0, OK, diagnosis("stream", "motor_1:stuck"), Alarm(RAISED, "motor_1:stuck"))


@pytest.fixture
def file(tmp_path):
    return tmp_path / "robots.db"


def keeper_of(file, armpi):
    record = RobotRecord(ft.open_store(file), "arm_7", armpi)
    return begin_watch(record, "ros1", Basis("watch"), None)


def test_a_store_that_is_locked_delays_what_is_stored_and_loses_nothing(file, armpi, monkeypatch):
    store = ft.open_store(file, create=True)
    monkeypatch.setattr("failuretwin.data_knowledge.records.database.PATIENCE_S", 0.05)
    monkeypatch.setattr("failuretwin.app.keepers.RETRY_S", 0.0)
    keeper = keeper_of(file, armpi)
    with closing(sqlite3.connect(file, isolation_level=None)) as holder:
        holder.execute("BEGIN IMMEDIATE")
        keeper.keep([Change(1.0, "OK: healthy")], HEALTHY)
        assert "changes wait until they can be stored" in keeper.trouble
        assert "\n" not in keeper.trouble
        holder.execute("ROLLBACK")
    keeper.keep([Change(2.0, "ALARM: motor 1 stuck")], STUCK)
    assert keeper.trouble == ""
    stored = texts(store.history("arm_7"), "watch")
    assert stored == ["begins: ros1", "OK: healthy", "ALARM: motor 1 stuck"]
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]


def test_an_undecided_end_clears_no_episode(file, armpi):
    store = ft.open_store(file, create=True)
    keeper_of(file, armpi).keep([Change(2.0, "ALARM: motor 1 stuck")], STUCK)
    nothing = np.full(3, np.nan)
    keeper_of(file, armpi).end(Snapshot(HEALTHY, 3.0, nothing, 0.0), decided=False)
    assert [one.state for one in store.history("arm_7").episodes] == ["raised"]
    keeper_of(file, armpi).end(Snapshot(HEALTHY, 3.0, nothing, 0.0), decided=True)
    assert [one.state for one in store.history("arm_7").episodes] == ["cleared"]


# Going on from yesterday.


@pytest.fixture(scope="module")
def days(simulated, tmp_path_factory):
    """Two logs of two runs each, recorded on two days."""
    folder = tmp_path_factory.mktemp("days")
    runs = load_run_set(simulated).drop_vars("fault")
    for number in range(2):
        part = [0, 1] if number else [0, 2]
        names = [f"day {number}, run {k}" for k in range(2)]
        own = runs.isel(run=part).assign_coords(run=names)
        own["measured"] = own["measured"] + 1e-5 * np.arange(2)[:, None, None]
        save_run_set(own, folder / f"day_{number}.nc")
        os.utime(folder / f"day_{number}.nc", (0, 1_772_438_400 + 86_400 * number))
    return folder


def state_of(place):
    """Return the arrays of the last belief, by numpy alone."""
    digits = "hex(arrays)" if place.engine == "sqlite" else "encode(arrays, 'hex')"
    ((blob,),) = place.sql(f"SELECT {digits} FROM beliefs ORDER BY id DESC LIMIT 1")
    with np.load(io.BytesIO(bytes.fromhex(blob))) as stored:
        return {name: stored[name] for name in stored.files}


@on_postgresql
def test_a_robot_in_the_store_is_followed_as_by_files(
    run, place, calibrated, days, armpi, tmp_path
):
    own = shutil.copy(armpi.imperfections_file, tmp_path / "cal.toml")
    for number in range(2):
        log = days / f"day_{number}.nc"
        given = ("--track", "--calibration", own, *AMONG)
        run("diagnose", log, *given, "--csv", f"files_{number}.csv")
        words = ("--store", place.url, *NAME, *AMONG, "--csv", f"store_{number}.csv")
        told = run("diagnose", log, "--track", *words)
        assert FOUND in told.stderr
        assert "not used" not in told.stderr
        same = [(tmp_path / f"{kind}_{number}.csv").read_text() for kind in ("files", "store")]
        assert same[0] == same[1]
    with np.load(tmp_path / "cal.history.npz") as kept:
        files = {name: kept[name] for name in kept.files if name != "size"}
    stored = state_of(place)
    assert stored.keys() == files.keys()
    for name, array in files.items():
        np.testing.assert_array_equal(array, stored[name], err_msg=name)
    rows = RobotRecord(ft.open_store(place.url), "arm_7", armpi).tracked_rows()
    assert list(rows) == read_rows(tmp_path / "cal.history.jsonl", "armpi_fpv")
    advised = run("advise", "cal.history.jsonl", "--calibration", own, "--json", "files.json")
    by_store = run("advise", "--store", place.url, *NAME, "--json", "store.json")
    assert FOUND in by_store.stderr
    assert by_store.stdout == advised.stdout
    assert by_store.stdout.startswith("motor_1: fewer than 20 runs say something of its wear\n")
    again = run("diagnose", days / "day_0.nc", "--track", "--store", place.url, *NAME, *AMONG)
    assert "0 runs learned, 4 in all, 2 known already" in again.stdout
    assert place.sql("SELECT count(*), max(runs) FROM beliefs") == [("2", "4")]
    told = run("history", "arm_7", "--store", place.url, "--report", "page").stdout
    (line,) = (line for line in told.splitlines() if line.startswith("motor_2  compliance"))
    page = (tmp_path / "page" / "index.html").read_text("utf-8")
    for cell in line.split("  "):
        assert cell.strip() in page


def test_a_belief_of_another_calibration_is_not_used_and_begins_anew(run, file, days, armpi):
    ft.open_store(file, create=True)
    words = ("--track", "--store", file, *NAME, *AMONG)
    run("diagnose", days / "day_0.nc", *words)
    told = run("diagnose", days / "day_1.nc", *words, "--calibration", "armpi_fpv")
    line = "what ... holds of arm_7 is not used: it began with another calibration. Beginning anew"
    assert line.partition("... ")[2] in told.stderr
    assert "2 runs learned, 2 in all" in told.stdout
    back = run("diagnose", days / "day_1.nc", *words)
    assert "not used" not in back.stderr
    assert "2 runs learned, 4 in all" in back.stdout


@on_sqlite
def test_a_self_calibration_begins_with_that_of_the_store(run, place, calibrated, days, tmp_path):
    learn = ("diagnose", days / "day_0.nc", "--self-calibrate", *AMONG)
    told = run(*learn, "--store", place.url, *NAME, "--csv", "a.csv")
    assert FOUND in told.stderr
    run(*learn, "--calibration", "armpi_fpv", "--csv", "b.csv")
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()


@on_postgresql
def test_a_watch_goes_on_from_what_earlier_ones_have_learned(run, place, store):
    words = ("watch", "emulated", "--speed", 0, "--seconds", 15, "--calibration", "generic")
    first = run(*words, "--track", "--store", place.url, *NAME)
    assert "0 runs of movements known before" in first.stdout
    ((known,),) = place.sql("SELECT max(runs) FROM beliefs")
    again = run(*words, "--seed", 1, "--track", "--store", place.url, *NAME)
    ((now,),) = place.sql("SELECT max(runs) FROM beliefs")
    assert f"{known} runs of movements known before" in again.stdout
    assert int(now) > int(known) > 0


def test_a_killed_watch_keeps_what_it_has_learned(run, begin, file, tmp_path):
    ft.open_store(file, create=True)
    words = ("watch", "emulated", "--speed", "0", "--calibration", "generic", "--track")
    words += ("--store", str(file), *NAME)
    with closing(sqlite3.connect(file)) as rows, begin(*words, folder=tmp_path) as child:
        while not rows.execute("SELECT 1 FROM beliefs").fetchall():
            assert child.poll() is None
            time.sleep(0.05)
        child.kill()
        child.wait()
        ((known,),) = rows.execute("SELECT sum(json_array_length(rows)) FROM beliefs")
        ((learned,),) = rows.execute("SELECT max(runs) FROM beliefs")
    assert known == 1 <= learned
    again = run(*words, "--seconds", 20)
    assert f"{learned} runs of movements known before" in again.stdout
    with closing(sqlite3.connect(file)) as rows:
        counts = [one[0] for one in rows.execute("SELECT runs FROM beliefs ORDER BY id")]
    assert counts == sorted(set(counts))
    assert counts[-1] > learned


def test_wear_needs_a_history(run, file, tmp_path):
    ft.open_store(file, create=True)
    (tmp_path / "task.csv").write_text("x,y,z\n0.15,0.0,0.15\n")
    acts, advises = ("act", "task.csv", "--wear", "store"), ("advise", *NAME)
    for words, option, name in (
        (acts, "--wear store needs a store", "armpi_fpv"),
        (advises, "without --store", "arm_7"),
    ):
        assert option in run(*words, code=2).stderr
        said = run(*words, "--store", file, code=2).stderr
        assert f"robots.db: holds no tracked run of {name!r}" in said


def test_tracking_a_watch_needs_a_store(run):
    said = run("watch", "emulated", "--track", code=2).stderr
    assert "--track needs a store. Name one: --store robots.db." in said


def test_only_logs_were_recorded_before(run, file):
    ft.open_store(file, create=True)
    for words in (("watch", "emulated"), ("check",)):
        said = run(*words, "--store", file, "--recorded", "2026-03-02", code=2).stderr
        assert "only logs were recorded before: leave out --recorded" in said


# Learned priors.


@on_sqlite
def test_confirmed_faults_count_until_they_are_withdrawn(run, place, store, stuck_run, tmp_path):
    words = ("--store", place.url, *NAME)
    few = ("diagnose", stuck_run, "--hypotheses", "healthy,motor_3:stuck")
    sample = (*few, "--json", "found.jsonl", *words)
    run(*sample, "--recorded", "2026-03-02")
    run("found", "arm_7", 1, "--confirmed", "--store", place.url)
    told = run(*sample, "--recorded", "2026-03-02", "--learned-priors")
    assert "learned priors: 1 confirmed fault of 1 robot (armpi_fpv); most" in told.stderr
    record = json.loads((tmp_path / "found.jsonl").read_text().splitlines()[0])
    assert record["method"].endswith("; learned priors")
    run("advise", "--template", "costs.toml")
    run(*few, "--json", "plain.jsonl")
    advice = ("advise", "plain.jsonl", "--costs", "costs.toml", "--store", place.url)
    assert "learned priors: 1 confirmed" in run(*advice, "--learned-priors").stderr
    run("found", "arm_7", 1, "--withdraw", "--store", place.url)
    again = run(*sample, "--learned-priors")
    assert "learned priors: 0 confirmed faults of 1 robot" in again.stderr
    watch = ("watch", "emulated", "--speed", 0, "--seconds", 5, "--learned-priors", *words)
    assert "learned priors: 0 confirmed faults of 1 robot" in run(*watch).stderr


@pytest.mark.parametrize("command", [("diagnose", "a.nc"), ("watch", "emulated")])
def test_learned_priors_need_a_store(run, command):
    said = run(*command, "--learned-priors", code=2).stderr
    assert "--learned-priors needs a store. Name one: --store robots.db." in said
