"""Are two faults that nobody has named put into two groups, and healthy or known runs into none?

    python benchmarks/unknown_groups.py [--robots 6] [--runs 4] [--seed 0] [--mover 3] [--keep DB]

Each robot is drawn from the spread of the class and judged by the calibration that they have in
common. Of one motor, some robots have a stop in the way, some miss their targets on one side only;
others are healthy, or have a known fault. Offered are the paper's nine hypotheses and `unknown`,
and no likelihood knows the two laws.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import ClassVar
from unittest.mock import patch

import numpy as np
import sqlalchemy as sa
from unknown import EndStop

import failuretwin as ft
from failuretwin.core.hypothesis import UNKNOWN, Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.schema import robots
from failuretwin.data_knowledge.records.unknown_faults import (
    read_episodes_of_unknown,
    unknown_groups,
)
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.failure_behavior.fault import FaultGroup
from failuretwin.failure_behavior.mode import Range, SizedMode
from failuretwin.failure_behavior.registry import MODES, register_mode
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import unlisted

SIDE_RAD = 0.3
"""Angle from which the one-sided fault shows."""
START = datetime(2026, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, kw_only=True)
class OneSided(SizedMode):
    """A motor stops this far short [rad] at angles beyond `SIDE_RAD`."""

    mode: ClassVar[str] = "one_sided"
    unit: ClassVar[str] = "rad"

    magnitude: Range = (0.2, 0.4)

    def on_reference(
        self, faults: FaultGroup, reference: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Shift the reference on one side."""
        return reference - faults.effect(time) * (reference > SIDE_RAD)


OWN: dict[str, SizedMode] = {
    "end_stop": EndStop(onset_s=(0.0, 0.0), profiles=("step",)),
    "one_sided": OneSided(onset_s=(0.0, 0.0), profiles=("step",)),
}
"""Modes that nobody has named."""


def main() -> None:
    """Simulate robots, diagnose and store their runs, and ask for groups."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=6, help="of each state")
    parser.add_argument("--runs", type=int, default=4, help="of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mover", type=int, default=3, help="motor with the unnamed faults")
    parser.add_argument("--keep", help="store to make, or to ask again")
    options = parser.parse_args()
    for mode in OWN.values():
        register_mode(mode)
    motor = f"motor_{options.mover}"
    states = [f"{motor}:end_stop", f"{motor}:one_sided", "healthy", "motor_2:stuck"]
    states.append(f"{motor}:steady_state_error")
    with tempfile.TemporaryDirectory() as folder:
        url = options.keep or str(Path(folder) / "robots.db")
        store = ft.open_store(url, create=True)
        for state in [] if store.robots() else states:
            for number in range(options.robots):
                live(store, state, number, options.runs, options.seed)
        answer = store.query("unknown-faults")
        print(*answer.columns, sep="  ")
        for row in answer.rows:
            print(*row, sep="  ")
        tell(url)


def live(store: ft.Store, state: str, number: int, count: int, seed: int) -> None:
    """Store a healthy run of a robot and `count` in a state, a day each."""
    robot = ft.load_robot("armpi_fpv")
    known = load_calibration("armpi_fpv", robot).imperfections
    rng = np.random.default_rng([seed, number, *state.encode()])
    spread = generic_imperfections(robot).variation
    assert spread is not None
    narrow = replace(spread, bias=(0.002,) * 4, compliance=(0.1,) * 4, friction=(0.002,) * 4)
    own: Imperfections = vary(replace(known, variation=narrow), rng)
    mode, modes = OWN.get(state.partition(":")[2]), dict(MODES)
    if mode is not None:  # the fault of a robot keeps its size
        size = float(rng.uniform(*mode.magnitude))
        modes[mode.mode] = replace(mode, magnitude=(size, size))
    plan = ft.Plan(robot, [state], count, int(rng.integers(1 << 30)), own, modes=modes)
    hypotheses = [*paper_hypotheses(robot.motor_names), UNKNOWN]
    diagnoser = ft.BayesDiagnoser(robot, known, hypotheses)
    with patch("failuretwin.inference.posterior.unlisted", forgetting):
        found = diagnoser.diagnose(ft.simulate(plan))
    name = f"{state} {number}"
    for day, one in enumerate(found):
        log = LogFile(f"{name} {day}", f"{name} {day}", 1, START + timedelta(days=day))
        store.remember([one], name, log=log, profile=robot)
    said = Counter(str(one.diagnosis) for one in found)
    print(name, dict(said), flush=True)


def forgetting(likelihood: RunLikelihood, known: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the single faults that are not offered, but for those that nobody has named."""
    return [h for h in unlisted(likelihood, known) if h.faults[0].mode not in OWN]


def tell(url: str) -> None:
    """Print of what true states each group is."""
    with Database(url).reading() as connection:
        rows = connection.execute(sa.select(robots.c.id, robots.c.name))
        names = {row.id: row.name.rpartition(" ")[0] for row in rows}
        found = unknown_groups(read_episodes_of_unknown(connection), dict.fromkeys(names, ""))
    for group in found:
        truth = Counter(names[one.robot] for one in group.episodes)
        print(f"group of {len(group.episodes)}: {dict(truth)}")


if __name__ == "__main__":
    main()
