"""Windows of movements that another healthy robot looks at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.decision.streaming.window import MovementWindow
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.inference.observation.healthy_model import HealthyModel


def test_a_window_takes_the_outcomes_of_another_robot(twin):
    """One that hardly loses commands has fewer outcomes than one that often does."""
    usual = HealthyModel(twin, generic_imperfections(twin.robot))
    rare = [replace(e, rate=1e-6, rate_when_late=1e-6) for e in usual.imperfections.lost_commands]
    calm = replace(usual, imperfections=replace(usual.imperfections, lost_commands=tuple(rare)))
    window, robots = MovementWindow.of(usual, 2, 4), np.arange(2)
    evidence = window.settled
    shapes = [
        window.judge(robots, evidence, model).outcomes.log_weight.shape
        for model in (usual, calm, usual)
    ]
    assert shapes[0] == shapes[2] != shapes[1]
    assert len(window.looks) == 2
