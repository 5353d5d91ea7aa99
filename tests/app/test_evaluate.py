"""`failuretwin evaluate` on results whose scores can be worked out by hand."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from failuretwin.app.reports.reports import escaped, latex
from failuretwin.app.terminal import Table
from failuretwin.core.runs import RunTable, Truth
from failuretwin.data_knowledge.store import save_run_set

STUCK, DRIFT = "motor_1:stuck", "motor_2:drift"
NAMES = ("healthy", STUCK, DRIFT)


def record(run, truth, said, sure=0.8, **more):
    """A diagnosis that gives `sure` to what it says and the rest to the others alike."""
    posterior = {name: sure if name == said else (1 - sure) / 2 for name in NAMES}
    return {
        "run": run,
        "truth": truth,
        "diagnosis": said,
        "posterior": posterior,
        "protocol": "P0",
        **more,
    }


def with_unknown(records, said):
    """Return diagnoses that offer healthy, a stuck motor and `unknown`, which is `said` of runs."""
    for told in records:
        best = "unknown" if told["run"] in said else "healthy"
        sure = {name: 0.8 if name == best else 0.1 for name in ("healthy", STUCK, "unknown")}
        yield {**told, "diagnosis": best, "posterior": sure, "onset_90": [0.0, 0.5]}


RECORDS = [
    record("a", "healthy", "healthy"),
    record("b", "healthy", STUCK),
    record("c", STUCK, STUCK, onset_90=[1.0, 2.0], magnitude_90=[0.1, 0.3]),
    record("d", STUCK, STUCK, onset_90=[1.0, 2.0], magnitude_90=[0.1, 0.3]),
    record("e", DRIFT, "healthy"),
    {**record("f", DRIFT, DRIFT, sure=1 / 3), "diagnosis": None},
]


@pytest.fixture
def folder(tmp_path):
    def write(name, records):
        (tmp_path / name).write_text("".join(json.dumps(r) + "\n" for r in records))

    write("ours.jsonl", RECORDS)
    better = [record(r["run"], r["truth"], r["truth"], sure=0.9) for r in RECORDS]
    write("better.jsonl", better[::-1])  # runs are matched by name
    write("unknown.jsonl", with_unknown(RECORDS, said="e"))
    write("fewer.jsonl", RECORDS[:4])
    write("twice.jsonl", [*RECORDS, RECORDS[0]])
    write("numbered.jsonl", [*RECORDS, {**RECORDS[0], "run": "a#2"}])
    write("stranger.jsonl", [*RECORDS, {**RECORDS[0], "run": "z#2"}])
    write("other.jsonl", [*RECORDS[:5], {**RECORDS[5], "truth": STUCK}])
    write("bare.jsonl", [{k: v for k, v in r.items() if k != "truth"} for r in RECORDS])
    write("certain.jsonl", [record(r["run"], r["truth"], "healthy", sure=1.0) for r in RECORDS])
    hopeless = {"healthy": STUCK, STUCK: DRIFT, DRIFT: "healthy"}
    write(
        "hopeless.jsonl", [record(r["run"], r["truth"], hopeless[r["truth"]], 1.0) for r in RECORDS]
    )
    known = Truth(
        fault=[r["truth"] for r in RECORDS],
        detail=[{}] * 6,
        onset=np.array([np.nan, np.nan, 1.5, 2.5, 0.0, 0.0]),
        magnitude=np.array([np.nan, np.nan, 0.2, 0.3, 0.1, np.nan]),
    )
    runs = RunTable(
        run=[r["run"] for r in RECORDS],
        motor=["motor_1"],
        time=np.arange(5.0),
        command=np.zeros((6, 5, 1)),
        measured=np.zeros((6, 5, 3)),
        measured_rate_hz=1.0,
        truth=known,
    )
    save_run_set(runs.to_dataset(), tmp_path / "runs.nc")
    return tmp_path


@pytest.fixture
def evaluate(failuretwin, folder):
    def run(*arguments):
        return failuretwin("evaluate", *arguments, folder=folder)

    return run


def line_of(text, name):
    """Return the last line that begins with `name`, its spaces made single."""
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [line for line in lines if line.startswith(name)][-1]


def test_all_scores_are_printed(evaluate):
    answer = evaluate("ours.jsonl")
    assert answer.returncode == 0, answer.stderr
    assert answer.stderr == ""
    text = answer.stdout
    assert "3 of 6 runs right: accuracy 50.0 % (95 % interval 18.8 to 81.2 %), protocol P0" in text
    # F1: healthy 2 / (2 + 2), stuck 4 / (2 + 3), drift 0
    assert line_of(text, "macro-F1").startswith(f"macro-F1 {(0.5 + 0.8 + 0) / 3:.3f}")
    assert "50.0 %" in line_of(text, "false-alarm rate")
    assert "1 of 2 runs" in line_of(text, "false-alarm rate")
    missed = line_of(text, "missed-detection rate")
    assert "2 of 4 runs" in missed
    assert missed.endswith("1 without a verdict, which is no alarm")
    nats = -(3 * np.log(0.8) + 2 * np.log(0.1) + np.log(1 / 3)) / 6
    assert line_of(text, "log score") == f"log score {nats:.3f} nats a run"
    brier = (3 * (0.04 + 0.02) + 2 * (0.64 + 0.01 + 0.81) + (4 + 1 + 1) / 9) / 6
    assert line_of(text, "Brier score").startswith(f"Brier score {brier:.3f}")
    # five runs with a verdict, each 80 % sure, three of them right
    assert line_of(text, "calibration error").startswith("calibration error 0.200 in 10 bins")
    assert line_of(text, "0.7 to 0.8").startswith("0.7 to 0.8 5 0.800 0.600")
    assert "give --truth RUNS" in text


def test_coverage_needs_the_true_values(evaluate):
    text = evaluate("ours.jsonl", "--truth", "runs.nc").stdout
    assert line_of(text, "onset of stuck") == "onset of stuck 2 50.0 % 9.5 to 90.5 % 0 1 0"
    assert line_of(text, "magnitude of stuck").startswith("magnitude of stuck 2 100.0 %")
    assert "--truth" not in text


def test_a_truth_that_was_always_ruled_out_leaves_no_other_runs(evaluate):
    text = evaluate("hopeless.jsonl").stdout
    line = line_of(text, "0 of 6 runs right")
    assert line.endswith("log score inf nats a run (the truth was given no probability in any run)")


def test_results_are_compared_run_by_run(evaluate):
    text = evaluate("ours.jsonl", "--against", "better.jsonl").stdout
    assert line_of(text, "A: ") == "A: ours.jsonl (protocol P0)"
    right = "right: both 3, only A 0, only B 3, neither 0; exact McNemar p = 0.25"
    assert line_of(text, "right: ") == right
    gain = -(3 * np.log(0.8) + 2 * np.log(0.1) + np.log(1 / 3)) / 6 + np.log(0.9)
    line = line_of(text, "log score, A minus B, 6 runs: ")
    assert f"{gain:+.3f} nats a run" in line
    assert line.endswith("B is better")


def test_a_truth_that_was_ruled_out_is_said(evaluate):
    text = evaluate("ours.jsonl", "--against", "certain.jsonl").stdout
    assert line_of(text, "truth given no") == (
        "truth given no probability: only by A in 0 runs, only by B in 4, by both in 0"
    )
    assert line_of(text, "log score, A minus B, all") == (
        "log score, A minus B, all runs: -inf nats a run"
    )
    alone = evaluate("certain.jsonl").stdout
    assert "log score inf nats a run (of 4 runs the truth was given no probability" in alone


def test_a_fault_that_is_no_hypothesis_is_judged_as_unknown(evaluate, folder):
    arguments = ("--truth", "runs.nc", "--latex", "x.tex", "--against", "ours.jsonl")
    text = evaluate("unknown.jsonl", *arguments).stdout
    # of both runs that drift, the first is called unknown
    assert "2 of 6 runs right" not in text
    assert "3 of 6 runs right" in text
    assert line_of(text, "judged as unknown, since") == (
        "judged as unknown, since not among the hypotheses: motor_2:drift (2 runs)"
    )
    nats = -(3 * np.log(0.8) + 3 * np.log(0.1)) / 6
    assert line_of(text, "log score ") == f"log score {nats:.3f} nats a run"
    assert "unknown 2 1.000 0.500 0.667" in " ".join(text.split())
    assert "motor_2:drift 2" not in " ".join(text.split())
    # all six are 80 % sure, three are right
    assert line_of(text, "calibration error").startswith("calibration error 0.300 in 10 bins")
    assert line_of(text, "onset of unknown").startswith("onset of unknown 1 100.0 %")
    assert line_of(text, "missed-detection").startswith("missed-detection rate 75.0 %")
    # the other result, without `unknown`, is judged as it names things itself
    assert line_of(text, "right: ").startswith("right: both 1, only A 2, only B 2, neither 1")
    assert line_of(text, "judged as unknown: ").startswith("judged as unknown: by A 2 runs, by B 0")
    table = (folder / "x.tex").read_text()
    assert r"unknown & 2 & 1.000 & 0.500 & 0.667 \\" in table
    assert "judged as unknown & 2 runs" in table


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ours.jsonl", "--against", "fewer.jsonl"], "fewer.jsonl: lacks 2 runs of ours.jsonl (e"),
        (["fewer.jsonl", "--against", "ours.jsonl"], "fewer.jsonl: lacks 2 runs of ours.jsonl (e"),
        (["ours.jsonl", "--against", "twice.jsonl"], "twice.jsonl: a given twice"),
        (["twice.jsonl"], "twice.jsonl: a given twice. Expected each run once: remove"),
        (["numbered.jsonl", "--truth", "runs.nc"], "It holds 'a'; diagnose numbers runs"),
        (["stranger.jsonl", "--truth", "runs.nc"], "Expected the runs that were diagnosed"),
        (["ours.jsonl", "--against", "other.jsonl"], "run 'f' is motor_1:stuck there, but motor_2"),
        (["ours.jsonl", "--against", "nowhere.jsonl"], "nowhere.jsonl: cannot be read"),
        (["ours.jsonl", "--published-labels"], "the truth are given: leave out --published-labels"),
        (["bare.jsonl"], "bare.jsonl: no run says what was true. Give a run set that does with"),
        (["ours.jsonl", "--truth", "nowhere.nc"], "nowhere.nc: does not exist"),
        (["ours.jsonl", "--latex", "nowhere/x.tex"], "folder nowhere does not exist"),
    ],
)
def test_what_cannot_be_evaluated(evaluate, folder, listing, arguments, words):
    before = listing(folder)
    answer = evaluate(*arguments)
    assert answer.returncode == 2
    assert words in answer.stderr
    assert len(answer.stderr.splitlines()) == 1
    assert answer.stdout == ""
    assert listing(folder) == before


def test_tables_for_a_paper(evaluate, folder):
    arguments = ("--truth", "runs.nc", "--against", "better.jsonl", "--latex", "x.tex")
    assert evaluate("ours.jsonl", *arguments).returncode == 0
    text = (folder / "x.tex").read_text()
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 4
    for rule in ("toprule", "midrule", "bottomrule"):
        assert text.count(rf"\{rule}") == 4
    assert r"motor\_2:drift & 2 & -- & 0.000 & 0.000 \\" in text
    assert r"onset of stuck & 2 & 50.0 \% & 9.5 to 90.5 \% \\" in text
    assert "exact McNemar p = 0.25" in text
    for number, line in enumerate(text.splitlines()[1:], start=2):
        assert not re.search(r"(?<!\\)[%_#$^~]", line), f"line {number} is not escaped"


def test_every_letter_that_latex_reads_as_a_command_is_escaped():
    assert escaped("a_b & 5 %") == r"a\_b \& 5 \%"
    assert escaped("\\{~^}$#") == r"\textbackslash{}\{\textasciitilde{}\textasciicircum{}\}\$\#"
    assert latex(Table(("a_b", "n"), [("x", "1")], "lr")).splitlines() == [
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"a\_b & n \\",
        r"\midrule",
        r"x & 1 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_a_picture_of_the_reliability(evaluate, folder):
    assert evaluate("ours.jsonl", "--report", "deep/pictures").returncode == 0
    (picture,) = (folder / "deep" / "pictures").iterdir()
    assert picture.name == "reliability.png"
    assert picture.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_results_need_no_truth_where_runs_tell_it(evaluate):
    told = evaluate("bare.jsonl", "--truth", "runs.nc", "--against", "better.jsonl")
    assert (told.returncode, told.stderr) == (0, "")
    full = evaluate("ours.jsonl", "--truth", "runs.nc", "--against", "better.jsonl")
    assert told.stdout.replace("bare.jsonl", "ours.jsonl") == full.stdout


def test_truth_may_come_from_raw_sessions(failuretwin, write_session, tmp_path):
    write_session(tmp_path / "logs" / "20240101_label_0", seed=1)
    write_session(tmp_path / "logs" / "20240102_label_3", seed=2)
    among = ("--hypotheses", "healthy,motor_3:stuck", "--json", "told.jsonl")
    told = failuretwin("diagnose", "logs", "--published-labels", *among, folder=tmp_path)
    assert told.returncode == 0, told.stderr
    records = [json.loads(line) for line in (tmp_path / "told.jsonl").read_text().splitlines()]
    untold = "".join(json.dumps({**r, "truth": None}) + "\n" for r in records)
    (tmp_path / "untold.jsonl").write_text(untold)

    answer = failuretwin(
        *("evaluate", "untold.jsonl", "--truth", "logs", "--published-labels"), folder=tmp_path
    )
    assert answer.returncode == 0, answer.stderr
    again = failuretwin("evaluate", "told.jsonl", folder=tmp_path)
    assert answer.stdout.startswith(again.stdout[: again.stdout.index("coverage")])
    unread = failuretwin("evaluate", "untold.jsonl", "--truth", "logs", folder=tmp_path)
    assert unread.returncode == 2
    assert "add --published-labels" in unread.stderr
