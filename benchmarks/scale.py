"""Cost of a run and peak memory of generation, from a thousand runs up, on one core.

Both should stay flat: runs are made piece by piece, and drawn or stored without keeping them. Every
figure comes from a process of its own. `--largest 100000` goes on to 10^5 runs (5 GB of disk).
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from failuretwin import load_robot
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, iterate
from failuretwin.data_knowledge.resumable import produce
from failuretwin.digital_model.calibrated_robot import load_calibration

SIZES = (1_000, 10_000, 100_000)
CLASSES = 9


def measure(imperfections: str, runs: int, folder: str) -> None:
    """Print seconds of processor and of clock per 1000 runs, and peak memory [MB].

    Args:
        imperfections: ``none`` or ``armpi_fpv``.
        runs: Number of runs, rounded to whole classes.
        folder: Where to store them; empty: they are drawn and thrown away.
    """
    known = load_calibration(imperfections, load_robot("armpi_fpv"))
    hypotheses = paper_hypotheses(known.robot.motor_names)
    plan = Plan(known.robot, hypotheses, runs // CLASSES, 0, known.imperfections)
    next(iterate(plan, 1))  # imports belong to no run
    clock, processor = time.perf_counter(), time.process_time()
    if folder:
        produce(plan, Path(folder) / "runs.zarr")
    else:
        for _ in iterate(plan):
            pass
    seconds = (time.perf_counter() - clock, time.process_time() - processor)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(*(f"{1000.0 * s / plan.size:.4f}" for s in seconds), f"{peak_mb:.0f}")


def in_own_process(imperfections: str, runs: int, folder: str) -> list[str]:
    """Return what `measure` prints in a process of its own, held to one core."""
    words = [sys.executable, __file__, "--measure", imperfections, str(runs), folder]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout.split()


def main() -> None:
    """Measure all sizes and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--largest", type=int, default=10_000, help="largest number of runs")
    parser.add_argument("--measure", nargs=3, metavar=("IMPERFECTIONS", "RUNS", "FOLDER"))
    options = parser.parse_args()
    if options.measure:
        imperfections, runs, folder = options.measure
        measure(imperfections, int(runs), folder)
        return
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"{'':32s} {'ms a run':>9s} {'of processor':>13s} {'peak MB':>8s} {'MB stored':>10s}")
    for imperfections in ("none", "armpi_fpv"):
        for stored in (False, True):
            for runs in (size for size in SIZES if size <= options.largest):
                with tempfile.TemporaryDirectory() as folder:
                    found = in_own_process(imperfections, runs, folder if stored else "")
                    files = (path for path in Path(folder).rglob("*") if path.is_file())
                    size_mb = sum(file.stat().st_size for file in files) / 1e6
                what = f"{imperfections}, {'stored' if stored else 'drawn'}, {runs:,}"
                clock, processor, peak = map(float, found)
                note = f"{size_mb:10.0f}" if stored else ""
                print(f"{what:32s} {clock:9.3f} {processor:13.3f} {peak:8.0f} {note}")


if __name__ == "__main__":
    main()
