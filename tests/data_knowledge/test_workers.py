"""Work spread over processes: Dask workers of our own or of a scheduler, and what befalls them."""

from __future__ import annotations

import os
import re
import sys
import time

import psutil
import pytest

from executed import command_line
from failuretwin.core.errors import FailureTwinError, InputError, OutputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge import workers as dask_workers
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.resumable import produce
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.digital_model.calibrated_robot import load_calibration
from waiting import WAIT_S, workers_of

PIECE = 4
NOBODY = "tcp://127.0.0.1:1"


@pytest.fixture(scope="module")
def plan(armpi):
    known = load_calibration("armpi_fpv", armpi).imperfections
    return Plan(armpi, paper_hypotheses(armpi.motor_names), 5, 5, known)


@pytest.fixture(scope="module")
def made_by_one(plan, tmp_path_factory):
    """What one process writes."""
    path = tmp_path_factory.mktemp("one") / "one.zarr"
    produce(plan, path, chunk_runs=PIECE)
    return contents(path)


def contents(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def results(work, items, workforce):
    with workforce.map(work, items) as done:
        return list(done)


def test_every_item_is_done_once_and_in_order(scheduler):
    items = range(-30, 30)
    expected = [abs(item) for item in items]
    assert results(abs, items, Workforce()) == expected
    assert results(abs, items, Workforce(scheduler=scheduler)) == expected


def test_error_of_a_worker_is_that_of_the_work(scheduler):
    with pytest.raises(ValueError, match="could not convert string to float: 'x'"):
        results(float, ["1", "x"], Workforce(scheduler=scheduler))
    with pytest.raises(OutputError, match="full"):
        results(fail, [1], Workforce(scheduler=scheduler))


def time_out(item):
    raise TimeoutError("no disk")


def test_a_time_limit_of_the_work_is_none_of_the_workers(scheduler):
    with pytest.raises(TimeoutError, match="no disk"):
        results(time_out, [1], Workforce(scheduler=scheduler))


def fail(item):
    raise OutputError("full")


def die(item):
    os._exit(1)


def lose_import(item):
    raise ModuleNotFoundError("No module named 'failuretwin'")


def test_workers_that_keep_dying_are_given_up(scheduler):
    with pytest.raises(FailureTwinError, match="workers died again and again"):
        results(die, [1], Workforce(scheduler=scheduler))


def die_once(mark):
    if not mark.exists():
        mark.touch()
        os._exit(1)
    return mark.name


def test_work_of_a_worker_that_died_is_done_by_another(tmp_path, scheduler):
    marks = [tmp_path / name for name in "ab"]
    marks[0].touch()
    assert results(die_once, marks, Workforce(scheduler=scheduler)) == ["a", "b"]


class Unfinished:
    """The future of a result that never comes; waiting takes no time, but is added up."""

    status = "pending"
    waited_s = 0.0

    def result(self, timeout):
        self.waited_s += timeout
        raise TimeoutError


class Client:
    """A client whose workers, or the lack of them, never change."""

    def __init__(self, workers):
        self.workers, self.limits = workers, []

    def wait_for_workers(self, n_workers, timeout):
        self.limits.append(timeout)
        if self.workers < n_workers:
            raise TimeoutError


def test_workers_that_are_gone_are_waited_for_a_while():
    future, client = Unfinished(), Client(workers=0)
    with pytest.raises(FailureTwinError, match=r"have gone, and none came back within 30 s\. Look"):
        dask_workers._result(client, future)
    assert (future.waited_s, client.limits) == (30.0, [30.0])


@pytest.mark.parametrize("status", ["pending", "lost"])
def test_workers_that_do_nothing_are_not_waited_for_for_ever(status):
    future, client = Unfinished(), Client(workers=2)
    future.status = status
    with pytest.raises(FailureTwinError, match="finished nothing for 30 minutes"):
        dask_workers._result(client, future)
    assert future.waited_s == 1800.0


def test_workers_without_our_package_are_named(scheduler):
    with pytest.raises(InputError, match="Install the same version"):
        results(lose_import, [1], Workforce(scheduler=scheduler))


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (NOBODY, "Timed out"),
        ("nonsense", "missing port number"),
        ("foo://127.0.0.1:1", "unknown address scheme 'foo'"),
    ],
)
def test_scheduler_that_is_none(monkeypatch, address, words):
    monkeypatch.setattr(dask_workers, "ANSWER_S", 0.2)
    with pytest.raises(InputError, match=rf"scheduler '{address}' does not answer \({words}"):
        results(abs, [1], Workforce(scheduler=address))


def test_a_scheduler_has_five_seconds_to_answer(monkeypatch):
    import distributed

    limits = []

    def client(address, timeout, **options):
        limits.append(timeout)
        raise OSError("Timed out")

    monkeypatch.setattr(distributed, "Client", client)
    with pytest.raises(InputError, match="does not answer"):
        results(abs, [1], Workforce(scheduler=NOBODY))
    assert limits == [5.0]


def test_scheduler_without_workers(monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr(dask_workers, "FIRST_WORKER_S", 0.2)
    with LocalCluster(
        n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        address = cluster.scheduler_address
        with pytest.raises(InputError, match=rf"no workers\. Start some: dask worker {address}"):
            results(abs, [1], Workforce(scheduler=address))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"workers": 0}, "workers is 0, expected 1 to"),
        ({"workers": 10_000}, "workers is 10000, expected 1 to"),
        ({"workers": 2, "scheduler": NOBODY}, "Give one or the other"),
    ],
)
def test_workforce_that_makes_no_sense(options, words):
    with pytest.raises(InputError, match=words):
        Workforce(**options)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=re.escape("pip install 'failuretwin[cluster]'")):
        results(abs, [1], Workforce(workers=2))
    assert results(abs, [-1], Workforce()) == [1]


def test_workers_of_a_scheduler_make_the_same_runs(tmp_path, plan, scheduler, made_by_one):
    produce(plan, tmp_path / "many.zarr", Workforce(scheduler=scheduler), chunk_runs=PIECE)
    assert contents(tmp_path / "many.zarr") == made_by_one
    assert simulate(plan, scheduler=scheduler).identical(simulate(plan))


PRODUCE = """
import sys
from pathlib import Path
from failuretwin import load_robot
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan
from failuretwin.data_knowledge.resumable import produce
from failuretwin.data_knowledge.workers import Workforce
from failuretwin.digital_model.calibrated_robot import load_calibration
robot = load_robot("armpi_fpv")
known = load_calibration("armpi_fpv", robot).imperfections
plan = Plan(robot, paper_hypotheses(robot.motor_names), 5, 5, known)
produce(plan, Path(sys.argv[1]), Workforce(2), chunk_runs=4)
"""


@pytest.mark.slow
def test_killed_worker_is_replaced(tmp_path, made_by_one):
    path = tmp_path / "two.zarr"
    marks = ".two.zarr.*.partial/done/*"
    with command_line().begin(path, code=PRODUCE) as process:
        while not list(tmp_path.glob(marks)):
            assert process.poll() is None
            time.sleep(0.002)
        workers = workers_of(process.pid)
        workers[0].kill()
        done_at_kill = len(list(tmp_path.glob(marks)))
        assert process.wait(WAIT_S) == 0
        assert "Traceback" not in process.stderr.read()
    assert len(workers) == 2
    assert 0 < done_at_kill < 12
    assert contents(path) == made_by_one
    assert [p.name for p in tmp_path.iterdir()] == ["two.zarr"]


def test_workers_do_not_outlive_a_killed_parent(tmp_path):
    path = tmp_path / "runs.zarr"
    with command_line().begin(path, code=PRODUCE) as one:
        while not list(tmp_path.glob(".runs.zarr.*.partial/done/*")):
            assert one.poll() is None
            time.sleep(0.002)
        children = psutil.Process(one.pid).children(recursive=True)
        one.kill()
    _, alive = psutil.wait_procs(children, timeout=WAIT_S)
    assert len(children) >= 2
    assert alive == []
    assert not path.exists()
