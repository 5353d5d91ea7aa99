"""Nine robots, one for each state of the paper, diagnosed from commands and tool path alone.

The robots are simulated with the imperfections of a real ArmPi FPV: they sag, stick, lag, lose
commands and glitch. Run with `make demo`; the picture is demo.png, or what the argument says.
"""

import sys
from pathlib import Path

import numpy as np

from failuretwin import BayesDiagnoser, DigitalTwin, load_robot
from failuretwin.app.plots import run_figure
from failuretwin.app.reports import print_diagnoses, print_scores
from failuretwin.app.tables import progress_bar
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.evaluation import Judged
from failuretwin.digital_model.calibrated_robot import load_calibration

RUNS_PER_CLASS = 10
PICTURE = Path(sys.argv[1] if len(sys.argv) > 1 else "demo.png")

robot = load_robot("armpi_fpv")
plan = Plan(
    robot=robot,
    hypotheses=paper_hypotheses(robot.motor_names),
    runs_per_class=RUNS_PER_CLASS,
    seed=3,
    imperfections=load_calibration("armpi_fpv", robot).imperfections,
)
with progress_bar("simulating", plan.size) as advance:
    runs = simulate(plan, on_progress=advance)

twin = DigitalTwin(robot)
diagnoses = BayesDiagnoser(twin).diagnose(runs)
print_diagnoses(diagnoses)
print_scores(Judged.of(diagnoses))

shown = next(i for i, d in enumerate(diagnoses) if d.truth == d.diagnosis == "motor_3:stuck")
run = runs.isel(run=shown)
figure = run_figure(
    run["time"].values,
    twin.path(run["command"].values),
    np.asarray(run["measured"].values),
    diagnoses[shown],
)
figure.savefig(PICTURE, dpi=110)
print(f"\npicture of run {diagnoses[shown].run}: {PICTURE}")
