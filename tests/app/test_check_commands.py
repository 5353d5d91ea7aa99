from __future__ import annotations

import json

import numpy as np
import pytest

from failuretwin import load_robot

pytest.importorskip("mujoco")


def test_a_check_names_the_motor_and_what_to_do(failuretwin, tmp_path):
    out, kept = tmp_path / "out.json", tmp_path / "kept.json"
    arguments = ("check", "--seed", 2, "--keep", kept)
    first = ("--seconds", 14, "--json", out, "--report", tmp_path / "green")
    healthy = failuretwin(*arguments, *first)
    assert healthy.returncode == 0, healthy.stderr
    assert healthy.stdout.startswith("GREEN: healthy")
    assert "green rules out what the last column says" in healthy.stdout
    shown = [row["shown_from"] for row in json.loads(out.read_text())["motors"]]
    assert all(0.01 < size < 0.04 for size in shown)
    assert "shows errors from" in (tmp_path / "green" / "index.html").read_text("utf-8")
    *_, state, step = healthy.stdout.splitlines()
    assert state.startswith("Healthy: ")
    assert step == "what to do: Nothing to do now. Check again after a repair, or in a month."
    fault = ("--fault", "motor_2:encoder_bias=0.08", "--json", out, "--report", tmp_path / "page")
    answer = failuretwin(*arguments, *fault)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith("RED: motor 2")
    *_, state, step = answer.stdout.splitlines()
    assert state.startswith("Faulty: motor 2")
    assert step.startswith("what to do: ")
    page = (tmp_path / "page" / "index.html").read_text("utf-8")
    assert step.removeprefix("what to do: ") in page.replace("&#39;", "'")
    assert "What the check measured" in page
    assert "shows errors from" not in page
    assert "motor 2 has a shifted zero by +4." in answer.stdout
    record = json.loads(out.read_text())
    assert (record["light"], record["motor"]) == ("red", "motor_2")
    assert sum(record["posterior"].values()) == pytest.approx(1.0)
    zeros = {row["motor"]: row["zero"] for row in record["motors"]}
    assert zeros["motor_2"] == pytest.approx(0.08, abs=0.02)
    checks = json.loads(kept.read_text())
    assert [row["light"] for row in checks["checks"]] == ["green", "red"]
    assert len(checks["motions"]["ramp_s"]) == checks["checks"][0]["movements"]
    for more, said in (
        (("--seconds", 30), "says which motions are made"),
        (("--motions", kept), "leave out --motions"),
        (("--json", tmp_path / "nowhere" / "out.json"), "nowhere does not exist"),
    ):
        refused = failuretwin(*arguments, *more)
        assert refused.returncode == 2
        assert said in refused.stderr
    assert json.loads(kept.read_text()) == checks


def test_what_cannot_be_written_is_refused_before_anything_moves(failuretwin, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "motions.json").write_text('{"motions": 1}')
    nowhere = tmp_path / "nowhere" / "out.json"
    for option, path, said in (
        ("--keep", nowhere, "does not exist"),
        ("--json", nowhere, "does not exist"),
        ("--report", tmp_path / "file", "is a file"),
        ("--report", tmp_path / "file" / "page", "cannot be made"),
        ("--keep", tmp_path / "motions.json", "cannot be read as kept checks"),
    ):
        answer = failuretwin("check", option, path)
        assert (answer.returncode, answer.stdout) == (2, "")
        assert said in answer.stderr
        assert answer.stderr.count("\n") == 1


def test_motions_are_written_and_nothing_moves(failuretwin, tmp_path):
    path, picture = tmp_path / "motions.json", tmp_path / "smallest" / "isolability.png"
    answer = failuretwin("check", "--seconds", 8, "--write", path)
    assert answer.returncode == 0, answer.stderr
    assert "nothing was moved" in answer.stdout
    target = np.array(json.loads(path.read_text())["target_rad"])
    robot = load_robot("armpi_fpv")
    counts = robot.servo_units.to_counts(target)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    said = failuretwin(
        "isolability", "--motions", path, "--report", picture.parent, "--json", tmp_path / "s",
        "--hypotheses", "motor_3:stuck,motor_3:steady_state_error,motor_4:steady_state_error",
    )  # fmt: skip
    assert said.returncode == 0, said.stderr
    assert "told from all others" in said.stdout
    again = failuretwin("check", "--write", path.with_suffix(".csv"), "--motions", path)
    assert again.returncode == 0, again.stderr
    only = ("--hypotheses", "motor_3:steady_state_error,healthy")
    assert "smallest fault shown" in failuretwin("isolability", *only).stdout  # of random ones
    tables = [
        failuretwin("isolability", "--motions", each, *only).stdout
        for each in (path, path.with_suffix(".csv"))
    ]
    assert tables[0] == tables[1]
    for suffix in (".bag", ".mcap"):
        bag, back = path.with_suffix(suffix), path.with_name(f"back{suffix}.json")
        for source, written in ((path, bag), (bag, back)):
            passed = failuretwin("check", "--motions", source, "--write", written)
            assert passed.returncode == 0, passed.stderr
        read, made = (json.loads(each.read_text()) for each in (back, path))
        for name in ("start_rad", "target_rad", "ramp_s"):
            np.testing.assert_allclose(read[name], made[name], atol=1e-6)
        np.testing.assert_allclose(read["seconds"][:-1], made["seconds"][:-1], atol=1e-6)
    said = failuretwin("isolability", "--motions", bag, *only)
    assert said.stdout == tables[0]
    assert picture.read_bytes().startswith(b"\x89PNG")
    rows = [json.loads(line) for line in (tmp_path / "s").read_text().splitlines()]
    sizes = {row["hypothesis"]: row["isolated"] for row in rows}
    assert 0.01 < sizes["motor_3:steady_state_error"] < 0.05


def test_a_log_of_a_check_made_elsewhere(failuretwin, tmp_path):
    runs = tmp_path / "runs.nc"
    made = failuretwin(
        "simulate", "--runs-per-class", 1, "--hypotheses", "healthy,motor_3:stuck", "--out", runs
    )
    assert made.returncode == 0, made.stderr
    out = tmp_path / "out.json"
    answer = failuretwin("check", "--log", runs, "--json", out)
    assert answer.returncode == 0, answer.stderr
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["truth"] for row in rows] == ["healthy", "motor_3:stuck"]
    assert rows[1]["motor"] == "motor_3"
    known = [row["shown_from"] is not None for row in rows[0]["motors"]]
    assert known == [rows[0]["light"] == "green"] * 4


def test_a_design_beside_random_movements(failuretwin):
    answer = failuretwin(
        "design", "--seconds", 8, "--movements", 4, "--hypotheses",
        "healthy,motor_3:steady_state_error,motor_4:steady_state_error",
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    assert "random, usual ranges" in answer.stdout
    assert "4 movements in" in answer.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("check", "--on", "ros3"), "expected emulated, ros1"),
        (("check", "--seconds", 0.2), "no safe movement"),
        (("check", "--fault", "motor_9:stuck"), "motor_9"),
        (("check", "--write", "motions.txt"), "expected .json, .csv, .mcap, .bag"),
        (("check", "--motions", "nothing.json"), "cannot be read as motions"),
        (("check", "--motions", "nothing.bag"), "cannot be read as motions"),
        (("check", "--motions", "nothing.json", "--seconds", 9), "leave out --seconds"),
        (("check", "--log", "some.nc", "--keep", "k.json", "--rest", 1), "out --keep and --rest"),
        (("check", "--log", "some.nc", "--motions", "m.json"), "leave out --motions"),
        (("check", "--write", "m.csv", "--json", "o"), "nothing is moved: leave out --json"),
        (("check", "--floor", 2.0), "--floor"),
        (("isolability", "--motions", "nothing.json"), "cannot be read as motions"),
    ],
)
def test_what_is_refused(failuretwin, arguments, said):
    answer = failuretwin(*arguments)
    assert answer.returncode == 2
    assert said in answer.stderr


def test_a_real_arm_is_left_alone_without_move(failuretwin):
    answer = failuretwin("check", "--seconds", 6, "--on", "rosbridge://localhost")
    assert answer.returncode == 0, answer.stderr
    assert "nothing moves without --move" in answer.stdout
