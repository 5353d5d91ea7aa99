"""Peak memory and speed of `diagnose --parquet`, from two thousand runs up, by number of workers.

Memory should stay flat: runs are read, diagnosed and written piece by piece. Every figure comes
from a process of its own. To keep it short, runs have two movements, hypotheses are two, and the
set-up is taken as known; `--full` diagnoses runs of five movements by the usual nine hypotheses.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import failuretwin as ft
from failuretwin.data_knowledge.resumable import produce
from failuretwin.data_knowledge.run_pieces import RunPieces
from failuretwin.decision.chunked_diagnosis import diagnose_to_parquet
from failuretwin.failure_behavior.random_movements import RandomMovements

SIZES = (2_048, 8_192, 32_768)
ROBOT = "armpi_fpv"
TWO = ["healthy", "motor_3:stuck"]


def simulate(runs: int, full: bool, path: Path) -> None:
    """Write a run set of so many runs."""
    hypotheses = None if full else TWO
    movements = RandomMovements(count=5 if full else 2)
    classes = 9 if full else len(TWO)
    plan = ft.Plan(ROBOT, hypotheses, runs // classes, imperfections=ROBOT, movements=movements)
    produce(plan, path)


def diagnoser(full: bool) -> ft.BayesDiagnoser:
    """Return the usual diagnoser, or a quick one."""
    if full:
        return ft.BayesDiagnoser(ROBOT, ROBOT)
    return ft.BayesDiagnoser(ROBOT, ROBOT, TWO, ft.Priors(setup=ft.SetupPrior.known()))


def measure(path: Path, full: bool, workers: int, out: Path) -> None:
    """Print seconds by the clock and peak memory [MB] of this process and of the largest worker."""
    bayes = diagnoser(full)
    begun_s = time.perf_counter()
    runs = RunPieces((path,), bayes.twin.robot, ft.ReadOptions())
    diagnose_to_parquet(runs, bayes, out, workers=workers)
    seconds = time.perf_counter() - begun_s
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    peaks = (resource.getrusage(kind).ru_maxrss / 1024.0 for kind in kinds)
    print(f"{seconds:.1f}", *(f"{peak:.0f}" for peak in peaks))


def evaluate(out: Path) -> None:
    """Print seconds and peak memory [MB] of scoring the results."""
    begun_s = time.perf_counter()
    ft.evaluate(out)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"{time.perf_counter() - begun_s:.1f}", f"{peak:.0f}")


def in_own_process(*words: str) -> list[str]:
    """Return what this script prints in a process of its own."""
    command = [sys.executable, __file__, *words]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()


def digest(folder: Path) -> str:
    """Return a hash of all files of a folder."""
    total = hashlib.sha256()
    for file in sorted(folder.iterdir()):
        total.update(file.name.encode() + b"\0" + file.read_bytes())
    return total.hexdigest()[:12]


def table(sizes: list[int], workers: list[int], full: bool) -> None:
    """Measure sizes by workers and print a row each."""
    mode = ["--full"] if full else []
    heads = ("runs", "workers", "s", "runs/s", "parent MB", "worker MB", "evaluate s, MB", "bytes")
    print(" ".join(f"{head:>14s}" for head in heads), flush=True)
    for size in sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "runs.zarr"
            simulate(size, full, path)
            for count in workers:
                out = Path(folder) / f"results_{count}"
                asked = ["--measure", str(path), str(count), str(out), *mode]
                seconds, parent, worker = in_own_process(*asked)
                scored = ", ".join(in_own_process("--evaluate", str(out)))
                speed = f"{size / float(seconds):.1f}"
                cells = (str(size), str(count), seconds, speed, parent, worker, scored, digest(out))
                print(" ".join(f"{cell:>14s}" for cell in cells), flush=True)


def main() -> None:
    """Measure all sizes and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--full", action="store_true", help="the usual diagnosis")
    parser.add_argument("--measure", nargs=3, metavar=("RUNS", "WORKERS", "OUT"))
    parser.add_argument("--evaluate", metavar="OUT")
    options = parser.parse_args()
    if options.measure:
        path, workers, out = options.measure
        measure(Path(path), options.full, int(workers), Path(out))
    elif options.evaluate:
        evaluate(Path(options.evaluate))
    else:
        table(options.sizes, options.workers, options.full)


if __name__ == "__main__":
    main()
