"""URDFs that others wrote, from the file to verdicts, each as a newcomer would go.

    python benchmarks/urdfs.py FOLDER [--tools benchmarks/urdf_tools.csv] [--runs-per-class 2]
        [--imperfections generic] [--timeout 300] [--csv FILE]

FOLDER holds URDFs, one for each arm; nothing else of an arm is needed. For each: `failuretwin robot
check`, `robot init`, `simulate` and `diagnose`, every command in a process of its own and ended
after --timeout seconds. Printed are the tool link that was chosen, the verdicts that are right and
what went wrong. --tools names the link that is right for an arm by the names that its maker gave,
judged by hand: columns `arm` and `tool`, several links of one body separated by blanks. A robot
with several arms has `asks` in the column `choice`: right is to ask, and `tool` is then said.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from failuretwin.decision.scoring import Share

ASKED = "several arms could carry the tool"


@dataclass(frozen=True)
class Expected:
    """What is right for an arm.

    Attributes:
        tools: Links that its maker means as the tool, the first to be named where asked.
        asks: Whether it has several arms, so that the right choice is to ask.
    """

    tools: tuple[str, ...]
    asks: bool


@dataclass(frozen=True)
class Tried:
    """How one URDF went.

    Attributes:
        arm: Name of the file.
        tool: Link that was chosen; "asked" where several arms could be meant.
        right_tool: Whether that is right; None where nobody has judged.
        motors: Motors that can be watched.
        runs: Simulated runs.
        right: Those with the right verdict.
        wrong: Truth and verdict of the others.
        seconds: Time of all commands [s].
        trouble: Last line of the command that failed; empty where none did.
        traceback: Whether any command ended in a traceback.
    """

    arm: str
    tool: str = ""
    right_tool: bool | None = None
    motors: int = 0
    runs: int = 0
    right: int = 0
    wrong: str = ""
    seconds: float = 0.0
    trouble: str = ""
    traceback: bool = False


@dataclass(frozen=True)
class Command:
    """Runs commands of failuretwin in a folder, each with a limit of its time."""

    folder: Path
    timeout_s: float

    def __call__(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command.

        Raises:
            subprocess.TimeoutExpired: If it takes longer than its limit.
        """
        return subprocess.run(
            [sys.executable, "-m", "failuretwin", *words],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=self.timeout_s,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )


def try_urdf(
    urdf: Path, expected: Expected | None, runs_per_class: int, imperfections: str, timeout_s: float
) -> Tried:
    """Take a URDF from the file to verdicts."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        command = Command(Path(folder), timeout_s)
        try:
            words = (str(runs_per_class), imperfections)
            tried = _try(urdf.resolve(), expected, words, command)
        except subprocess.TimeoutExpired as error:
            tried = Tried(urdf.stem, trouble=f"{error.cmd[3]}: longer than {timeout_s:.0f} s")
    return Tried(**asdict(tried) | {"seconds": time.monotonic() - start})


def _try(urdf: Path, expected: Expected | None, words: tuple[str, str], command: Command) -> Tried:
    arm, link = urdf.stem, []
    checked = command("robot", "check", str(urdf))
    asked = ASKED in checked.stdout + checked.stderr
    if asked and expected is not None:
        link = ["--tool", expected.tools[0]]
    steps = [
        ["robot", "init", str(urdf), "--out", "arm.toml", *link],
        [
            *("simulate", "--robot", "arm.toml", "--out", "runs.nc"),
            *("--runs-per-class", words[0], "--calibration", words[1]),
        ],
        ["diagnose", "runs.nc", "--robot", "arm.toml", "--json", "results.jsonl"],
    ]
    done = checked
    for step in steps:
        if done.returncode == 0 or (done is checked and asked):
            done = command(*step)
    profile = command.folder / "arm.toml"
    known = tomllib.loads(profile.read_text()) if profile.exists() else {}
    tool = "asked" if asked else str(known.get("tool_link", ""))
    results = command.folder / "results.jsonl"
    lines = results.read_text().splitlines() if results.exists() else []
    records = [json.loads(line) for line in lines]
    wrong = [f"{r['truth']}>{r['diagnosis']}" for r in records if r["truth"] != r["diagnosis"]]
    return Tried(
        arm,
        tool,
        None if expected is None else _is_right(expected, tool),
        len(known.get("motors", [])),
        len(records),
        len(records) - len(wrong),
        " ".join(wrong),
        trouble="" if done.returncode == 0 else (done.stderr.strip() or "?").splitlines()[-1],
        traceback="Traceback" in checked.stderr + done.stderr,
    )


def _is_right(expected: Expected, tool: str) -> bool:
    return tool == "asked" if expected.asks else tool in expected.tools


def read_expected(path: Path) -> dict[str, Expected]:
    """Return what is right for each arm of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return {
            row["arm"]: Expected(tuple(row["tool"].split()), row["choice"] == "asks")
            for row in csv.DictReader(file)
        }


def show(tried: Sequence[Tried]) -> None:
    """Print a line for each arm and the sums."""
    for t in tried:
        tool = {True: "right", False: "WRONG", None: "?"}[t.right_tool]
        print(
            f"{t.arm:28} {t.motors:2} motors  {t.tool:28} {tool:6} {t.right:3} of {t.runs:3} "
            f"{t.seconds:5.0f} s  {t.trouble or t.wrong}"
        )
    judged = [t for t in tried if t.right_tool is not None]
    print(f"{len(tried)} URDFs, {sum(t.traceback for t in tried)} tracebacks")
    print(f"failed: {' '.join(t.arm for t in tried if t.trouble) or 'none'}")
    _share("right tool", sum(bool(t.right_tool) for t in judged), len(judged))
    _share("right verdicts", sum(t.right for t in tried), sum(t.runs for t in tried))


def _share(name: str, right: int, of: int) -> None:
    if of:
        low, high = Share(right, of).interval
        print(f"{name}: {right} of {of}, 95 % interval {100 * low:.1f} to {100 * high:.1f} %")


def main() -> None:
    """Try the URDFs of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tools", type=Path)
    parser.add_argument("--runs-per-class", type=int, default=2)
    parser.add_argument("--imperfections", default="generic")
    parser.add_argument("--timeout", type=float, default=300.0)
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    known: Mapping[str, Expected] = {} if given.tools is None else read_expected(given.tools)
    tried = []
    for urdf in sorted(given.folder.glob("*.urdf")):
        expected = known.get(urdf.stem)
        plan = (given.runs_per_class, given.imperfections, given.timeout)
        tried.append(try_urdf(urdf, expected, *plan))
        show(tried[-1:]) if given.csv is None else _write(given.csv, tried)
    show(tried)


def _write(path: Path, tried: Sequence[Tried]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, list(asdict(tried[0])))
        rows.writeheader()
        rows.writerows(asdict(t) for t in tried)


if __name__ == "__main__":
    main()
