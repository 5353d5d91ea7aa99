from __future__ import annotations

import json
import math
import os
import signal

import numpy as np
import pytest
from click.testing import CliRunner

from failuretwin.app.cli import cli
from failuretwin.app.reports.study_page import (
    TABLE_2,
    TABLE_3,
    write_study_page,
)
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.store import save_run_set
from failuretwin.decision.learned import paper_study
from failuretwin.decision.learned.paper_study import (
    FEATURES,
    PLAN_FILE,
    WORK,
    Exam,
    Job,
    StudyPlan,
    Training,
    check_folder,
    given_test_set,
    in_bfloat16,
    mean_confusion,
    quick_plan,
    ratio_spreads,
    run_study,
    spread_of,
    stand_in_test_set,
)
from waiting import WAIT_S, wait_for, workers_of

TINY = StudyPlan(0, 3, (2, 4), 1, 1)
ENDLESS = """from failuretwin.app.cli import main
from failuretwin.decision.learned import paper_study
paper_study.quick_plan = lambda seed: paper_study.StudyPlan(seed, 3, (10**6,), 2, 1)
main()"""
"""The command line, with a small study whose trainings do not end."""


@pytest.fixture(scope="module")
def exam(armpi):
    return stand_in_test_set(TINY, armpi)


@pytest.fixture(scope="module")
def studied(armpi, exam, tmp_path_factory):
    """A tiny study, and how much of it was told as progress."""
    folder = tmp_path_factory.mktemp("study") / "out"
    told = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)  # each process imports all libraries
        trainings = run_study(TINY, armpi, exam, folder, told.append)
    write_study_page(trainings, TINY, armpi, exam, folder)
    return folder, sum(told)


def test_simulated_runs_are_not_taken_for_real_ones(armpi, tmp_path):
    save_run_set(simulate(Plan(armpi, ["healthy"], 1)), tmp_path / "runs.nc")
    exam = given_test_set(tmp_path / "runs.nc", armpi, False)
    assert not exam.real
    assert exam.source == f"1 simulated run of {tmp_path / 'runs.nc'}"
    with pytest.raises(InputError, match="--published-labels is for raw sessions"):
        given_test_set(tmp_path / "runs.nc", armpi, True)


def result(confusion):
    return Training(Job("augmented", 1e-3, 0), {"test": (1.0,)}, tuple(map(tuple, confusion)), 1)


def test_the_plan_is_the_papers():
    plan = StudyPlan()
    jobs = list(plan.jobs())
    assert len(jobs) == len(set(jobs)) == 2 * 2 * 5
    assert plan.checkpoints == (1010, 2020, 3030, 4040, 5050)
    assert 50 * math.floor(0.9 * 9 * plan.runs_per_class / 32) == plan.iterations
    assert set(quick_plan(0).jobs()) < set(jobs)


def test_ratios_of_a_known_confusion():
    """Worked out by hand: the second class is never named."""
    rows = ratio_spreads([result([[3, 0, 1], [2, 0, 2], [1, 0, 3]])] * 2)
    (precision, recall, f1), never, _ = rows
    assert (precision.mean, recall.mean, f1.mean) == pytest.approx((0.5, 0.75, 0.6))
    assert precision.deviation == 0.0
    assert math.isnan(never[0].mean) and math.isnan(never[2].mean)
    assert never[1].mean == 0.0


def test_spread_is_that_of_a_sample():
    spread = spread_of([1.0, 2.0, 3.0])
    assert (spread.mean, spread.deviation) == (2.0, 1.0)
    assert math.isnan(spread_of([0.5]).deviation)


def test_confusion_shares_add_up():
    share = mean_confusion([result([[3, 1], [0, 0]]), result([[1, 3], [0, 0]])])
    np.testing.assert_allclose(share[0], [0.5, 0.5])
    assert np.isnan(share[1]).all()


def test_published_ratios_fit_each_other():
    """F1 is the harmonic mean, give or take rounding and the mean over repetitions."""
    for name, (precision, recall, f1) in TABLE_3.items():
        if name == "healthy":
            assert math.isnan(precision.mean) and math.isnan(f1.mean)
            continue
        harmonic = 2 * precision.mean * recall.mean / (precision.mean + recall.mean)
        assert harmonic == pytest.approx(f1.mean, abs=0.03)
    recall = np.mean([row[1].mean for row in TABLE_3.values()])
    assert recall == pytest.approx(TABLE_2["test"].mean, abs=0.002)


def test_everything_is_on_the_page(studied):
    folder, told = studied
    text = (folder / "index.html").read_text("utf-8")
    assert told == len(TINY.jobs())
    for words in ("Table II", "Table III", "61.56 ± 5.59", "0.89 ± 0.04", "NaN", "stands in"):
        assert words in text
    assert text.count("data:image/png;base64,") == 4
    assert sorted(p.name for p in folder.iterdir()) == ["index.html", "study.json", "trainings"]


def here(work, jobs, on_progress):
    """Run jobs in this process."""
    for job in jobs:
        work(job)
        on_progress(1)


def test_what_is_done_is_not_done_again(armpi, exam, studied, monkeypatch):
    monkeypatch.setattr(paper_study, "spread", here)
    folder, _ = studied
    work = folder / WORK
    one, *others = sorted(work.glob("*.json"))
    before = json.loads(one.read_text())
    stamps = {path: path.stat().st_mtime_ns for path in others}
    one.unlink()
    told = []
    run_study(TINY, armpi, exam, folder, told.append)
    again = json.loads(one.read_text())
    assert again["accuracies"] == before["accuracies"]
    assert {path: path.stat().st_mtime_ns for path in others} == stamps
    assert told[0] == len(others)


def test_another_study_is_not_mixed_in(armpi, exam, studied):
    folder, _ = studied
    with pytest.raises(InputError, match="seed 0, this one 7"):
        run_study(StudyPlan(7, 3, (2, 4), 1, 1), armpi, exam, folder, lambda done: None)
    changed = exam.runs.copy(deep=True)
    changed["measured"].values[0, 0, 0] += 1e-6
    with pytest.raises(InputError, match="test_sha256"):
        run_study(TINY, armpi, Exam(changed, False, exam.source), folder, lambda done: None)


def test_features_are_those_of_the_paper(studied):
    folder, _ = studied
    shapes = {}
    for name in FEATURES:
        with np.load(folder / WORK / f"{name}.npz") as stored:
            shapes[name] = stored["simulated"].shape, stored["test"].shape
    assert shapes == {
        "original": ((27, 100, 7), (9, 100, 7)),
        "augmented": ((27, 100, 6), (9, 100, 6)),
    }


def run(*arguments):
    """Run `study` in this process; errors meant for users are raised."""
    given = ["study", *map(str, arguments)]
    return CliRunner().invoke(cli, given, catch_exceptions=False, standalone_mode=False)


def test_the_command_refuses_a_folder_that_is_taken(studied, tmp_path):
    folder, _ = studied
    with pytest.raises(InputError, match="--resume"):
        run("--out", folder)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match=PLAN_FILE):
        run("--out", tmp_path, "--resume")
    with pytest.raises(InputError, match=PLAN_FILE):
        run("--out", tmp_path / "mine.txt", "--resume")


def test_an_interrupt_ends_the_trainings_and_what_was_begun_goes_on(begin, tmp_path):
    """Also those that wait for their turn, and also if Ctrl-C reaches every process."""
    folder = tmp_path / "study"
    process = begin("study", "--quick", "--out", folder, code=ENDLESS, out=os.devnull)
    wait_for(lambda: any(one.cpu_times().user > 2.0 for one in workers_of(process.pid)))
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(WAIT_S) == 1
    assert list((folder / WORK).glob("*.json")) == []  # none was waited for
    (folder / PLAN_FILE).unlink()  # as if it had been interrupted a little earlier
    for arrays in (folder / WORK).iterdir():
        arrays.unlink()
    check_folder(folder, resume=True)


def test_test_runs_without_a_truth_are_refused(write_session, tmp_path):
    session = write_session(tmp_path / "session")
    with pytest.raises(InputError, match="--published-labels"):
        run("--out", tmp_path / "out", "--test", session)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("native", [False, True])
def test_products_are_in_bfloat16_where_the_processor_has_units(native, monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": native})

    def steps():
        for _ in range(2):
            yield torch.is_autocast_enabled("cpu")

    for inside in in_bfloat16(steps()):
        assert inside == native
        assert not torch.is_autocast_enabled("cpu")
