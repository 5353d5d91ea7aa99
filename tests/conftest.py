from __future__ import annotations

import gc
import logging
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from failuretwin import DigitalTwin, load_robot
from failuretwin.core.movements import Movements
from failuretwin.core.runs import RunTable
from failuretwin.digital_model.calibrated_robot import load_calibration
from postgres_server import PostgresServer
from roscores import Roscore, need_ros
from store_places import SqlitePlace

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell ignores Ctrl-C for what it runs in the background, and children would inherit that;
    # some tests press it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("steady", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=2000)
settings.load_profile("steady")

SLOW_S = 3600.0
"""Time limit of a test that is marked as slow [s]; that of the others is in pyproject.toml."""


def pytest_collection_finish():
    """Let the garbage collector leave alone what stays: imports are half a million objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(SLOW_S))


DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data():
    folder = Path(os.environ.get("FAILURETWIN_DATA", DATA))
    if not folder.is_dir():
        pytest.skip(f"no real logs in {folder}; set FAILURETWIN_DATA to the folder that holds them")
    return folder


@pytest.fixture(scope="session")
def simulink(data):
    """90 published runs of the Simulink model, ten of each label."""
    with np.load(data / "simulink_reference.npz") as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="session")
def armpi():
    return load_robot("armpi_fpv")


@pytest.fixture(scope="session")
def measured_file():
    """Imperfections with figures that stay as they are, without a calibration."""
    return Path(__file__).with_name("measured_armpi.toml")


@pytest.fixture(scope="session")
def measured_armpi(armpi, measured_file):
    return load_calibration(str(measured_file), armpi).imperfections


@pytest.fixture(scope="session")
def twin(armpi):
    return DigitalTwin(armpi)


@pytest.fixture(scope="session")
def run_of():
    """Make a run set of one run: motors go to `targets`, the tool reads `measured`."""

    def make(targets, measured, motors=("motor_1", "motor_2"), rate=100.0, ramp_s=0.8):
        targets = np.asarray(targets, dtype=float)
        count = len(targets)
        time = np.arange(200 * count) * 0.01
        movements = Movements(
            initial=np.zeros((1, len(motors))),
            target=targets[None],
            ramp_duration=np.full((1, *targets.shape), ramp_s),
            start=2.0 * np.arange(count, dtype=float)[None],
        )
        path = measured(time) if callable(measured) else np.repeat(measured, 200, axis=0)
        return RunTable(
            run=["run"],
            motor=motors,
            time=time,
            command=movements.reference(time),
            measured=np.array(path, dtype=float)[None],
            measured_rate_hz=rate,
        ).to_dataset()

    return make


@pytest.fixture(scope="session")
def roscore(tmp_path_factory):
    """A real roscore; this process finds it by its environment."""
    need_ros()
    core = Roscore(tmp_path_factory.mktemp("ros"))
    core.start()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROS_HOME", "ROS_IP", "ROS_MASTER_URI"):
            patch.setitem(os.environ, name, core.environment[name])
        yield core
    core.stop()


@pytest.fixture(scope="session")
def postgres():
    """A PostgreSQL server of its own."""
    server = PostgresServer()
    server.start()
    yield server
    server.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request, tmp_path):
    """A place for a store on each engine: its URL, and SQL by the engine's own program."""
    if request.param == "sqlite":
        return SqlitePlace(tmp_path / "robots.db")
    return request.getfixturevalue("postgres").place()


@pytest.fixture(scope="module")
def scheduler():
    """Address of a scheduler with two workers; work that ends two of them is given up."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": 1,
                "distributed.worker.multiprocessing-method": "forkserver",
            }
        ),
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            host="127.0.0.1",
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster.scheduler_address
