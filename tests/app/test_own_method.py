"""A diagnoser that the user wrote, named on the command line."""

from __future__ import annotations

import json
import sys

import pytest
from click.testing import CliRunner

from failuretwin import read_runs
from failuretwin.app.cli import cli
from failuretwin.core.errors import InputError
from failuretwin.inference.diagnoser import diagnoser_from_text

OWN = """
from dataclasses import replace

from failuretwin.core.hypothesis import Diagnosis


class Guess:
    def __init__(self, twin):
        self.motors = twin.robot.motor_names

    def diagnose(self, runs):
        posterior = {"healthy": 0.25, f"{self.motors[0]}:stuck": 0.75}
        names = [str(name) for name in runs["run"].values]
        return [Diagnosis(run=name, posterior=posterior, method="a guess") for name in names]


class Sloppy(Guess):
    def diagnose(self, runs):
        shares = {"healthy": 0.9, "motor_1:stuck": 0.5}
        return [replace(told, posterior=shares) for told in super().diagnose(runs)]


class Anonymous(Guess):
    def diagnose(self, runs):
        return [replace(told, run="x") for told in super().diagnose(runs)]


class NeedsNothing(Guess):
    def __init__(self):
        pass


class Short(Guess):
    def diagnose(self, runs):
        return super().diagnose(runs)[:-1]


class Mute:
    def __init__(self, twin):
        self.twin = twin
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder to work in, with a module of the user."""
    (tmp_path / "my_methods.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("import no_such_package\n")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("my_methods", "broken"):
        sys.modules.pop(name, None)


def test_a_class_of_the_user_is_called_with_the_twin(own, twin, simulated):
    before = list(sys.path)
    runs = read_runs(simulated)
    diagnoses = diagnoser_from_text("my_methods:Guess", twin).diagnose(runs)
    assert diagnoses[0].posterior == {"healthy": 0.25, "motor_1:stuck": 0.75}
    expected = "cannot tell yet; most probable: motor 1 stuck, 75 % (or healthy 25 %)"
    assert diagnoses[0].verdict == expected
    assert [d.truth for d in diagnoses] == list(runs["fault"].values)
    assert sys.path == before


def test_one_diagnosis_for_each_run_is_expected(own, twin, simulated):
    with pytest.raises(InputError, match=r"Short: .* no Diagnosis for each of 9"):
        diagnoser_from_text("my_methods:Short", twin).diagnose(read_runs(simulated))


def test_what_is_no_probability_is_refused(own, twin, simulated):
    runs = read_runs(simulated)
    with pytest.raises(InputError, match=r"Sloppy: the posterior of run .* Expected probabilities"):
        diagnoser_from_text("my_methods:Sloppy", twin).diagnose(runs)
    with pytest.raises(InputError, match="Anonymous: its diagnoses do not name the runs"):
        diagnoser_from_text("my_methods:Anonymous", twin).diagnose(runs)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("my_method:Guess", r"module 'my_method' cannot be imported .*Expected module:Class"),
        ("broken:Guess", r"module 'broken' cannot be imported \(No module named 'no_such_package'"),
        (":Guess", r"module '' cannot be imported"),
        ("my_methods:Gess", r"unknown class of my_methods 'Gess'\. Did you mean 'Guess'\?"),
        ("my_methods:", r"unknown class of my_methods ''"),
        ("my_methods:NeedsNothing", r"cannot be made \(.*Expected a class whose __init__ takes"),
        ("my_methods:Mute", r"my_methods:Mute: has no method `diagnose`"),
    ],
)
def test_what_is_no_diagnoser_is_refused(own, twin, text, words):
    with pytest.raises(InputError, match=words):
        diagnoser_from_text(text, twin)


def diagnose(*arguments):
    given = ["diagnose", *(str(argument) for argument in arguments)]
    return CliRunner().invoke(cli, given, catch_exceptions=False, standalone_mode=False)


def test_the_command_diagnoses_by_it(own, simulated):
    answer = diagnose(simulated, "--method", "my_methods:Guess", "--json", own / "out.jsonl")
    records = [json.loads(line) for line in (own / "out.jsonl").read_text().splitlines()]
    assert [record["diagnosis"] for record in records] == ["motor_1:stuck"] * 9
    assert {record["method"] for record in records} == {"a guess"}
    assert "1 of 9 runs right" in answer.output


def test_what_bayes_alone_can_be_told_is_refused(own, simulated):
    with pytest.raises(InputError, match=r"only the Bayesian diagnosis .* --onset"):
        diagnose(simulated, "--method", "my_methods:Guess", "--onset", "0.49")
