"""How the stored runs were made; asked for by `write.py` alone, never by a test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from golden_entry import (
    MODES,
    LostCommand,
    Readings,
    healthy,
    load_run_set,
    parse_hypotheses,
    save_run_set,
    twin,
)

import failuretwin as ft

FOLDER = Path(__file__).with_name("runs")
KINDS = ("stuck", "steady_state_error")
PAPER = ("healthy", *(f"motor_{k}:{kind}" for kind in KINDS for k in range(1, 5)))
READ = Readings(rate_hz=10.0, jitter_s=0.01, noise_m=2e-4)
GRAIN = 2.0**-24
"""Stored values are whole multiples of this [rad or m]."""


def load(name):
    return load_run_set(FOLDER / f"{name}.nc")


def simulated(hypotheses, imperfections, seed, each=1, arm="armpi_fpv", **modes):
    """Return runs of each hypothesis; modes, by id, get the given fields."""
    robot = twin(arm).robot
    states = parse_hypotheses(hypotheses, robot.motor_names)
    changed = {name: replace(MODES[name], **fields) for name, fields in modes.items()}
    return ft.simulate(
        ft.Plan(robot, states, each, seed, imperfections, modes={**MODES, **changed})
    )


def small(runs, keep=(), whole=False):
    """Return the runs on every second time, their values rounded to `GRAIN`.

    A reading that lies between two times goes to the one before it.

    Args:
        runs: A run set of 100 Hz.
        keep: Variables that are kept beside commands, tool path and truth.
        whole: Whether times and precision stay as they are.
    """
    wanted = ["command", "measured", "duration", "fault", "fault_detail", "onset", "magnitude"]
    some = runs[[*wanted, *keep]]
    attributes = ("robot", "source", "seed", "measured_rate_hz")
    some.attrs = {name: runs.attrs[name] for name in attributes}
    if whole:
        return some
    first, second = some.isel(time=slice(0, None, 2)), some.isel(time=slice(1, None, 2))
    for name in ("measured", *keep):
        between = np.full(first[name].shape, np.nan)
        between[:, : second.sizes["time"]] = second[name].values
        gone = np.isnan(first[name].values)
        first = first.assign({name: (first[name].dims, np.where(gone, between, first[name]))})
    for name in ("command", "measured", *keep):
        first[name] = np.round(first[name] / GRAIN) * GRAIN  # exact, and short once compressed
    return first


def nine():
    return small(simulated(PAPER, healthy("armpi_fpv", twin().robot), 5, each=2))


def ideal():
    return small(simulated(PAPER[::2], healthy("none", twin().robot), 2))


def modes():
    """Every mode once, its onset anywhere in the first half; ramps and episodes too."""
    motors = [2, 3, 4, 2, 3, 4, 2, 3, 4, 2, 3]
    names = [f"motor_{k}:{mode}" for k, mode in zip(motors, MODES, strict=True)]
    return small(simulated(names, healthy("armpi_fpv", twin().robot), 7))


def anywhere():
    late = {"onset_s": (1.0, 9.5)}
    kinds = ("stuck", "steady_state_error", "encoder_bias", "drift")
    names = [f"motor_{k}:{kind}" for kind, k in zip(kinds, (1, 2, 3, 2), strict=True)]
    names += ["motor_3:stuck", "motor_4:stuck", "motor_1:slow"]
    measured = healthy("measured", twin().robot)
    return small(simulated(names, measured, 13, **dict.fromkeys((*kinds, "slow"), late)))


def rough():
    """Lost commands, late starts, gaps and glitches, each far more often than a real arm has."""
    known = healthy("armpi_fpv", twin().robot)
    lost = tuple(
        LostCommand(motors, 0.08, 0.15)
        for motors in (("motor_1",), ("motor_2",), ("motor_3", "motor_4"))
    )
    timing = replace(known.timing, late_rate=0.5)
    readings = replace(known.readings, glitch_rate=(0.02,) * 4)
    poor = replace(known, lost_commands=lost, timing=timing, readings=readings)
    names = ["healthy", "motor_1:stuck", "motor_4:stuck", "motor_2:steady_state_error"]
    return small(simulated([*names, "motor_3:lost_commands", "motor_3:lag"], poor, 17))


def drawn():
    """Readings drawn out from 10 to 100 Hz by straight lines, as the published data are."""
    known = healthy("armpi_fpv", twin().robot)
    published = replace(known, readings=replace(known.readings, drawn_out=True))
    names = ["motor_3:stuck", "motor_2:steady_state_error"]
    return small(simulated(names, published, 19), whole=True)


def pairs():
    names = ["motor_1:stuck+motor_3:stuck", "motor_2:stuck+motor_3:drift"]
    names += ["motor_1:encoder_bias+motor_3:steady_state_error"]
    return small(simulated(names, healthy("armpi_fpv", twin().robot), 23))


def other_arm(name):
    robot = twin(name).robot
    known = replace(healthy("generic", robot), readings=READ)
    first, second = robot.motor_names[1:3]
    names = ["healthy", f"{first}:stuck", f"{second}:steady_state_error"]
    return small(simulated(names, known, 29, arm=name))


def sessions():
    """Three sessions of a healthy robot with the readings of its motors, to calibrate by."""
    known = replace(healthy("measured", twin().robot), variation=None)
    runs = small(simulated(["healthy"], known, 31, each=9), keep=("position",))
    names = [f"session_{k // 3}/{k % 3}" for k in range(9)]
    return runs.assign_coords(run=np.array(names, dtype=object))


MADE = {
    "anywhere": anywhere,
    "drawn": drawn,
    "ideal": ideal,
    "modes": modes,
    "nine": nine,
    "pairs": pairs,
    "rough": rough,
    "sessions": sessions,
    "so101": lambda: other_arm("so101"),
    "ur5e": lambda: other_arm("ur5e"),
}


def store(name):
    """Make and store one of the run sets, and return its file."""
    path = FOLDER / f"{name}.nc"
    save_run_set(MADE[name](), path)
    return path
