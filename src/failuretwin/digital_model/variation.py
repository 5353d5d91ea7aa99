"""Robots of a kind: imperfections drawn around given ones, for training and for honest doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.imperfections import Imperfections, Variation
from failuretwin.digital_model.settling import Settling

HIGHEST_LOSS = 0.9
"""Bound on the share of movements in which some command is lost, however unlucky the draw."""


def vary(imperfections: Imperfections, rng: np.random.Generator) -> Imperfections:
    """Return the imperfections of one robot drawn from the variation of `imperfections`.

    Without a variation they are returned as they are, and nothing is drawn.
    """
    variation = imperfections.variation
    if variation is None:
        return imperfections
    settling = imperfections.settling
    if settling is not None:
        settling = _vary_settling(settling, variation, rng)
    factor = float(np.exp(variation.rates * rng.standard_normal()))
    return replace(
        _scale_rates(imperfections, factor),
        name=imperfections.name,
        settling=settling,
        variation=None,
    )


def _vary_settling(settling: Settling, variation: Variation, rng: np.random.Generator) -> Settling:
    def normal(spread: tuple[float, ...]) -> FloatArray:
        return rng.standard_normal(len(settling.bias)) * np.asarray(spread or 0.0)

    return replace(
        settling,
        bias=tuple(settling.bias + normal(variation.bias)),
        compliance=tuple(settling.compliance * np.exp(normal(variation.compliance))),
        friction=tuple(settling.friction + normal(variation.friction)),
        scatter=tuple(settling.scatter * np.exp(normal(variation.scatter))),
        payload=settling.payload + float(rng.uniform(*variation.payload)),
    )


def _scale_rates(imperfections: Imperfections, factor: float) -> Imperfections:
    """Return the imperfections with every rate multiplied by `factor`, as far as shares can be."""
    timing, readings = imperfections.timing, imperfections.readings
    losses = imperfections.lost_commands
    most = max(
        sum(entry.rate for entry in losses), sum(entry.rate_when_late for entry in losses), 1e-9
    )
    share = min(factor, HIGHEST_LOSS / most)
    if readings is not None:
        glitch_rate = tuple(min(1.0, factor * rate) for rate in readings.glitch_rate)
        readings = replace(readings, glitch_rate=glitch_rate)
    return replace(
        imperfections,
        timing=replace(timing, late_rate=min(1.0, factor * timing.late_rate)),
        lost_commands=tuple(
            replace(entry, rate=share * entry.rate, rate_when_late=share * entry.rate_when_late)
            for entry in losses
        ),
        readings=readings,
    )
