from __future__ import annotations

import json
import signal

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from waiting import WAIT_S
from warm_command import remarks

FEW = ("--hypotheses", "healthy,motor_1:stuck")


@pytest.fixture
def log(tmp_path, twin):
    """A folder with a CSV log of one healthy run, in units of its own."""
    at = np.arange(0.0, 6.0, 0.05)
    angle = np.interp(at, [0.5, 1.3, 3.0, 4.0], [0.0, 0.7, 0.7, -0.3])
    command = np.outer(angle, [1.0, 0.5, -0.5, 0.4])
    tool = 1000 * twin.path(command)
    columns = {"stamp_ms": 1000 * at}
    columns |= {f"m{k + 1}_target_deg": np.rad2deg(command[:, k]) for k in range(4)}
    columns |= {f"tcp_{axis}": tool[:, i] for i, axis in enumerate("xyz")}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False, float_format="%.4f")
    return tmp_path


def test_a_guess_is_written_and_shown_and_nothing_is_read(failuretwin, log):
    result = failuretwin("import", "log.csv", "--columns", "map.toml", "--out", "r.nc", folder=log)

    assert result.returncode == 2
    assert "A GUESS: check every line" in result.stdout
    assert "did not exist" in result.stderr
    assert (log / "map.toml").read_text() in result.stdout + "\n"
    assert not (log / "r.nc").exists()


def test_the_checked_guess_leads_to_a_verdict_and_a_page(failuretwin, log):
    failuretwin("diagnose", "log.csv", "--columns", "map.toml", folder=log)

    result = failuretwin(
        "diagnose", "log.csv", "--columns", "map.toml", "--report", "report", *FEW, folder=log
    )

    assert result.returncode == 0, result.stderr
    page = (log / "report" / "index.html").read_text()
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http-equiv", "")
    assert "healthy" in result.stdout


def test_a_log_is_never_overwritten_by_what_is_made_of_it(failuretwin, log):
    before = (log / "log.csv").read_bytes()
    failuretwin("diagnose", "log.csv", "--columns", "map.toml", folder=log)

    result = failuretwin(
        "import", "log.csv", "--columns", "map.toml", "--out", "log.csv", folder=log
    )

    assert result.returncode == 2
    assert "is what is to be read" in result.stderr
    assert (log / "log.csv").read_bytes() == before


def test_exported_csv_is_read_back(failuretwin, log):
    failuretwin("diagnose", "log.csv", "--columns", "map.toml", folder=log)
    failuretwin("import", "log.csv", "--columns", "map.toml", "--out", "again.csv", folder=log)

    words = ("diagnose", "again.csv", "--columns", "again.toml", *FEW)
    guess = failuretwin(*words, folder=log)
    result = failuretwin(*words, folder=log)

    assert guess.returncode == 2
    assert result.returncode == 0, result.stderr
    assert "healthy" in result.stdout


TELL_PROGRESS = """
from contextlib import contextmanager
from failuretwin.app import cli
from failuretwin.app.commands import data
@contextmanager
def telling(*_):
    yield lambda runs: print(runs, flush=True)
data.progress_bar = telling
cli.main()
"""


def test_an_interrupt_ends_the_workers_and_leaves_no_netcdf(begin, tmp_path):
    words = ("simulate", "--runs-per-class", 40, "--workers", 2, "--out", "runs.nc")
    process = begin(*words, folder=tmp_path, code=TELL_PROGRESS)
    assert process.stdout.readline() == "100\n"  # the first piece is done
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=WAIT_S)

    assert process.returncode != 0
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def one_run(failuretwin, tmp_path_factory):
    """A healthy run without imperfections."""
    path = tmp_path_factory.mktemp("one_run") / "runs.nc"
    run = ["--hypotheses", "healthy", "--runs-per-class", 1, "--seed", 3, "--out", path]
    assert failuretwin("simulate", *run).returncode == 0
    return path


@pytest.mark.parametrize("said", ["not JSON", "[1, 2]", '{"imperfections": 3}'])
def test_a_configuration_of_other_people_does_no_harm(failuretwin, one_run, tmp_path, said):
    with xr.open_dataset(one_run, engine="h5netcdf") as stored:
        runs = stored.load()
    runs.attrs["configuration"] = said
    runs.to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf")

    result = failuretwin("diagnose", "theirs.nc", *FEW, folder=tmp_path)

    assert result.returncode == 0, result.stderr
    assert remarks(result.stderr) == ""


def test_paths_that_no_whole_counts_make_are_refused(failuretwin, one_run, tmp_path):
    failuretwin("import", one_run, "--out", "runs.mat", folder=tmp_path)

    exact = failuretwin("diagnose", "runs.mat", folder=tmp_path)

    assert exact.returncode == 2
    assert "log that holds its commands" in exact.stderr


def test_columns_whose_names_tell_all_need_no_map(failuretwin, log):
    table = pd.read_csv(log / "log.csv")
    refused = failuretwin("diagnose", "log.csv", folder=log)
    table.rename(columns=lambda name: name + "_mm" * name.startswith("tcp")).to_csv(
        log / "told.csv", index=False
    )

    result = failuretwin("diagnose", "told.csv", *FEW, folder=log)

    assert refused.returncode == 2
    assert "the unit of tcp_x" in refused.stderr
    assert result.returncode == 0, result.stderr
    assert "healthy" in result.stdout


def test_a_frozen_reading_is_not_told_from_a_stuck_motor(failuretwin, data, tmp_path):
    """Where the tool is computed from the motors' readings; the tool of its own says more."""
    log = data / "killian_runs_dev/60_trajs_percentage_failure/092_stuck_motor_2_traj_18"
    few = ("--hypotheses", "healthy,motor_2:stuck,motor_3:stuck")
    answer = failuretwin("diagnose", log, "--json", "out.json", *few, folder=tmp_path)
    assert answer.returncode == 0, answer.stderr
    row = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert row["verdict"].endswith("so a frozen reading of motor 2 looks the same")
    assert failuretwin("simulate", "--out", "own.nc", "--hypotheses", "motor_2:stuck",
                       "--runs-per-class", 1, folder=tmp_path).returncode == 0  # fmt: skip
    own = failuretwin("diagnose", "own.nc", *few, folder=tmp_path)
    assert "motor 2 stuck" in own.stdout
    assert "frozen reading" not in own.stdout
