"""Sums and integrals of probabilities in logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.types import FloatArray, as_floats


@dataclass(frozen=True)
class Weighted:
    """A distribution as values with weights, (value,) each; weights need not add up to 1."""

    values: FloatArray
    weights: FloatArray

    def quantiles(self, levels: tuple[float, ...]) -> FloatArray:
        """Return quantiles, (level,)."""
        return weighted_quantiles(self.values, self.weights, levels)

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return draws, (count,): between the values by straight lines, as quantiles are."""
        return self.quantiles(tuple(rng.random(count).tolist()))


def log_sum(values: FloatArray, axis: int | tuple[int, ...]) -> FloatArray:
    """Return log(sum(exp(values))) along `axis`; an all -inf slice gives -inf."""
    top = np.max(values, axis=axis, keepdims=True)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.sum(np.exp(values - safe), axis=axis, keepdims=True)) + safe
    return np.squeeze(total, axis=axis)


def log_of(values: ArrayLike) -> FloatArray:
    """Return the logarithm, -inf for 0 without a warning."""
    with np.errstate(divide="ignore"):
        return np.log(as_floats(values))


def log_trapezoid_weights(nodes: FloatArray) -> FloatArray:
    """Return log weights of the trapezoidal rule on sorted `nodes` (..., node), same shape.

    Nodes that coincide get weight 0 between them.
    """
    steps = np.diff(nodes, axis=-1)
    weights = np.zeros_like(nodes)
    weights[..., :-1] += 0.5 * steps
    weights[..., 1:] += 0.5 * steps
    return log_of(weights)


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, levels: tuple[float, ...]
) -> FloatArray:
    """Return quantiles of each row of weighted `values`, (..., value) -> (..., level)."""
    order = np.argsort(values, axis=-1)
    values = np.take_along_axis(values, order, axis=-1)
    weights = np.take_along_axis(weights, order, axis=-1)
    total = np.maximum(weights.sum(axis=-1, keepdims=True), np.finfo(float).tiny)
    middle = (np.cumsum(weights, axis=-1) - 0.5 * weights) / total
    flat = middle.reshape(-1, middle.shape[-1]), values.reshape(-1, values.shape[-1])
    rows = [np.interp(levels, m, v) for m, v in zip(*flat, strict=True)]
    return np.array(rows).reshape(*values.shape[:-1], len(levels))
