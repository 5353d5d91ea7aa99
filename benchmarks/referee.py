"""Evidence of the engine against importance sampling.

    python benchmarks/referee.py [--robot armpi_fpv so101 ur5e] [--runs 4] [--draws 8000]

Runs of every mode that rests tell of are drawn of robots of a class. Of each, the most probable row
of its true hypothesis is judged: log p(run | row) by the engine, and by importance sampling of the
moments' numbers f from a Student t about what the engine found. Rows whose sampling error is above
`TOLD_NATS` are counted apart: sampling itself does not tell.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from math import lgamma

import numpy as np
import xarray as xr
from scipy.special import logsumexp

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis, single_faults
from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.filter import RowsPosterior
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.picks import Part, Picks, prepared
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.runs import RunsEvidence, has_rows
from failuretwin.inference.engine.theta import AS_TOLD, ScaleFactors, layout_of, robot_components
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

TOLD_NATS = 0.02
"""Largest sampling error of a row that counts [nats]."""
DOF, WIDER = 6.0, 1.1
"""Degrees of freedom of the proposal, and its scale beside what the engine found."""


def evidence_of(
    runs: xr.Dataset, model: HealthyModel, hypotheses: list[Hypothesis], factors: ScaleFactors
) -> RunsEvidence:
    """Return what the settled positions of runs say of hypotheses."""
    seen = Evidence(runs, model.settings, model.sensors).sound
    moments, sharp = moments_of(model, seen.settled), model.without_doubt
    layout = layout_of(sharp)
    components = robot_components(model, layout, factors)
    scene = Scene.of(sharp, moments, ft.Priors(), layout, components.covariance[0])
    return RunsEvidence(scene, hypotheses, components, log_prior(hypotheses, ft.Priors()))


def likeliest(evidence: RunsEvidence, h: int, run: int) -> tuple[Part, RowsPosterior]:
    """Return the most probable row of a hypothesis in a run, alone, and what the engine finds."""
    one, rows, components = evidence.weighed[h], evidence.rows[h], evidence.components
    mine = np.flatnonzero((one.picks.run == run) & (one.picks.component == 0))
    row = int(one.picks.row[mine[one.log_evidence[mine].argmax()]])
    picks = Picks(np.array([run]), np.array([row]), np.array([0]))
    part = Part(evidence.scene, rows, picks, components, prepared(evidence.scene, rows, components))
    return part, part.refined(part.filtered())


def sampled_evidence(
    part: Part, found: RowsPosterior, draws: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return log p(run | row) by importance sampling of f, and its standard deviation."""
    usable, noise = part.scene.moments.usable[part.picks.run], part.scene.noise
    (mean, spread), channels = part.prior, part.scene.moments.point.shape[-1]
    some = np.flatnonzero(np.repeat(usable[0], channels))
    prior = spread[0][np.ix_(some, some)]
    prior += 1e-9 * np.trace(prior) / len(prior) * np.eye(len(prior))
    inverse, told = np.linalg.inv(prior), np.zeros((mean[0].size,) * 2)
    information, shifts = found.sites
    for m, one in enumerate(information[0]):
        own = slice(m * channels, (m + 1) * channels)
        told[own, own] = one
    prior_mean, shift = mean[0].ravel()[some], shifts[0].ravel()[some]
    covariance = np.linalg.inv(inverse + told[np.ix_(some, some)])
    centre = covariance @ (shift + inverse @ prior_mean)
    root, size = np.linalg.cholesky(0.5 * (covariance + covariance.T)), len(some)
    scale = np.sqrt(DOF / rng.chisquare(DOF, (draws, 1)))
    x = WIDER * rng.normal(size=(draws, size)) * scale
    log_q = lgamma((DOF + size) / 2) - lgamma(DOF / 2) - 0.5 * size * np.log(DOF * np.pi)
    log_q -= size * np.log(WIDER) + np.log(np.diag(root)).sum()
    log_q = log_q - 0.5 * (DOF + size) * np.log1p((x**2).sum(axis=1) / WIDER**2 / DOF)
    f = np.zeros((draws, mean[0].size))
    f[:, some] = centre + x @ root.T
    off = f[:, some] - prior_mean
    total = -0.5 * np.sum(off @ inverse * off, axis=1) - log_q
    total -= 0.5 * np.linalg.slogdet(2.0 * np.pi * prior)[1]
    for m in np.flatnonzero(usable[0]).tolist():
        here = f[:, m * channels : (m + 1) * channels]
        total += _moment(part, m, here, noise.dof, noise.log_outlier)
    weight = np.exp(total - total.max())
    deviation = float(weight.std() / weight.mean() / np.sqrt(draws))
    return float(logsumexp(total) - np.log(draws)), deviation


def _moment(part: Part, m: int, f: FloatArray, dof: float, log_outlier: float) -> FloatArray:
    """Return log L_m(f) of each draw, (draw,)."""
    residual, scale = (values[0] for values in part.outcomes_at(m))
    error = residual - f[:, None]
    square = np.einsum("nai,aij,naj->na", error, np.linalg.inv(scale), error)
    fall = log_fall(square, dof, f.shape[1]) - 0.5 * np.linalg.slogdet(scale)[1]
    terms = part.log_weight[0, m] + log_norm(dof, f.shape[1]) + fall
    return np.logaddexp(logsumexp(terms, axis=1), log_outlier)


def differences(robot: Robot, count: int, draws: int, seed: int) -> Iterator[tuple[float, float]]:
    """Yield by how much the engine is off in each run, and the sampling error [nats]."""
    rng, drawn = np.random.default_rng(seed), generic_imperfections(robot)
    model = HealthyModel.of(ft.DigitalTwin(robot), drawn)
    for truth in filter(has_rows, single_faults(robot.motor_names, MODES)):
        try:
            plan = Plan(robot, [str(truth)], count, seed, imperfections=drawn)
        except ft.InputError:  # a motor that carries nothing loses no torque that shows
            continue
        evidence = evidence_of(simulate(plan), model, [truth], AS_TOLD)
        for run in range(count):
            part, found = likeliest(evidence, 0, run)
            exact, deviation = sampled_evidence(part, found, draws, rng)
            yield float(found.total[0]) - exact, deviation


def main() -> None:
    """Print how far the engine is off."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robot", nargs="+", default=["armpi_fpv", "so101", "ur5e"])
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--draws", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for name in asked.robot:
        told = list(differences(load_robot(name), asked.runs, asked.draws, asked.seed))
        off = np.array([one for one, deviation in told if deviation < TOLD_NATS])
        shares = [f"within {most:g} nats {np.mean(np.abs(off) < most):.1%}" for most in (0.05, 0.2)]
        print(
            f"{name}: {', '.join(shares)} of {len(off)} rows, median {np.median(off):+.3f}, worst "
            f"{off[np.abs(off).argmax()]:+.3f}; sampling does not tell of {len(told) - len(off)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
