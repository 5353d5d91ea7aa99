from __future__ import annotations

import json

import numpy as np
import pytest

import failuretwin as ft
from failuretwin import DigitalTwin, InputError
from failuretwin.app.arms import emulation_with, held_of, size_of, spared_of
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.inference.observation.healthy_model import HealthyModel

pytest.importorskip("mujoco")
TASK = "x,y,z\n0.1,0.1,0.2\n-0.1,0.12,0.18\n0.05,0.15,0.15\n0,0.12,0.25\n0.08,0.1,0.22\n"


@pytest.fixture
def task(tmp_path):
    path = tmp_path / "task.csv"
    path.write_text(TASK)
    return path


def test_act_reaches_what_a_stuck_motor_leaves(failuretwin, task, tmp_path):
    out = tmp_path / "out.jsonl"
    answer = failuretwin("act", task, "--fault", "motor_3:stuck=0.3", "--seed", 1, "--json", out)
    assert answer.returncode == 0, answer.stderr
    assert "plan with the motor held" in answer.stdout
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["target"] for row in rows] == [1, 2, 3, 4, 5]
    assert {"reached", "error_m", "movements", "reachable"} <= set(rows[0])
    assert sum(row["reached"] for row in rows) >= 4
    assert rows[-1]["believed"] == "motor_3:stuck"
    open_loop = failuretwin(
        "act", task, "--fault", "motor_3:stuck=0.3", "--seed", 1, "--strategy", "open"
    )
    assert "of 5 targets reached in 5 movements" in open_loop.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--on", "ros3"], "expected emulated, ros1, ros2[://HOST[:PORT]], rosbridge"),
        (["--on", "rosbridge://"], "is no address"),
        (["--on", "ros1", "--fault", "motor_1:stuck"], "is of an emulated arm"),
        (["--fault", "motor_9:stuck"], "motor_9"),
        (["--fault", "motor_1:stuck=much"], "expected a number"),
        (["--spare", "motor_9"], "motor_9"),
        (["--spare", "motor_2=1.2.3"], "expected a number"),
        (["--spare", "motor_2=-1"], "below 0"),
        (["--wear", "nothing.history.jsonl"], "nothing.history.jsonl"),
    ],
)
def test_what_act_refuses(failuretwin, task, arguments, said):
    answer = failuretwin("act", task, *arguments)
    assert answer.returncode == 2
    assert said in answer.stderr


def test_a_task_that_is_not_there(failuretwin, tmp_path):
    answer = failuretwin("act", tmp_path / "nothing.csv")
    assert answer.returncode == 2
    assert "cannot be read as a task" in answer.stderr


def test_stop_is_for_real_arms(failuretwin):
    answer = failuretwin("stop", "--on", "emulated")
    assert answer.returncode == 2
    assert "ends with its process" in answer.stderr


def test_reach_of_a_task_with_a_motor_held(failuretwin, task, tmp_path):
    out = tmp_path / "reach.jsonl"
    answer = failuretwin(
        "reach", task, "--fault", f"motor_4:stuck={np.deg2rad(10.0)}", "--json", out
    )
    assert answer.returncode == 0, answer.stderr
    record = json.loads(out.read_text())
    assert record["motor"] == "motor_4"
    assert record["angle_rad"] == pytest.approx(np.deg2rad(10.0))
    assert f"{sum(record['reached'])} of 5 points can be reached" in answer.stdout
    assert len(record["points"]) == 5


def test_reach_draws_a_map(failuretwin, task, tmp_path):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "maps" / "reach.png"
    answer = failuretwin(
        "reach", task, "--fault", "motor_2:stuck=-0.35", "--report", picture.parent
    )
    assert answer.returncode == 0, answer.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_advice_needs_the_users_costs(failuretwin, tmp_path):
    results, costs = tmp_path / "results.jsonl", tmp_path / "costs.toml"
    row = {"run": "r1", "diagnosis": "motor_1:stuck",
           "posterior": {"healthy": 0.1, "motor_1:stuck": 0.9}}  # fmt: skip
    results.write_text(json.dumps(row) + "\n")
    refused = failuretwin("advise", results)
    assert refused.returncode == 2
    assert "costs are yours to say" in refused.stderr
    assert failuretwin("advise", "--template", costs).returncode == 0
    again = failuretwin("advise", "--template", costs)
    assert again.returncode == 2
    out = tmp_path / "advice.json"
    answer = failuretwin("advise", results, "--costs", costs, "--json", out)
    assert answer.returncode == 0, answer.stderr
    told = json.loads(out.read_text())
    # By hand, from the template: 100 targets at 1.
    assert told["expected_cost"]["continue"] == pytest.approx(0.9 * 90.0)
    assert told["expected_cost"]["compensate"] == pytest.approx(5.0 + 0.9 * 40.0)
    assert told["expected_cost"]["replace motor_1"] == pytest.approx(40.0)
    assert told["expected_cost"]["inspect"] == pytest.approx(10.0 + 0.9 * 40.0)
    assert told["advice"] == "replace motor_1"
    assert failuretwin("advise").returncode == 2


def test_faults_of_an_emulated_arm(armpi):
    known = calibrated("armpi_fpv")
    found = emulation_with(["motor_3:stuck=-0.4@20", "motor_2:encoder_bias=-0.1"], known, 0)
    assert found.start[2] == -0.4
    assert found.schedule[0].start_s == 20.0
    assert found.schedule[1].start_s == 0.0
    assert found.modes["encoder_bias"].magnitude == (-0.1, -0.1)
    assert not found.modes["encoder_bias"].both_signs
    with pytest.raises(InputError, match="expected a number"):
        emulation_with(["motor_1:drift=x"], known, 0)
    with pytest.raises(InputError, match="one size of each mode"):
        emulation_with(["motor_1:slow=0.5", "motor_2:slow=0.4"], known, 0)
    model = HealthyModel.of(DigitalTwin(armpi), NO_IMPERFECTIONS)
    assert spared_of(["motor_2=0.5", "motor_4"], None, model, print).tolist() == [
        0.0,
        0.5,
        0.0,
        1.0,
    ]
    assert spared_of([], None, model, print) is None


def test_held_motors_in_words(armpi):
    assert held_of("motor_2:stuck=-0.5", armpi) == ("motor_2", -0.5)
    assert held_of("motor_2:stuck=-90deg", armpi) == ("motor_2", pytest.approx(-np.pi / 2))
    with pytest.raises(InputError, match="motor_9"):
        held_of("motor_9:stuck=1", armpi)
    for text in ("motor_2:stuck", "motor_2:drift=1", "healthy"):
        with pytest.raises(InputError, match="MOTOR:stuck=SIZE"):
            held_of(text, armpi)


@pytest.mark.parametrize(
    ("text", "unit", "size"),
    [("2", "rad", 2.0), ("2rad", "rad", 2.0), ("-180deg", "rad", -np.pi), ("20%", "ratio", 0.2),
     ("360deg/s", "rad/s", 2 * np.pi), ("5ms", "s", 0.005), ("5s", "s", 5.0),
     ("5mm", "m", 0.005), ("5m", "m", 5.0)],
)  # fmt: skip
def test_sizes_are_in_the_unit_of_the_mode_or_say_theirs(text, unit, size):
    assert size_of(text, unit, "size") == pytest.approx(size)


@pytest.mark.parametrize(("text", "unit"), [("2deg", "s"), ("2mm", "rad"), ("deg", "rad")])
def test_other_units_are_refused_with_those_that_are_known(text, unit):
    with pytest.raises(InputError, match=rf"size is '{text}'"):
        size_of(text, unit, "size")


def test_a_task_in_python():
    said = []
    task = ft.Task((ft.Target((0.10, 0.10, 0.20)), ft.Target((0.0, 0.12, 0.25))))
    with ft.emulated_arm("armpi_fpv", ["motor_3:stuck=0.3"], 1) as arm:
        results = ft.act(task, arm, tell=said.append)
    assert [result.reached for result in results] == [True, True]
    assert any("motor_3" in text for text in said)
