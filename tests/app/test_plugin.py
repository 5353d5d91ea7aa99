"""A fault mode of a user's own, outside the package: the one of the page, from end to end."""

from __future__ import annotations

import json
from collections import Counter

import pytest

from failuretwin import BayesDiagnoser, DigitalTwin, Plan, load_robot, simulate
from failuretwin.core.hypothesis import parse_hypotheses
from failuretwin.data_knowledge.store import load_run_set, save_run_set
from failuretwin.digital_model.calibrated_robot import load_calibration
from user_modes import code_on_the_page, registered_from
from warm_command import remarks

SHAFTS = [f"motor_{k}:bent_shaft" for k in (1, 2, 3)]
OFFERED = [
    "healthy",
    *SHAFTS,
    *(f"motor_{k}:{m}" for k in (1, 2, 3) for m in ("steady_state_error", "stuck", "encoder_bias")),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the plugin of the page, and some that are none."""
    path = tmp_path_factory.mktemp("plugins")
    code = code_on_the_page()
    plugins = {
        "bent_shaft": code,
        "silent_plugin": "",
        "second_lag": code.replace('"bent_shaft"', '"lag"'),
        "no_unit": code.replace('unit = "rad"', ""),
        "broken_plugin": "import a_module_that_is_not_there",
    }
    for name, text in plugins.items():
        (path / f"{name}.py").write_text(text)
    return path


def test_the_mode_on_the_page_takes_15_lines_at_most():
    assert sum(bool(line.strip()) for line in code_on_the_page().splitlines()) <= 15


def right(runs_each, seed, folder):
    """Return how many runs with each motor's shaft bent, and healthy ones, are told right."""
    robot = load_robot("armpi_fpv")
    known = load_calibration("armpi_fpv", robot).imperfections
    with registered_from(code_on_the_page(), folder):
        states = parse_hypotheses(["healthy", *SHAFTS], robot.motor_names)
        runs = simulate(Plan(robot, states, runs_each, seed, known))
        found = BayesDiagnoser(DigitalTwin(robot), known, hypotheses=OFFERED).diagnose(runs)
    return Counter(d.truth for d in found if d.truth == d.diagnosis)


def test_it_is_diagnosed(tmp_path):
    found = right(5, 5, tmp_path)
    assert found["healthy"] >= 4
    assert sum(found[name] for name in SHAFTS) >= 11


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_it_is_diagnosed_in_48_of_60_runs(tmp_path):
    found = right(20, 4, tmp_path)
    assert found["healthy"] >= 18
    assert sum(found[name] for name in SHAFTS) >= 48


def test_the_command_line_knows_it(failuretwin, folder):
    """By the path of its file, by its name, and in worker processes."""
    states = ("--hypotheses", "healthy,motor_2:bent_shaft", "--calibration", "armpi_fpv")
    command = ("simulate", "--runs-per-class", 34, *states, "--plugin")
    made = [
        failuretwin(*command, folder / "bent_shaft.py", "--out", folder / "one.zarr"),
        failuretwin(*command, "bent_shaft", "--workers", 2, "--out", "two.zarr", folder=folder),
    ]
    assert [remarks(answer.stderr) for answer in made] == ["", ""]
    one, two = (
        {str(f.relative_to(path)): f.read_bytes() for f in path.rglob("*") if f.is_file()}
        for path in (folder / "one.zarr", folder / "two.zarr")
    )
    assert one == two
    offered = "healthy,motor_2:bent_shaft,motor_2:stuck,motor_2:steady_state_error"
    options = ("--plugin", "bent_shaft", "--hypotheses", offered, "--json", "said.jsonl")
    save_run_set(load_run_set(folder / "one.zarr").isel(run=slice(32, 38)), folder / "some.nc")
    answer = failuretwin("diagnose", "some.nc", *options, folder=folder)
    assert remarks(answer.stderr) == ""
    said = [json.loads(line) for line in (folder / "said.jsonl").read_text().splitlines()]
    bent = [s for s in said if s["truth"] == s["diagnosis"] == "motor_2:bent_shaft"]
    assert len(bent) >= 3
    assert bent[0]["verdict"].startswith("motor 2 bent shaft (")
    assert bent[0]["magnitude_unit"] == "rad"
    score = failuretwin("evaluate", "said.jsonl", "--plugin", "bent_shaft", folder=folder)
    assert (score.returncode, score.stderr) == (0, "")


def test_help_names_its_mode(failuretwin, folder):
    without = failuretwin("diagnose", "--help").stdout
    beside = failuretwin("diagnose", "--plugin", folder / "bent_shaft.py", "--help").stdout
    assert " ".join(without.split()).count("encoder_scale, lost_commands.") == 1
    assert " ".join(beside.split()).count("encoder_scale, lost_commands, bent_shaft.") == 1


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (
            "no_such_module",
            "cannot be imported .*named 'no_such_module'.* check the name",
        ),
        ("no_such_file.py", "there is no such file. Expected a Python file"),
        ("broken_plugin", "cannot be imported .*'a_module_that_is_not_there'"),
        ("silent_plugin", "registers no fault mode. Expected a call of failuretwin.register_mode"),
        ("second_lag.py", "there is a fault mode 'lag' already. Expected an id of its own"),
        ("no_unit", "BentShaft.unit is None, expected text. Add it to the class"),
    ],
)
def test_bad_plugins_are_refused(folder, monkeypatch, plugin, message):
    from failuretwin.core.errors import InputError
    from failuretwin.failure_behavior.registry import load_plugin
    from user_modes import forgotten_afterwards

    monkeypatch.chdir(folder)
    with forgotten_afterwards(), pytest.raises(InputError, match=f"plugin '{plugin}': .*{message}"):
        load_plugin(plugin)


def test_an_unknown_mode_is_refused_in_one_line(failuretwin, tmp_path):
    answer = failuretwin(
        "simulate", "--hypotheses", "motor_1:bent_shaft", "--out", tmp_path / "x.nc"
    )
    assert answer.returncode == 2
    assert answer.stderr.startswith("error: unknown fault mode 'bent_shaft'. Valid: stuck, ")
