"""Whatever is wrong with an input: exit code 2, one clear message, nothing half-written."""

from __future__ import annotations

import os

import pytest

from failuretwin.data_knowledge.store import load_run_set, save_run_set

COMMAND, DURATION, POSITION = (
    "trajectory_monitoring_cmd.csv",
    "trajectory_monitoring_cmd_duration.csv",
    "trajectory_monitoring_position.csv",
)


@pytest.fixture
def refused(failuretwin, tmp_path, listing):
    """Run a command that must fail; return its message."""

    def run(*arguments, disk_full=False):
        before = listing(tmp_path)
        answer = failuretwin(*arguments, folder=tmp_path, disk_full=disk_full)
        assert "Traceback" not in answer.stderr
        assert answer.returncode == 2, answer.stderr
        assert "Warning" not in answer.stderr
        assert listing(tmp_path) == before
        return answer.stderr

    return run


@pytest.fixture
def refused_input(refused):
    """Give an input to `diagnose` and `import`, which both refuse it in one and the same line."""

    def run(source):
        message = refused("diagnose", source, "--json", "out.jsonl", "--csv", "out.csv")
        assert message == refused("import", source, "--out", "out.nc")
        assert message.startswith("error: ")
        assert len(message.splitlines()) == 1
        return message

    return run


def test_missing_path(refused_input):
    assert "nowhere: does not exist" in refused_input("nowhere")


def test_folder_without_sessions(refused_input, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "no log in it or below" in refused_input("empty")


def test_session_with_two_of_three_files(refused_input, tmp_path, write_session):
    (write_session(tmp_path / "log") / DURATION).unlink()
    assert f"missing: {DURATION}" in refused_input("log")


def rewrite(path, change):
    path.write_text(change(path.read_text()))


def swap_rows(text):
    lines = text.splitlines()
    lines[3], lines[4] = lines[4], lines[3]
    return "\n".join(lines) + "\n"


def glitch_everywhere(text):
    header, *rows = text.splitlines()
    return "\n".join([header, *(row.split(",")[0] + ",32000" * 6 for row in rows)]) + "\n"


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (COMMAND, lambda t: t.replace("motor_6", "motor6"), ["column 'motor_6'", "'motor6'"]),
        (POSITION, lambda t: t.replace(",500.0\n", ",fast\n", 1), ["line 2", "'fast'", "number"]),
        (POSITION, lambda t: "", ["is empty"]),
        (POSITION, swap_rows, ["time runs backwards", "line 5"]),
        (POSITION, glitch_everywhere, ["no reading", "0 to 1000"]),
        (POSITION, lambda t: '"' + t, ["cannot be read as CSV"]),
    ],
    ids=["missing column", "text", "empty file", "backwards", "glitches", "broken quote"],
)
def test_session_that_cannot_be_used(refused_input, tmp_path, write_session, file, change, words):
    rewrite(write_session(tmp_path / "log") / file, change)
    message = refused_input("log")
    assert f"log/{file}" in message
    for word in words:
        assert word in message


def test_session_that_ends_before_its_first_movement_does(refused_input, tmp_path, write_session):
    write_session(tmp_path / "log", until_s=0.5)
    assert "one whole movement at least" in refused_input("log")


def test_run_set_without_measured(refused_input, tmp_path, simulated):
    save_run_set(load_run_set(simulated).drop_vars("measured"), tmp_path / "runs.nc")
    message = refused_input("runs.nc")
    assert "no variable `measured`" in message
    assert "command" in message


@pytest.mark.parametrize("name", ["junk.nc", "junk.mat", "junk.csv"])
@pytest.mark.parametrize("content", [b"", b"junk\x00\xff" * 50], ids=["empty", "junk"])
def test_files_of_something_else(refused_input, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert name in refused_input(name)


def test_unknown_robot(refused, simulated):
    message = refused("diagnose", simulated, "--robot", "armpi_fvp")
    assert "unknown robot 'armpi_fvp'. Did you mean 'armpi_fpv'?" in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["diagnose", "--hypothesis", "healthy"], "Did you mean '--hypotheses'?"),
        (["evaluat"], "Did you mean 'evaluate'?"),
        (["diagnose"], "Missing argument"),
        (["diagnose", "x", "--as", "seen"], "'seen' is not one of 'measured', 'published'"),
        (["simulate", "--out", "x.nc", "--runs-per-class", "0"], "0 is not in the range"),
        (["simulate", "--out", "x.nc", "--workers", "many"], "'many' is not a valid integer"),
    ],
    ids=["option", "verb", "no input", "choice", "range", "text"],
)
def test_misspelt_command_line(refused, arguments, words):
    assert words in refused(*arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sse-range", "20", "5"], "--sse-range is 20 5, expected 0 <= LOW < HIGH"),
        (["--sse-range", "0", "inf"], "--sse-range"),
        (["--sse-range", "10", "1001"], "turn through 1000 servo units (240 deg)"),
        (["--onset", "-1"], "--onset is -1 s, expected 0 or more"),
        (["--hypotheses", "motor_9:stuck"], "unknown motor 'motor_9'"),
        (["--hypotheses", "motor_1:stuk"], "Did you mean 'stuck'?"),
        (["--hypotheses", "healthy,healthy"], "given twice"),
        (["--hypotheses", ""], "Expected 'healthy', 'unknown', a fault such as"),
        (["--hypotheses", "pairs"], "several joined by '+'"),
        (["--hypotheses", "all"], "encoder_scale, lost_commands."),
        (["--hypotheses", "stuck"], "such as 'motor_1:stuck'"),
        (["--hypotheses", "motor_1:stuck"], "names only motor_1:stuck, so every run"),
        (["--published-labels", "--truth", "x"], "No such option '--truth'"),
    ],
)
def test_options_that_make_no_sense(refused, simulated, arguments, words):
    assert words in refused("diagnose", simulated, *arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--hypotheses", "unknown"], "'unknown' cannot be simulated"),
        (["--hypotheses", "motor_2:torque_loss"], "'motor_2:torque_loss' would not show"),
        (["--faults", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["--calibration", "armpi"], "no imperfections 'armpi'"),
        (["--out", "x.h5"], "ends in .nc"),
        (["--out", "nowhere/x.nc"], "folder nowhere does not exist"),
    ],
)
def test_what_cannot_be_simulated(refused, arguments, words):
    assert words in refused("simulate", "--out", "x.nc", "--runs-per-class", 1, *arguments)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[drfit]\n", "unknown fault mode 'drfit'. Did you mean 'drift'?"),
        ("drift = 3\n", "drift is 3, expected a table"),
        ("[drift]\nrate = [0, 1]\n", "drift: unknown key 'rate'"),
        ("[drift]\nmagnitude = 0.1\n", "drift: magnitude is 0.1, expected a list"),
        ("[lag]\nmagnitude = [0.3, 0.1]\n", "lag: magnitude is [0.3, 0.1], expected two numbers"),
        ("[stuck]\nprofiles = ['ramp']\n", "stuck: unknown profile 'ramp'"),
        ("[drift\n", "not a TOML file"),
    ],
)
def test_distributions_of_faults_that_cannot_be_used(refused, tmp_path, text, words):
    (tmp_path / "faults.toml").write_text(text)
    message = refused("simulate", "--out", "x.nc", "--faults", "faults.toml")
    assert "faults.toml: " in message
    assert words in message


@pytest.fixture(scope="module")
def one_run(simulated, tmp_path_factory):
    """One of the simulated runs, with the two hypotheses that are weighed."""
    path = tmp_path_factory.mktemp("one") / "run.nc"
    save_run_set(load_run_set(simulated).isel(run=[0]), path)
    return path, "--hypotheses", "healthy,motor_1:stuck"


OUTPUTS = pytest.mark.parametrize(
    ("option", "name"), [("--json", "x.jsonl"), ("--csv", "x.csv"), ("--report", "pictures")]
)


@OUTPUTS
def test_results_that_go_below_a_file(refused, tmp_path, one_run, option, name):
    (tmp_path / "file").write_text("mine")
    assert f"file/{name}" in refused("diagnose", *one_run, option, f"file/{name}")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(("option", "name"), [("--json", "x.jsonl"), ("--csv", "x.csv")])
def test_results_that_go_to_a_missing_folder(refused, one_run, option, name):
    message = refused("diagnose", *one_run, option, f"nowhere/{name}")
    assert "folder nowhere does not exist" in message


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not hold back root")
@OUTPUTS
def test_results_that_go_to_a_folder_that_is_not_writable(refused, tmp_path, one_run, option, name):
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "locked" in refused("diagnose", *one_run, option, f"locked/{name}")


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
@pytest.mark.usefixtures("simulated")  # compiles the loops, which a full disk cannot keep
def test_full_disk_while_simulating(refused, suffix):
    asked = ("--out", f"x{suffix}", "--runs-per-class", 1, "--calibration", "armpi_fpv")
    message = refused("simulate", *asked, disk_full=True)
    assert f"x{suffix}: could not be written (File too large)" in message


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_full_disk_keeps_the_old_run_set(refused, tmp_path, simulated, suffix):
    old = load_run_set(simulated).isel(run=slice(0, 1))
    save_run_set(old, tmp_path / f"x{suffix}")
    refused("import", simulated, "--out", f"x{suffix}", disk_full=True)
    assert load_run_set(tmp_path / f"x{suffix}").identical(old)


@OUTPUTS
def test_full_disk_while_writing_results(refused, one_run, option, name):
    message = refused("diagnose", *one_run, option, name, disk_full=True)
    assert name in message
    assert "could not be written (File too large)" in message


@pytest.mark.parametrize(
    "text",
    [
        "",
        "run,truth\n",
        "[1]\n",
        '{"run": "a", "truth": "healthy"}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "healthy", "posterior": 3}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "b", "posterior": {"healthy": 1.0}}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "healthy", "posterior": {"healthy": "x"}}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "healthy", "posterior": {"healthy": 0.5}}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "healthy", "posterior": {"healthy": NaN}}\n',
        '{"run": "a", "truth": 0, "diagnosis": "healthy", "posterior": {"healthy": 1.0}}\n',
        '{"run": "a", "truth": "healthy", "diagnosis": "healthy", "posterior": {"healthy": 1.0}, '
        '"onset_90": 1.0}\n',
    ],
    ids=[
        "empty",
        "csv",
        "list",
        "keys missing",
        "number",
        "unknown diagnosis",
        "text",
        "sum",
        "not a number",
        "truth",
        "interval",
    ],
)
def test_results_that_cannot_be_evaluated(refused, tmp_path, text):
    (tmp_path / "results.jsonl").write_text(text)
    assert "results.jsonl: " in refused("evaluate", "results.jsonl")
