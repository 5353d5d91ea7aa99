"""What moments say of how far motors scatter: score and information of their logarithms.

With levers l = S^-1/2 J s of all motors, whitened residuals e of covariance C, D^2 = e^T e, p
channels, u = (nu + p) / (nu + D^2) and G = l^T l,

    score of log s_k = sum w (u ((l_k^T e)^2 + l_k^T C l_k) - G_kk)
    information = sum w 2 ((nu + p) G_kl^2 - G_kk G_ll) / (nu + p + 2)
    score of log nu = sum w nu/2 (psi((nu + p)/2) - psi(nu/2) - p/nu - log(1 + D^2/nu) + u D^2/nu)
    information = sum w (nu^2/4 (psi'(nu/2) - psi'((nu + p)/2))
                  - p (nu + p + 4) nu / (2 (nu + p) (nu + p + 2)))
    information of log s_k and log nu = -sum w 2 nu G_kk / ((nu + p) (nu + p + 2))

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
    """Score and information of the logarithms of each motor's scatter and of nu, last.

    Attributes:
        score: (pick, motor + 1).
        information: (pick, motor + 1, motor + 1).
    """

    score: FloatArray
    information: FloatArray


def scatter_information(evidence: RunsEvidence, part: ThetaPart) -> ScatterInformation:
    """Return what the picks of a hypothesis say of scatter and tail.

    A faulty motor says nothing of its own scatter.

    Args:
        evidence: The runs.
        part: The picks, with theta under each.
    """
    model, noise = evidence.scene.model, evidence.scene.noise
    faults = evidence.hypotheses[part.hypothesis].faults
    healthy = ~np.isin(model.motor_names, [fault.motor for fault in faults])
    found = evidence.weighed[part.hypothesis].found[part.places]
    ready = evidence.part(part.hypothesis, part.picks)
    motors = len(healthy)
    zeros = slice(evidence.scene.layout.offsets.start, evidence.scene.layout.offsets.start + motors)
    total = ScatterInformation(
        np.zeros((len(part.picks.run), motors + 1)),
        np.zeros((len(part.picks.run), motors + 1, motors + 1)),
    )
    columns = ready.columns
    for m in range(found.mean.shape[1]):
        G = columns[:, m]
        levers = G[..., zeros] * np.where(healthy, model.scatter, 0.0)
        covariance = G @ part.covariance @ np.swapaxes(G, -1, -2)
        _add(total, ready, found, m, levers, covariance, noise.dof)
    return total


def _add(
    total: ScatterInformation,
    part: Part,
    found: RowsPosterior,
    m: int,
    levers: FloatArray,
    covariance: FloatArray,
    nu: float,
) -> None:
    """Add what one moment says."""
    (residual, scale), weight = part.mixture_at(m).by_row, found.share[:, m]  # (pick, outcome)
    off = residual - found.mean[:, None, m]
    whitening = np.linalg.inv(np.linalg.cholesky(scale))
    off = np.matmul(whitening, off[..., None])[..., 0]
    lever = np.matmul(whitening, levers[:, None])  # (pick, outcome, channel, motor)
    dims, square = off.shape[-1], np.sum(off**2, axis=-1)
    u = _pull(square, nu, dims)
    gram = np.einsum("pack,pacl->pakl", lever, lever)
    own = np.diagonal(gram, axis1=-2, axis2=-1)
    moved = np.einsum("pack,pac->pak", lever, off) ** 2
    whitened = whitening @ covariance[:, None] @ np.swapaxes(whitening, -1, -2)
    moved += np.einsum("pack,pacd,padk->pak", lever, whitened, lever)
    motors = lever.shape[-1]
    score, information = total.score, total.information
    score[:, :motors] += np.einsum("pa,pak->pk", weight, u[..., None] * moved - own)
    inert = 0.0 if np.isinf(nu) else 2.0 / (nu + dims + 2.0)
    sharp = 2.0 if np.isinf(nu) else 2.0 * (nu + dims) / (nu + dims + 2.0)
    told = sharp * gram**2 - inert * own[..., :, None] * own[..., None, :]
    information[:, :motors, :motors] += np.einsum("pa,pakl->pkl", weight, told)
    if np.isfinite(nu):
        tail, each = _tail_score(square, nu, dims)
        score[:, motors] += np.sum(weight * tail, axis=1)
        information[:, motors, motors] += each * weight.sum(axis=1)
        crossed = -2.0 * nu / ((nu + dims) * (nu + dims + 2.0)) * own
        crossed = np.einsum("pa,pak->pk", weight, crossed)
        information[:, :motors, motors] += crossed
        information[:, motors, :motors] += crossed


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
    found = evidence.weighed[part.hypothesis].found[part.places]
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
