"""How many small faults in the inference the tests notice: mutation testing.

Numbers, operators, comparisons, functions, signs, terms and statements of the inference are changed
one at a time in a copy of `src` (`mutants.py`), and the tests of the area run until the first one
fails. A mutant that survives is a fault that no test would notice, unless it means the same: that
is for the reader to judge.

A warm parent imports the libraries once and forks for every mutant; the package itself is imported
anew by each. A mutant under which the tests hang counts as killed.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import scipy.stats
from mutants import Mutant, find_mutants

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = "src/failuretwin"
WARM = ("scipy.integrate", "scipy.optimize", "scipy.special", "h5netcdf", "xarray")
"""Libraries that every fork has without importing them again."""
GOLDEN = "tests/golden"
"""Stored posteriors; the first to run, where they are there."""
AREAS: dict[str, tuple[str, ...]] = {
    "inference/observation/log_quality.py": ("tests/data_knowledge/test_log_quality.py",),
    "inference/observation/readings.py": ("tests/data_knowledge/test_true_readings.py",),
    "inference/observation/sensors.py": ("tests/decision/test_sensing.py",),
    "inference/observation/on_the_way.py": ("tests/inference/engine/test_on_the_way.py",),
    "inference/observation": (
        "tests/data_knowledge/test_settled_evidence.py",
        "tests/data_knowledge/test_moving_evidence.py",
        "tests/connection/test_alternatives.py",
        "tests/connection/test_losses_in_a_row.py",
        "tests/connection/test_late_starts.py",
        "tests/connection/test_healthy.py",
        "tests/decision/test_start_delay.py",
        "tests/decision/test_inference_settings.py",
        "tests/decision/test_likelihood_terms.py",
        "tests/decision/test_rounding.py",
    ),
    "inference/engine": (
        "tests/inference/engine",
        "tests/decision/test_shared_unknowns.py",
        "tests/decision/test_shared_posterior.py",
        "tests/decision/test_folder_posterior.py",
        "tests/connection/test_life_filter.py",
    ),
    "inference/together": (
        "tests/decision/test_fault_course.py",
        "tests/decision/test_mixed_runs.py",
        "tests/decision/test_fault_filter.py",
        "tests/decision/test_folder_posterior.py",
        "tests/connection/test_life_filter.py",
    ),
    "inference/set_up*": (
        "tests/decision/test_clock.py",
        "tests/decision/test_wrong_setup.py",
        "tests/connection/test_registration.py",
        "tests/decision/test_set_ups.py",
    ),
    "inference/explanation.py": ("tests/decision/test_wording.py",),
    "inference/faults/unknown.py": ("tests/decision/test_unknown.py",),
    "inference/isolability.py": (
        "tests/decision/test_separation.py",
        "tests/decision/test_isolability.py",
        "tests/decision/test_isolability_on_the_way.py",
    ),
    "inference/expected_bayes_factors.py": (
        "tests/decision/test_separation.py",
        "tests/decision/test_isolability.py",
    ),
    "inference": (
        "tests/decision/test_law.py",
        "tests/decision/test_onsets.py",
        "tests/decision/test_size_nodes.py",
        "tests/decision/test_likelihood_stuck.py",
        "tests/decision/test_likelihood_terms.py",
        "tests/decision/test_likelihood_way.py",
        "tests/decision/test_motor_profile.py",
        "tests/decision/test_healthy_density.py",
        "tests/decision/test_ramps.py",
        "tests/decision/test_laws.py",
        "tests/decision/test_off_anyhow.py",
        "tests/decision/test_pairs.py",
        "tests/decision/test_bayes.py",
    ),
    "connection/self_calibration.py": ("tests/connection/test_self_calibration.py",),
    "digital_model/arm_classes.py": ("tests/digital_model/test_arm_classes.py",),
    "connection/tracked_diagnosis.py": ("tests/connection/test_life_history.py",),
    "connection/calibration/step_*.py": ("tests/connection/test_step_fit.py",),
    "connection/calibration/servo_loops.py": ("tests/connection/test_step_fit.py",),
    "connection/calibration": (
        "tests/connection/test_calibration_intervals.py",
        "tests/connection/test_calibration_parts.py",
    ),
}
"""Files and folders of the inference, as patterns inside the package, and the tests of each,
cheapest first; of a file that two patterns name, the first."""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant.

    Attributes:
        mutant: The mutant.
        killed: Whether a test failed.
        how: `failed`, `hung`, `died` or `survived`.
        by: The test that failed, where one did.
        seconds: How long it took [s].
    """

    mutant: Mutant
    killed: bool
    how: str
    by: str
    seconds: float


def all_sites(patterns: Sequence[str]) -> list[list[Mutant]]:
    """Return all changes at each place of the files that patterns name.

    Args:
        patterns: Files and folders inside the package, as in `AREAS`.
    """
    sites = []
    for path in sorted({path for pattern in patterns for path in _files(pattern)}):
        file = str(path.relative_to(REPOSITORY))
        sites += find_mutants(file, path.read_bytes())
    return sites


def _files(pattern: str) -> Iterator[Path]:
    for found in (REPOSITORY / PACKAGE).glob(pattern):
        yield from [found] if found.is_file() else found.rglob("*.py")


def sample(sites: Sequence[Sequence[Mutant]], count: int, seed: int) -> list[Mutant]:
    """Return some mutants: places drawn without return, and one change of each.

    Args:
        sites: All changes at each place.
        count: How many; all places, if there are fewer.
        seed: Of the draw.
    """
    rng = random.Random(seed)
    chosen = rng.sample(list(sites), min(count, len(sites)))
    return [rng.choice(list(site)) for site in chosen]


def tests_of(file: str, full: bool) -> list[str]:
    """Return the tests to run for a file, cheapest first.

    Args:
        file: The file, relative to the repository.
        full: Whether all others follow.
    """
    path = REPOSITORY / file
    tests = [GOLDEN] if (REPOSITORY / GOLDEN).exists() else []
    for pattern, of_area in AREAS.items():
        if path in _files(pattern):
            tests += of_area
            break
    return list(dict.fromkeys([*tests, *(["tests"] if full else [])]))


class Bench:
    """A copy of the package in which one file at a time is changed, and tests run on it."""

    def __init__(self, folder: Path) -> None:
        """Copy the package.

        Args:
            folder: An empty folder.
        """
        self.copy, self.log = folder / "src", folder / "log.txt"
        self.scratch = folder / "scratch"
        self.scratch.mkdir()
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / "src", self.copy, ignore=ignore)

    def run(self, tests: Sequence[str], timeout_s: float | None) -> tuple[str, str]:
        """Return how tests ended, and the test that failed first.

        Args:
            tests: Files and folders of tests.
            timeout_s: How long they may take [s]; None: as long as they need.

        Returns:
            `survived` if all passed, else `failed`, `hung` or `died`.
        """
        process = multiprocessing.get_context("fork").Process(target=self._child, args=(tests,))
        process.start()
        try:
            process.join(timeout_s)
            hung = process.is_alive()
        finally:  # whatever the tests have started ends with them
            if process.pid is not None:
                with suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.join()
        if hung:
            return "hung", ""
        if process.exitcode == 0:
            return "survived", ""
        lines = self.log.read_text(errors="replace").splitlines()
        failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
        by = failed[0].split(" - ")[0].split(" ", 1)[1] if failed else ""
        return ("failed" if process.exitcode in (1, 2) else "died"), by

    def _child(self, tests: Sequence[str]) -> None:
        """Run tests on the copy; what they print goes to the log."""
        os.setsid()
        with self.log.open("wb") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        os.chdir(REPOSITORY)
        before = [os.environ["PYTHONPATH"]] if os.environ.get("PYTHONPATH") else []
        os.environ["PYTHONPATH"] = os.pathsep.join([str(self.copy), *before])
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = str(self.scratch / "hypothesis")
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(self.copy))
        spec = importlib.util.find_spec("failuretwin")
        if spec is None or not str(spec.origin).startswith(str(self.copy)):
            os._exit(70)
        temporary = f"--basetemp={self.scratch / 'tests'}"
        quick = ["-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", temporary]
        code = pytest.main([*quick, *tests])
        sys.stdout.flush()
        os._exit(int(code))

    def judge(self, mutant: Mutant, tests: Sequence[str], timeout_s: float) -> Outcome:
        """Return what becomes of a mutant."""
        file = self.copy.parent / mutant.file
        source, began = file.read_bytes(), time.monotonic()
        try:
            file.write_bytes(mutant.applied_to(source))
            how, by = self.run(tests, timeout_s)
        finally:
            file.write_bytes(source)
        return Outcome(mutant, how != "survived", how, by, time.monotonic() - began)


def usual_seconds(bench: Bench, suites: Sequence[tuple[str, ...]]) -> dict[tuple[str, ...], float]:
    """Return how long suites of tests take on the package as it is [s].

    Raises:
        SystemExit: If one of them fails: nothing can be told of mutants then.
    """
    seconds = {}
    for suite in suites:
        began = time.monotonic()
        how, by = bench.run(suite, None)
        if how != "survived":
            sys.exit(f"the tests {how} without any mutant {by}\n{bench.log.read_text()[-3000:]}")
        seconds[suite] = time.monotonic() - began
        _say(f"as it is: {seconds[suite]:.0f} s for {' '.join(suite)}")
    return seconds


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def report(outcomes: Sequence[Outcome]) -> str:
    """Return survivors and the score, in words."""
    lines = []
    for outcome in outcomes:
        if not outcome.killed:
            mutant = outcome.mutant
            source = (REPOSITORY / mutant.file).read_bytes()
            lines += [f"survived: {mutant.file}:{mutant.line} ({mutant.kind})", mutant.diff(source)]
    killed = sum(outcome.killed for outcome in outcomes)
    low, high = score_interval(outcomes)
    lines.append(
        f"{killed} of {len(outcomes)} mutants killed: {killed / len(outcomes):.1%} "
        f"(95 % Wilson interval {low:.1%} to {high:.1%})"
    )
    return "\n".join(lines)


def score_interval(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Return the 95 % Wilson interval of the share of mutants that are killed."""
    killed = sum(outcome.killed for outcome in outcomes)
    found = scipy.stats.binomtest(killed, len(outcomes)).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def main() -> None:
    """Sample mutants, run the tests on each and say which survive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="how many mutants (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--package", nargs="+", default=list(AREAS), metavar="PATH",
        help=f"files and folders inside {PACKAGE} (default: all of the inference)",
    )  # fmt: skip
    parser.add_argument("--full", action="store_true", help="run all other tests after the usual")
    parser.add_argument("--timeout", type=float, help="seconds for each (default: 3 times + 20)")
    parser.add_argument("--json", type=Path, help="write all outcomes")
    options = parser.parse_args()
    sites = all_sites(options.package)
    mutants = sample(sites, options.count, options.seed)
    if not mutants:
        sys.exit(f"nothing to change in {' '.join(options.package)} of {PACKAGE}")
    _say(f"{len(mutants)} of {len(sites)} places")
    for library in WARM:
        importlib.import_module(library)
    suites = {mutant: tuple(tests_of(mutant.file, options.full)) for mutant in mutants}
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        usual = usual_seconds(bench, sorted(set(suites.values())))
        for number, (mutant, suite) in enumerate(suites.items(), start=1):
            limit = options.timeout or 3.0 * usual[suite] + 20.0
            outcomes.append(outcome := bench.judge(mutant, suite, limit))
            _say(
                f"[{number}/{len(suites)}] {outcome.how:8} {outcome.seconds:5.1f} s  "
                f"{mutant.file}:{mutant.line} ({mutant.kind})  {outcome.by}"
            )
    print(report(outcomes))
    if options.json is not None:
        low, high = score_interval(outcomes)
        text = json.dumps(
            {"low": low, "high": high, "outcomes": [asdict(o) for o in outcomes]}, indent=1
        )
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
