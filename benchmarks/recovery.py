"""Does a calibration find what is true? Simulated robots with random parameters, and physics.

    python benchmarks/recovery.py [--robots 200] [--runs 40]

For each parameter that a calibration calls identified: how often its 95 % interval holds the truth.
On the physics engine, whose stiffness and friction no parameter of ours describes exactly: the
scatter left on unseen movements against the best that the same description could do there.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.connection.calibration.observations import observe
from failuretwin.connection.calibration.settling_fit import SortedMovements, fit_settling
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.decision.scoring import Share
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections, Variation, vary
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling

Key = tuple[str, str]
SPREAD = Variation(
    bias=(0.006,) * 4,
    compliance=(0.3,) * 4,
    friction=(0.003,) * 4,
    scatter=(0.3,) * 4,
    rates=0.3,
)


def random_robot(robot: Robot, seed: int) -> Imperfections:
    """Return the imperfections of a robot drawn around those of the bundled one."""
    rng = np.random.default_rng([seed, 1])
    known = load_calibration(robot.name, robot).imperfections
    drawn = vary(replace(known, variation=SPREAD), rng)
    assert drawn.settling is not None
    settling = replace(drawn.settling, tail_dof=float(rng.uniform(3.5, 8.0)))
    delay, share, lag = rng.uniform(0.0, 0.03), rng.uniform(0.0, 0.03), rng.uniform(0.01, 0.05)
    timing = replace(
        drawn.timing,
        delay_s=(delay, delay + 0.02),
        ramp_shortening=(share, share + 0.02),
        lag_s=(lag, lag),
    )
    return replace(drawn, settling=settling, timing=timing)


def truths(true: Imperfections, robot: Robot) -> dict[Key, float]:
    """Return the true value of every parameter by name and motor."""
    settling, timing = true.settling, true.timing
    assert settling is not None and true.readings is not None
    found: dict[Key, float] = {("tail_dof", ""): settling.tail_dof}
    for k, motor in enumerate(robot.motor_names):
        for name in ("bias", "compliance", "friction", "scatter"):
            found[name, motor] = getattr(settling, name)[k]
        found["spoilt readings", motor] = true.readings.glitch_rate[k]
    for entry in true.lost_commands:
        found["lost commands", "+".join(entry.motors)] = entry.rate
        found["lost commands when late", "+".join(entry.motors)] = entry.rate_when_late
    found["delay, mean over runs", ""] = float(np.mean(timing.delay_s))
    found["ramp shortening, mean over runs", ""] = float(np.mean(timing.ramp_shortening))
    found["lag", ""] = timing.lag_s[0]
    found["late starts", ""] = timing.late_rate
    found["late start, median", ""] = float(np.mean(timing.late_s))
    found["readings stop, median", ""] = float(np.mean(timing.gap_start_s))
    return found


def try_robot(name: str, runs: int, seed: int) -> dict[Key, tuple[bool, bool]]:
    """Return for each parameter whether it is identified and whether its interval holds."""
    robot = ft.load_robot(name)
    true = random_robot(robot, seed)
    logs = ft.simulate(ft.Plan(robot, [HEALTHY], runs, seed, true))
    known, found = truths(true, robot), {}
    parameters = fit_calibration(logs, robot, "trial", "simulated", thorough=False).parameters
    told_apart = any(p.name == "lost commands when late" for p in parameters)
    for p in parameters:
        if p.name == "lost commands" and not told_apart:
            continue  # of punctual and late movements together: no parameter of the simulation
        if (p.name, p.motor) in known:
            value = known[p.name, p.motor]
            found[p.name, p.motor] = (p.identified, p.low <= value <= p.high)
    return found


def on_physics(robot: Robot, runs: int) -> None:
    """Print the scatter on unseen movements of the physics engine against the best possible."""
    known = load_calibration(robot.name, robot).imperfections
    quiet = replace(known, settling=Settling.ideal(len(robot.motors)))
    sets = [
        ft.simulate(ft.Plan(robot, [HEALTHY], runs, seed, quiet, engine="physics"))
        for seed in (1, 2)
    ]
    learning, unseen = (observe(logs, robot) for logs in sets)
    scatters = []
    for source in (learning, unseen):
        learned = fit_settling(source).together.learned
        settling = learned.settling
        assert unseen.position is not None
        became = SortedMovements.of(unseen, learned)
        expected = unseen.target + settling.offset(robot, unseen.position, unseen.direction)
        counts = ~became.lost & ~became.odd[:, None]
        off = (unseen.position - expected) ** 2
        scatters.append(np.sqrt(np.sum(off * counts, axis=0) / counts.sum(axis=0)))
    count = abs(robot.servo_units.rad_per_count)
    print("physics engine, rms error of unseen movements whose commands arrived [counts]")
    for motor, learned, best in zip(robot.motor_names, *scatters, strict=True):
        told = f"{learned / count:.2f}, by a fit to those very ones {best / count:.2f}"
        print(f"  {motor}: {told}: {learned / best:.2f} times as much")


def main() -> None:
    """Print coverage by parameter and the scatter on physics."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    on_physics(robot, options.runs)
    counts: dict[Key, list[int]] = defaultdict(lambda: [0, 0])
    with ProcessPoolExecutor(options.workers) as pool:
        work = partial(try_robot, robot.name, options.runs)
        for found in pool.map(work, range(options.robots)):
            for key, (identified, holds) in found.items():
                counts[key][0] += int(holds and identified)
                counts[key][1] += int(identified)
    print(f"\ncoverage of 95 % intervals over {options.robots} simulated robots")
    for (name, motor), (inside, trials) in counts.items():
        if trials == 0:
            print(f"  {name:34s} {motor:18s} never identified")
            continue
        low, high = Share(inside, trials).interval
        print(f"  {name:34s} {motor:18s} {inside:4d} of {trials:4d} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
