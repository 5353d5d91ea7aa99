"""The public names: as listed, documented, typed, and reached without a deep import."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.runs import run_set

NAMES = [name for name in ft.__all__ if name != "__version__"]


def test_the_namespace_is_what_it_lists():
    assert dir(ft) == ft.__all__
    assert len(set(ft.__all__)) == len(ft.__all__)
    assert 30 <= len(NAMES) <= 62
    with pytest.raises(AttributeError, match="no attribute 'nothing_like_it'"):
        _ = ft.nothing_like_it


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there_documented_and_typed(name):
    thing = getattr(ft, name)
    assert thing.__name__ == name
    assert thing.__module__.startswith("failuretwin.")
    assert len(inspect.getdoc(thing) or "") > 30
    call = thing.__init__ if inspect.isclass(thing) else thing
    if call is object.__init__ or getattr(thing, "_is_protocol", False):
        return
    hints = inspect.signature(call)
    untyped = [p for p in hints.parameters.values() if p.annotation is p.empty]
    assert [p.name for p in untyped] in ([], ["self"], ["self", "args", "kwargs"])


@pytest.fixture(scope="module")
def runs():
    return ft.simulate(ft.Plan("armpi_fpv", ["healthy", "motor_1:stuck"], 2, seed=5))


def test_names_and_paths_do_where_values_do(runs, tmp_path):
    from failuretwin.data_knowledge.store import save_run_set

    path = tmp_path / "runs.nc"
    save_run_set(runs, path)
    twin = ft.DigitalTwin(ft.load_robot("armpi_fpv"))
    by_value = ft.BayesDiagnoser(twin).diagnose(runs)
    assert ft.BayesDiagnoser("armpi_fpv").diagnose(str(path)) == by_value
    assert ft.diagnose(path) == by_value
    assert ft.diagnose(runs, ft.load_robot("armpi_fpv"), "armpi_fpv") == by_value


def test_diagnoses_are_scored_in_one_call(runs, tmp_path):
    found = ft.diagnose(runs, calibration="none", hypotheses=["healthy", "motor_1:stuck"])
    scores = ft.evaluate(found, runs).judged.scores
    assert (scores.right, scores.runs) == (4, 4)


def test_plain_arrays_are_enough():
    time = np.arange(400) * 0.01
    command = np.zeros((400, 6))
    command[200:, 0] = np.minimum((time[200:] - 2.0) * 0.5, 0.4)
    twin = ft.DigitalTwin(ft.load_robot("armpi_fpv"))
    motors = twin.robot.motor_names
    command = command[:, : len(motors)]
    runs = run_set(time, command, twin.path(twin.respond(command, time)), motors=motors)
    (diagnosis,) = ft.diagnose(runs)
    assert sum(diagnosis.posterior.values()) == pytest.approx(1.0)


def test_a_motion_is_judged_by_the_name_of_its_robot():
    time = np.arange(400) * 0.01
    robot = ft.load_robot("armpi_fpv")
    command = np.zeros((400, len(robot.motors)))
    command[:, 0] = np.clip((time - 1.0) * 0.5, 0.0, 0.4)
    found = ft.isolability("armpi_fpv", command, time, hypotheses=["motor_1:stuck"])
    assert found.hypotheses == ("healthy", "motor_1:stuck")


def test_streams_calibrations_and_twins_take_names(tmp_path):
    assert ft.StreamingFleet("armpi_fpv", robots=3).robots == 3
    assert ft.StreamingDiagnoser("armpi_fpv").update(0.0, None, None).diagnosis is None
    assert ft.load_calibration("armpi_fpv").robot.name == "armpi_fpv"
    assert ft.DigitalTwin("ur5e").robot.name == "ur5e"
    with pytest.raises(ft.InputError, match=r"nothing\.jsonl: cannot be read"):
        ft.read_results(str(tmp_path / "nothing.jsonl"))


def test_names_that_need_an_extra_say_so():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import failuretwin as ft\n"
        "try: ft.load_network\n"
        "except ft.InputError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.endswith("Install them: pip install 'failuretwin[learn]'.\n")


def test_extras_that_are_named_can_be_installed():
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    pages = [*(root / "docs").rglob("*.md"), root / "README.md"]
    files = [*(root / "src").rglob("*.py"), *pages]
    text = "\n".join(path.read_text("utf-8") for path in files)
    named = {n for found in re.findall(r"failuretwin\[([a-z,]+)\]", text) for n in found.split(",")}
    named |= set(re.findall(r'needs_extra\("[^"]*", "(\w+)"\)', text))
    assert {"files", "learn", "plots"} <= named <= project["optional-dependencies"].keys()
