"""What moments say of how far motors scatter and how noisy the sensor is, by their logarithms.

With levers L_k = S^-1/2 J_k s_k of the motors and L_n = S^-1/2 sn of the sensor, whitened residuals
e of covariance C, D^2 = e^T e, p channels, u = (nu + p) / (nu + D^2), T_k = tr L_k^T L_k and
G_kl = tr L_k L_k^T L_l L_l^T,

    score of log s_k = sum w (u (|L_k^T e|^2 + tr L_k^T C L_k) - T_k)
    information = sum w 2 ((nu + p) G_kl - T_k T_l) / (nu + p + 2)
    score of log nu = sum w nu/2 (psi((nu + p)/2) - psi(nu/2) - p/nu - log(1 + D^2/nu) + u D^2/nu)
    information = sum w (nu^2/4 (psi'(nu/2) - psi'((nu + p)/2))
                  - p (nu + p + 4) nu / (2 (nu + p) (nu + p + 2)))
    information of log s_k and log nu = -sum w 2 nu T_k / ((nu + p) (nu + p + 2))

(Lange, Little and Taylor, JASA 84 (1989) 881, for a multivariate t with C = 0).

Section: docs/inference.md#folders
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, polygamma

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.engine.filter import RowsPosterior
from failuretwin.inference.engine.picks import Part
from failuretwin.inference.engine.posterior import ThetaPart
from failuretwin.inference.engine.runs import RunsEvidence


@dataclass(frozen=True)
class ScatterInformation:
    """Score and information of the logarithms of each motor's scatter, of nu and of the noise.

    Attributes:
        score: (pick, motor + 2).
        information: (pick, motor + 2, motor + 2).
    """

    score: FloatArray
    information: FloatArray


def scatter_information(evidence: RunsEvidence, part: ThetaPart) -> ScatterInformation:
    """Return what the picks of a hypothesis say of scatter, tail and noise.

    A faulty motor says nothing of its own scatter.

    Args:
        evidence: The runs.
        part: The picks, with theta under each.
    """
    model, noise = evidence.scene.model, evidence.scene.noise
    faults = evidence.hypotheses[part.hypothesis].faults
    healthy = ~np.isin(model.motor_names, [fault.motor for fault in faults])
    found = evidence.weighed[part.hypothesis].found.some(part.places)
    ready = evidence.part(part.hypothesis, part.picks)
    motors = len(healthy)
    zeros = slice(evidence.scene.layout.offsets.start, evidence.scene.layout.offsets.start + motors)
    total = ScatterInformation(
        np.zeros((len(part.picks.run), motors + 2)),
        np.zeros((len(part.picks.run), motors + 2, motors + 2)),
    )
    sn = evidence.components.noise_m[part.picks.component]
    columns = ready.columns
    for m in range(found.mean.shape[1]):
        G = columns[:, m]
        levers = G[..., zeros] * np.where(healthy, model.scatter, 0.0)
        covariance = G @ part.covariance @ np.swapaxes(G, -1, -2)
        _add(total, ready, found, m, _Levers(levers, sn, covariance), noise.dof)
    return total


@dataclass(frozen=True)
class _Levers:
    """By how much scatter and noise move what is seen at one moment.

    Attributes:
        motors: J s of each motor, 0 of a faulty one, (pick, channel, motor) [m].
        noise: sn, (pick,) [m].
        covariance: G V G^T, (pick, channel, channel) [m2].
    """

    motors: FloatArray
    noise: FloatArray
    covariance: FloatArray


def _add(
    total: ScatterInformation,
    part: Part,
    found: RowsPosterior,
    m: int,
    levers: _Levers,
    nu: float,
) -> None:
    """Add what one moment says."""
    (residual, scale), weight = part.outcomes_at(m), found.share[:, m]  # (pick, outcome)
    off = residual - found.mean[:, None, m]
    whitening = np.linalg.inv(np.linalg.cholesky(scale))
    off = np.matmul(whitening, off[..., None])[..., 0]
    dims, square = off.shape[-1], np.sum(off**2, axis=-1)
    whitened = whitening @ levers.covariance[:, None] @ np.swapaxes(whitening, -1, -2)
    spread = off[..., :, None] * off[..., None, :] * _pull(square, nu, dims)[..., None, None]
    spread += whitened * _pull(square, nu, dims)[..., None, None]
    lever = np.matmul(whitening, levers.motors[:, None])  # (pick, outcome, channel, motor)
    noise = whitening * levers.noise[:, None, None, None]
    moved = np.einsum("pack,pacd,padk->pak", lever, spread, lever, optimize=True)
    of_noise = np.einsum("pacn,pacd,padn->pa", noise, spread, noise, optimize=True)
    trace, overlap = _overlaps(lever, noise)
    motors = lever.shape[-1]
    scales = np.r_[:motors, motors + 1]  # the degrees of freedom stand between
    score, information = total.score, total.information
    gained = np.concatenate([moved, of_noise[..., None]], axis=-1) - trace
    score[:, scales] += np.einsum("pa,pak->pk", weight, gained)
    inert = 0.0 if np.isinf(nu) else 2.0 / (nu + dims + 2.0)
    sharp = 2.0 if np.isinf(nu) else 2.0 * (nu + dims) / (nu + dims + 2.0)
    told = sharp * overlap - inert * trace[..., :, None] * trace[..., None, :]
    information[:, scales[:, None], scales] += np.einsum("pa,pakl->pkl", weight, told)
    if np.isfinite(nu):
        tail, each = _tail_score(square, nu, dims)
        score[:, motors] += np.sum(weight * tail, axis=1)
        information[:, motors, motors] += each * weight.sum(axis=1)
        crossed = -2.0 * nu / ((nu + dims) * (nu + dims + 2.0)) * trace
        crossed = np.einsum("pa,pak->pk", weight, crossed)
        information[:, scales, motors] += crossed
        information[:, motors, scales] += crossed


def _overlaps(lever: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T (pick, outcome, motor + 1) and G, the noise last.

    Args:
        lever: L of the motors, (pick, outcome, channel, motor).
        noise: L of the noise, (pick, outcome, channel, channel).
    """
    own = np.matmul(noise, np.swapaxes(noise, -1, -2))
    gram = np.matmul(np.swapaxes(lever, -1, -2), lever) ** 2
    crossed = np.einsum("pack,pacd,padk->pak", lever, own, lever, optimize=True)
    trace = np.concatenate(
        [np.sum(lever**2, axis=-2), np.trace(own, axis1=-2, axis2=-1)[..., None]], axis=-1
    )
    last = np.sum(own**2, axis=(-2, -1))[..., None]
    beside = np.concatenate([crossed, last], axis=-1)[..., None, :]
    return trace, np.concatenate(
        [np.concatenate([gram, crossed[..., None]], axis=-1), beside], axis=-2
    )


def _pull(square: FloatArray, nu: float, dims: int) -> FloatArray:
    """Return u, by how much a residual counts."""
    return np.ones_like(square) if np.isinf(nu) else (nu + dims) / (nu + square)


def _tail_score(square: FloatArray, nu: float, dims: int) -> tuple[FloatArray, float]:
    """Return the score of log nu of each D^2, same shape, and the information of one."""
    whole, half = nu + dims, 0.5 * nu
    middle = digamma(0.5 * whole) - digamma(half) - dims / nu
    slope = middle - np.log1p(square / nu) + whole * square / (nu * (nu + square))
    each = half**2 * (polygamma(1, half) - polygamma(1, 0.5 * whole))
    return half * slope, float(each - dims * (whole + 4.0) * nu / (2.0 * whole * (whole + 2.0)))


def outcome_shares(evidence: RunsEvidence, part: ThetaPart) -> FloatArray:
    """Return the share of each outcome of each movement, (pick, movement, outcome of all)."""
    moments, rows = evidence.scene.moments, evidence.rows[part.hypothesis]
    found = evidence.weighed[part.hypothesis].found.some(part.places)
    ready = evidence.part(part.hypothesis, part.picks)
    usual: IntArray = rows.usual[ready.kept]  # (pick, moment, outcome)
    run = part.picks.run
    count = len(evidence.scene.model.lost_commands.lost)
    table = np.zeros((*usual.shape[:2], count))
    pick, m = np.ogrid[: usual.shape[0], : usual.shape[1]]
    for a in range(usual.shape[2]):
        which = moments.outcome[run[:, None], m, usual[..., a]]
        share = np.where(moments.usable[run], found.share[..., a], 0.0)
        np.add.at(table, (pick, m, which), share)
    return table
