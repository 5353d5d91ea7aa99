"""Where the tool would come to rest under each fault of each size, before anything has moved.

    e | member, command ~ N(path(settle(command) + offset), S),    S = J diag(s^2) J^T + sn^2 I

A member is a hypothesis with one size of its fault. An error drawn anew for each movement is
scatter, s_k^2 + size^2; a motor that is held stands at its angle and scatters as it gives; a
movement that may be missed counts by its first two moments.

How much movements are expected to tell of what is the case is estimated by pairwise distances
(Kolchinsky and Tracey 2017), in closed form, since the distances of movements add up:

    D_ij = min(cap, d^2 / 8 + log(|S| / sqrt(|S_i| |S_j|)) / 2),    S = (S_i + S_j) / 2
    I = sum_i p_i log [sum over j of i's hypothesis p(j | h) exp(-D_ij) / sum_j p_j exp(-D_ij)]

D_ij is the distance of Bhattacharyya of where the tool comes to rest if member i, or j, is true;
with heavy tails d^2 counts as (nu + c) log(1 + d^2/(nu + c + 2)).

Section: docs/check.md#choice-of-movements
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import Weighted, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.acting.believed_arm import BelievedArm, BelievedFault
from failuretwin.decision.streaming.monitor import Believed
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.command_loss import OUTLIER_RATE
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior

SIZES = 3
"""Sizes of each fault that are laid beside each other."""
LEVELS = tuple((k + 0.5) / SIZES for k in range(SIZES))
"""Quantiles at which sizes are taken."""
HELD = 4
"""Ways in which a motor may be held unseen: at the median of what it was told, always; where it was
told to be first, half way, or last but one, from then on."""
NEGLIGIBLE = 1e-3
"""Hypotheses that are less probable are left out."""


@dataclass(frozen=True)
class Member:
    """A hypothesis with one size of its fault.

    Attributes:
        hypothesis: Healthy, or one fault.
        size: In the unit of its mode; the held angle of a stuck motor, NaN: where it was told to be
            (`Outlook.after`); NaN if healthy.
        share: Its probability.
        first: Number of the first movement that its fault spoils.
    """

    hypothesis: Hypothesis
    size: float
    share: float
    first: int = 0

    def fault(self, model: HealthyModel) -> BelievedFault | None:
        """Return its fault on a robot; None: healthy."""
        if self.hypothesis.is_healthy:
            return None
        fault = self.hypothesis.faults[0]
        held = MODES[fault.mode].signature is Signature.HELD
        motor, angle = model.motor_names.index(fault.motor), self.size if held else np.nan
        return BelievedFault(fault, motor, self.size, angle=angle)


def of_priors(
    model: HealthyModel, hypotheses: Sequence[Hypothesis], priors: Priors
) -> list[Member]:
    """Return members of hypotheses before anything was seen, with sizes evenly over their logs."""
    shares = np.exp(log_prior(hypotheses, priors))
    members = []
    for hypothesis, share in zip(hypotheses, shares.tolist(), strict=True):
        sizes = _prior_sizes(model, hypothesis, priors)
        members += [Member(hypothesis, size, share / len(sizes)) for size in sizes]
    return members


def _prior_sizes(model: HealthyModel, hypothesis: Hypothesis, priors: Priors) -> list[float]:
    if hypothesis.is_healthy:
        return [np.nan]
    fault = hypothesis.faults[0]
    mode, motor = MODES[fault.mode], model.motor_names.index(fault.motor)
    if mode.signature is Signature.HELD:
        return [np.nan] * HELD
    low, high = priors.sizes_of(mode, model, motor).ends
    sizes = np.geomspace(max(low, 0.02 * high), high, SIZES)
    return [*(-sizes if mode.signed else []), *sizes]


def of_posterior(posterior: Posterior) -> list[Member]:
    """Return members of what is left of one run, sizes at quantiles of what it says."""
    shares = np.exp(posterior.log_posterior[0])

    def size_of(at: int) -> Weighted | None:
        healthy = posterior.hypotheses[at].is_healthy
        return None if healthy else posterior.weights[at].estimate(0).size

    return _at_quantiles(posterior.hypotheses, shares, size_of)


def of_belief(believed: Believed) -> list[Member]:
    """Return members of what a watch believes, healthy and faulty as probable as each other.

    An alarm is raised at odds that have to do with neither: whether there is a fault is asked as
    much as which.
    """
    shares = believed.probability.copy()
    healthy = np.array([hypothesis.is_healthy for hypothesis in believed.hypotheses])
    for part in (healthy, ~healthy):
        shares[part] *= 0.5 / max(float(shares[part].sum()), np.finfo(float).tiny)
    return _at_quantiles(believed.hypotheses, shares, believed.sizes.__getitem__)


def _at_quantiles(
    hypotheses: Sequence[Hypothesis],
    shares: FloatArray,
    size_of: Callable[[int], Weighted | None],
) -> list[Member]:
    """Return members of hypotheses that are not negligible, sizes at quantiles."""
    members = []
    for at, (hypothesis, share) in enumerate(zip(hypotheses, shares.tolist(), strict=True)):
        if share < NEGLIGIBLE or not hypothesis.known or len(hypothesis.faults) > 1:
            continue
        size = size_of(at)
        sizes = [np.nan] if size is None else size.quantiles(LEVELS)
        members += [Member(hypothesis, float(each), share / len(sizes)) for each in sizes]
    return members


@dataclass(frozen=True)
class Outlook:
    """What is expected of members on a robot.

    Attributes:
        model: The healthy robot and its sensors.
        members: What may be the case.
    """

    model: HealthyModel
    members: Sequence[Member]

    @property
    def log_share(self) -> FloatArray:
        """Log probability of each member, (member,); they sum to 1."""
        share = np.array([member.share for member in self.members])
        return np.asarray(np.log(share / share.sum()))

    @property
    def kind(self) -> IntArray:
        """Index of the hypothesis of each member, (member,)."""
        kinds = list(dict.fromkeys(member.hypothesis for member in self.members))
        return np.array([kinds.index(member.hypothesis) for member in self.members])

    @property
    def most_nats(self) -> float:
        """What one movement can tell at most [nats]: that it was not one which says nothing.

        Minus the log of how often a command is lost, or the tool is anywhere.
        """
        lost = sum(entry.rate for entry in self.model.imperfections.lost_commands or ())
        return -float(np.log(min(0.5, OUTLIER_RATE + lost)))

    def after(self, told: FloatArray) -> Outlook:
        """Return the same with motors that are held where movements would show it least.

        `told` is what motors were told, the start first, (movement, motor) [rad].
        """
        last = max(len(told) - 2, 0)
        begin = (0, 0, len(told) // 2, last)
        angles = np.stack([np.median(told, axis=0), *told[list(begin[1:])]])
        members, count = list(self.members), 0
        for at, member in enumerate(members):
            fault = member.fault(self.model)
            if fault is None or not np.isnan(member.size):
                continue
            way = count % HELD
            members[at] = replace(member, size=float(angles[way, fault.motor]), first=begin[way])
            count += 1
        return Outlook(self.model, members)

    def expected(
        self, command: FloatArray, previous: FloatArray, since_s: FloatArray, number: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of what is seen at rest after movements.

        Args:
            command: What motors are told, (movement, motor) [rad].
            previous: What they were told before, (movement, motor) [rad].
            since_s: How long faults have been there by then, (movement,) [s].
            number: Which movement it is, from 0, (movement,).

        Returns:
            (movement, member, channel) [m] and (movement, member, channel, channel) [m2].
        """
        told = command, previous, since_s
        healthy = BelievedArm(self.model).expected(*told)
        pose, scatter = (np.repeat(each[:, None], len(self.members), axis=1) for each in healthy)
        for at, member in enumerate(self.members):
            struck = number >= member.first
            arm = BelievedArm(self.model, member.fault(self.model))
            if arm.fault is not None and struck.any():
                rows = (each[struck] for each in told)
                pose[struck, at], scatter[struck, at] = arm.expected(*rows)
        mean, jacobian = self.model.sensors.expected(pose)
        root = jacobian * scatter[..., None, :]
        noise = self.model.path_noise**2 * np.eye(mean.shape[-1])
        return mean, root @ np.swapaxes(root, -1, -2) + noise

    def distances(
        self, command: FloatArray, previous: FloatArray, since_s: FloatArray, number: IntArray
    ) -> FloatArray:
        """Return how far members are apart by each movement, (movement, member, member) [nats].

        Arguments as of `expected`.
        """
        mean, spread = self.expected(command, previous, since_s, number)
        return pairwise_distance(mean, spread, self.model.settling.tail_dof, self.most_nats)

    def information(self, nats: FloatArray) -> FloatArray:
        """Return what distances (..., member, member) tell about the hypothesis, (...) [nats]."""
        return expected_information(nats, self.log_share, self.kind)


# How much movements tell.


def pairwise_distance(mean: FloatArray, spread: FloatArray, dof: float, cap: float) -> FloatArray:
    """Return how far members are apart in what is seen after a movement, (..., member, member).

    In nats: minus the log of the overlap of two densities; 0 on the diagonal. Positions of the tool
    are expected at `mean`, (..., member, channel) [m], with a covariance `spread` and a scatter of
    `dof` degrees of freedom; a movement counts `cap` nats at most.
    """
    one, other = np.triu_indices(mean.shape[-2], 1)
    between = 0.5 * (spread[..., one, :, :] + spread[..., other, :, :])
    log_det = np.linalg.slogdet(spread)[1]
    apart = mean[..., one, :] - mean[..., other, :]
    d2 = np.einsum("...a,...a->...", apart, np.linalg.solve(between, apart[..., None])[..., 0])
    if np.isfinite(dof):
        channels = mean.shape[-1]
        d2 = (dof + channels) * np.log1p(d2 / (dof + channels + 2.0))
    wider = np.linalg.slogdet(between)[1] - 0.5 * (log_det[..., one] + log_det[..., other])
    found = np.zeros((*mean.shape[:-1], mean.shape[-2]))
    found[..., one, other] = np.minimum(0.125 * d2 + 0.5 * wider, cap)
    return found + np.swapaxes(found, -1, -2)


def expected_information(nats: FloatArray, log_share: FloatArray, kind: IntArray) -> FloatArray:
    """Return how much is expected to be learned about the hypothesis, (...) [nats].

    Distances of all movements together are (..., member, member) [nats]; the log probability of
    each member and the index of its hypothesis are (member,).
    """
    terms = log_share - nats
    same = kind[:, None] == kind
    of_own = np.array([log_sum(log_share[kind == k], axis=0) for k in kind])
    own = log_sum(np.where(same, terms, -np.inf), axis=-1) - of_own
    return np.asarray(np.sum(np.exp(log_share) * (own - log_sum(terms, axis=-1)), axis=-1))
