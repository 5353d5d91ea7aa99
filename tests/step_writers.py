"""Step tests as the robot's own script writes them, made by an integrator that is not ours."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

HEADER = "timestamp,position,command,time_since_start,position_degree"


def motion(P, I, tau, limit, travel, ramp_s=0.005, last=1.6):  # noqa: E741
    """Return angles against time for a loop whose controller asks for no more than `limit`."""

    def slope(t, x):
        reference, moving = travel * min(max(t / ramp_s, 0.0), 1.0), travel / ramp_s * (t < ramp_s)
        speed = (x[1] - x[2]) / tau
        asked = P * (moving - speed) + I * (reference - x[2])
        return [np.clip(asked, -limit, limit), (x[0] - x[1]) / tau, speed]

    found = solve_ivp(slope, (0.0, last), [0.0] * 3, max_step=0.0025, rtol=1e-5, dense_output=True)
    return lambda t: found.sol(np.clip(t, 0.0, last))[2]


def step_rows(rng, loop, sizes, dead_s, period_s=0.01, start=500, gap=None):
    """Return rows (stamp, position, command) of steps of `sizes` counts, one every 3 s.

    Readings are whole counts at uneven times; stamps are off by 1.5 ms, and each step starts
    another 3.6 ms early or late.

    Args:
        rng: For all of that.
        loop: P, I [1/s], filter time [s], speed limit [counts/s].
        sizes: Travels [counts].
        dead_s: Dead time [s].
        period_s: Time between readings [s].
        start: Where it begins [counts].
        gap: Times after each command between which nothing is read [s].
    """
    rows, level = [], float(start)
    for number, size in enumerate(sizes):
        at = 3.0 * number
        go = motion(*loop, size)
        time = np.arange(-1.0, 1.99, period_s) + rng.uniform(0.0, period_s)
        stamp = time + rng.normal(0.0, 0.0015, time.shape)
        late = dead_s + rng.normal(0.0, 0.0036)
        off = rng.uniform(-0.5, 0.5)
        counts = np.round(level + off + go(stamp - late))
        read = np.ones(len(time), dtype=bool)
        if gap is not None:
            read = (time < gap[0]) | (time > gap[1])
        rows += [(at + t, c, 0.0) for t, c in zip(time[read], counts[read], strict=True)]
        rows.append((at, level + size, 5.0))
        level += size
    return rows


def write_step_test(path, rows):
    """Write rows, commands a little after their time as in the real files."""
    order = sorted(rows, key=lambda row: row[0] + (0.05 if row[2] else 0.0))
    lines = [f"{1.6e9 + t:.6f},{p},{c},{t:.6f},{0.24 * p:.2f}" for t, p, c in order]
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path
