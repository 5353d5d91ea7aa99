"""Nine robots, one for each state of the paper, diagnosed from commands and tool path alone.

The robots are simulated with the imperfections of a real ArmPi FPV: they sag, stick, lag, lose
commands and glitch. Run with `make demo`; the picture is demo.png, or what the argument says.
"""

import sys
from pathlib import Path

import failuretwin as ft

RUNS_PER_CLASS = 10
PICTURE = Path(sys.argv[1] if len(sys.argv) > 1 else "demo.png")

plan = ft.Plan("armpi_fpv", runs_per_class=RUNS_PER_CLASS, seed=3, imperfections="armpi_fpv")
print(f"simulating and diagnosing {plan.size} runs ...")
runs = ft.simulate(plan)
diagnoses = ft.diagnose(runs, "armpi_fpv")

for first in range(0, len(diagnoses), RUNS_PER_CLASS):
    same = diagnoses[first : first + RUNS_PER_CLASS]
    right = sum(d.diagnosis == d.truth for d in same)
    print(f"{same[0].truth:30s} {right:2d} of {len(same)} right, such as: {same[0].verdict}")
scores = ft.evaluate(diagnoses).judged.scores
low, high = (100 * end for end in scores.interval)
share = f"{scores.right} of {scores.runs} simulated runs right"
print(f"{share} (95 % interval {low:.0f} to {high:.0f} %)")

shown = next(i for i, d in enumerate(diagnoses) if d.truth == d.diagnosis == "motor_3:stuck")
run, twin = runs.isel(run=shown), ft.DigitalTwin(ft.load_robot("armpi_fpv"))
asked, seen = twin.path(run["command"].values), run["measured"].values
ft.run_figure(run["time"].values, asked, seen, diagnoses[shown]).savefig(PICTURE, dpi=110)
print(f"picture of run {diagnoses[shown].run}: {PICTURE}")
