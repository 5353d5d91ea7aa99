"""The store on the command line."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta

import pytest

import failuretwin as ft
from failuretwin.data_knowledge.store import load_run_set, save_run_set


@pytest.fixture
def run(failuretwin, tmp_path):
    """Run a command that must work in a folder of its own, and return what it prints."""

    def call(*words, code=0, **more):
        answer = failuretwin(*words, folder=tmp_path, **more)
        assert answer.returncode == code, answer.stdout + answer.stderr
        return answer.stdout if code == 0 else answer.stderr

    return call


@pytest.fixture
def store(run):
    run("store", "init", "--store", "robots.db")
    return ("--store", "robots.db")


@pytest.fixture
def rows(tmp_path):
    """Return the rows of a query to the file."""

    def read(statement):
        with closing(sqlite3.connect(tmp_path / "robots.db")) as connection:
            return connection.execute(statement).fetchall()

    return read


SAMPLE = ft.sample_log()
AT = ("--recorded", "2026-03-02T14:30")
FEW = ("--hypotheses", "healthy,motor_3:stuck")


@pytest.fixture(scope="module")
def stuck_log(tmp_path_factory):
    """The run of the sample in which motor 3 sticks."""
    path = tmp_path_factory.mktemp("stuck") / "stuck.nc"
    save_run_set(ft.read_runs(SAMPLE).isel(run=[1]), path)
    return path


@pytest.fixture(scope="module")
def told(failuretwin, tmp_path_factory):
    """A folder with a log, its results and their store; and what was printed."""
    folder = tmp_path_factory.mktemp("told")
    (folder / "log.csv").write_bytes(SAMPLE.read_bytes())
    made = failuretwin("store", "init", "--store", "robots.db", folder=folder)
    assert made.returncode == 0, made.stderr
    words = ("diagnose", "log.csv", "--store", "robots.db", *AT, "--robot-name", "arm_7")
    answer = failuretwin(*words, "--json", "out.jsonl", folder=folder)
    assert answer.returncode == 0, answer.stderr
    return folder, answer.stdout


@pytest.fixture
def filled(told, tmp_path):
    """The same store, to be changed."""
    for name in ("robots.db", "log.csv", "out.jsonl"):
        shutil.copy(told[0] / name, tmp_path)
    return ("--store", "robots.db")


def test_a_store_is_made_once_and_checked(run, store, tmp_path):
    before = (tmp_path / "robots.db").read_bytes()
    assert run("store", "init", *store).startswith("the store: robots.db\n")
    assert run("store", "upgrade", *store) == "robots.db: is up to date (revision 6)\n"
    assert (tmp_path / "robots.db").read_bytes() == before
    assert run("store", "check", *store) == "robots.db: revision 6; empty\nno problems\n"


def test_diagnoses_are_remembered_with_their_log(run, told, filled, rows, tmp_path):
    folder, printed = told
    assert "remembered in robots.db: 3 runs of arm_7\n" in printed
    assert "episode 2: motor 2 misses its targets, raised, since 2026-03-02 14:30\n" in printed
    results = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    names = ("diagnosis", "probability", "onset_s", "magnitude")
    stored = rows("SELECT hypothesis, probability, onset_s, magnitude FROM diagnoses ORDER BY id")
    wanted = [tuple(one[name] for name in names) for one in results]
    assert stored == wanted
    logs = rows("SELECT path, recorded FROM logs")
    assert logs == [(str(folder / "log.csv"), "2026-03-02 14:30:00.000000")]
    again = run("diagnose", "log.csv", *filled, *AT, "--robot-name", "arm_7")
    assert "remembered in robots.db: 0 runs of arm_7, 3 known before\n" in again
    assert rows("SELECT count(*) FROM diagnoses") == [(3,)]


def test_a_log_that_has_changed_is_a_problem(run, store, stuck_log, tmp_path):
    log = tmp_path / "log.nc"
    log.write_bytes(stuck_log.read_bytes())
    run("diagnose", "log.nc", *store, *FEW)
    log.write_text("another")
    assert "robots.db: 1 problem. Expected" in run("store", "check", *store, code=2)


def test_each_run_belongs_to_its_log(run, store, rows, tmp_path):
    runs = ft.read_runs(SAMPLE)
    for name, part in (("a.nc", [0, 1]), ("b.nc", [2])):
        save_run_set(runs.isel(run=part), tmp_path / name)
    run("diagnose", "a.nc", "b.nc", *store, *FEW)
    found = rows("SELECT path, runs.name FROM runs JOIN logs ON log_id = logs.id ORDER BY runs.id")
    assert [(path.rpartition("/")[2], name) for path, name in found] == [
        ("a.nc", "armpi_fpv/run_1"),
        ("a.nc", "armpi_fpv/run_2"),
        ("b.nc", "armpi_fpv/run_3"),
    ]
    assert rows("SELECT name FROM robots") == [("armpi_fpv",)]


def test_a_robot_is_followed_by_what_people_state(run, filled, tmp_path):
    store = filled
    stated = run("found", "arm_7", 1, "--confirmed", "--cause", "gear", "--by", "Ada", *store)
    assert stated.endswith("confirmed, since 2026-03-02 14:30\nfinding: confirmed\n")
    run("found", "arm_7", 2, "--cause", "loose cable", *store)
    assert run("repaired", "arm_7", "motor_3", "--part", "gear", *store) == (
        "arm_7, motor_3: gear replaced\n"
    )
    told = run("history", "arm_7", *store, "--report", "page")
    assert told.startswith("arm_7 (armpi_fpv): motor 3 stuck, confirmed, since 2026-03-02\n")
    for line in ("other cause, loose cable", "episode 1: confirmed, gear (Ada)", "gear replaced"):
        assert line in told
    page = (tmp_path / "page" / "index.html").read_text("utf-8")
    assert "motor 3 stuck, confirmed" in page
    assert "gear replaced" in page
    withdrawn = run("found", "arm_7", 1, "--withdraw", *store)
    assert withdrawn.endswith("raised, since 2026-03-02 14:30\nfinding: none\n")
    assert "other cause" in run("query", "wrong-diagnoses", *store)


def test_markup_in_names_is_only_text(run, store, stuck_log, tmp_path):
    name = "<b>[red]arm</b>"
    run("diagnose", stuck_log, *store, "--robot-name", name, *FEW)
    run("found", name, 1, "--confirmed", "--cause", "<script>x</script>", *store)
    assert "<script>x</script>" in run("history", name, *store, "--report", "page")
    page = (tmp_path / "page" / "index.html").read_text("utf-8")
    assert "<script>" not in page
    assert "&lt;script&gt;x&lt;/script&gt;" in page


def test_the_calibration_of_the_store_is_used_where_none_is_named(
    run, failuretwin, store, rows, simulated, tmp_path
):
    healthy = load_run_set(simulated).isel(run=[0] * 2)
    names = [f"run_{k}" for k in range(2)]
    save_run_set(healthy.assign_coords(run=names).drop_vars("fault"), tmp_path / "healthy.nc")
    words = ("--robot-name", "arm_7", *store)
    told = run("calibrate", "healthy.nc", "--out", "mine.toml", *words)
    assert "remembered in robots.db: calibration mine of arm_7" in told
    assert rows("SELECT document FROM calibrations") == [((tmp_path / "mine.toml").read_text(),)]
    save_run_set(ft.read_runs(SAMPLE).isel(run=[0]), tmp_path / "log.nc")
    log = ("log.nc", *FEW)
    by_store = failuretwin("diagnose", *log, *words, "--csv", "a.csv", folder=tmp_path)
    assert "calibration of arm_7 from the store: mine, valid from" in by_store.stderr
    run("diagnose", *log, "--calibration", "mine.toml", "--csv", "b.csv")
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    assert rows("SELECT calibration_id, method LIKE '%mine%' FROM sessions") == [(1, 1)]
    named = failuretwin("diagnose", *log, *words, "--calibration", "none", folder=tmp_path)
    assert "from the store" not in named.stderr
    assert rows("SELECT calibration_id FROM sessions ORDER BY id") == [(1,), (None,)]


def test_questions(run, filled):
    listed = run("query")
    assert listed.splitlines()[0] == "failing-motors          Which motors fail most?"
    run("store", "init", "--store", "empty.db")
    empty = run("query", "failing-motors", "--store", "empty.db")
    assert empty == "Which motors fail most?\nnone\n"
    assert "motor_2  steady_state_error  1" in run("query", "failing-motors", *filled)
    assert "open fault" in run("query", "due", "--days", 1, *filled)


def test_exports(run, filled, tmp_path):
    run("store", "export", "--out", "tables", *filled)
    assert len(list((tmp_path / "tables").glob("*.parquet"))) == 17
    told = run("store", "export", "--aas", "arm.aasx", "--robot-name", "arm_7", *filled)
    assert told == "written to arm.aasx: Nameplate, Calibration, Health, FaultHistory\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("history", "arm_7"), "no store is named. Name one: --store robots.db"),
        (("history", "arm_7", "--store", "no.db"), "no.db: does not exist. Make it first"),
        (("diagnose", SAMPLE, "--store", "no.db"), "no.db: does not exist. Make it first"),
        (("diagnose", SAMPLE, "--robot-name", "x"), "without --store: leave out --robot-name"),
        (("diagnose", SAMPLE, *AT), "without --store: leave out --recorded"),
        (("query", "duo", "--store", "robots.db"), "unknown query 'duo'. Did you mean 'due'"),
        (("found", "arm_7", 1), "give one of --confirmed, --wrong, --cause TEXT and --withdraw"),
        (("found", "arm_7", 1, "--wrong", "--confirmed"), "one of --confirmed, --wrong and"),
        (("store", "export", "--store", "robots.db"), "give one of --out DIR and --aas FILE"),
        (
            ("store", "export", "--aas", "a.json", "--store", "robots.db"),
            "--aas FILE and --robot-name NAME belong together. Give both",
        ),
        (
            ("calibrate", "a.toml", "--pool", "--out", "b.toml", "--store", "robots.db"),
            "a population is not one robot: leave out --store",
        ),
    ],
)
def test_wrong_use_is_one_line(run, store, words, said):
    assert said in run(*words, code=2).splitlines()[-1]


def test_a_time_in_the_future_is_refused_and_nothing_is_stored(run, store, rows):
    ahead = f"{datetime.now(UTC) + timedelta(days=9):%Y-%m-%d}"
    said = run("diagnose", SAMPLE, *store, "--recorded", ahead, code=2)
    assert "lies in the future" in said
    assert rows("SELECT * FROM robots") == []


def test_a_full_disk_is_one_line(failuretwin, store, stuck_log, tmp_path):
    answer = failuretwin("diagnose", stuck_log, *store, *FEW, folder=tmp_path, disk_full=True)
    assert answer.returncode == 2
    assert "robots.db: the disk is full" in answer.stderr.splitlines()[-1]
    assert failuretwin("store", "check", *store, folder=tmp_path).returncode == 0


def test_the_store_of_the_environment_is_used(run, store, stuck_log, monkeypatch):
    monkeypatch.setenv("FAILURETWIN_STORE", "robots.db")
    assert "remembered in robots.db: 1 run of armpi_fpv" in run("diagnose", stuck_log, *AT, *FEW)
    assert "motor 3 stuck" in run("history", "armpi_fpv")


def test_a_store_on_a_server_works_alike(run, postgres, stuck_log):
    url = postgres.place().url
    run("store", "init", "--store", url)
    run("diagnose", stuck_log, *AT, "--store", url, *FEW)
    assert "motor 3 stuck" in run("history", "armpi_fpv", "--store", url)
