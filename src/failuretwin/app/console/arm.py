"""The arm in 3-D: links between the joint frames of its URDF, where it is and where it was told.

It is drawn in the pose that the tool path belongs to, `Robot.sensor_sense`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import cos, sin

import numpy as np
from nicegui import ui
from nicegui.elements.scene.scene_object3d import Object3D

from failuretwin.app.console import draw, texts
from failuretwin.app.console.state import SUSPECT
from failuretwin.core.hypothesis import SURE
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.kinematics import rotation_to_z
from failuretwin.digital_model.robot import Robot

THICK = 0.03
"""Radius of a link, as a share of the reach of the arm."""
GHOST, LINK = "#2f7fd0", "#7d8790"
SHADES = ((SURE, "#b3261e"), (SUSPECT, "#d98e00"), (0.0, "#1b6e3c"))
"""Colour of a motor from a probability of a fault on."""
VIEWS = {
    texts.CORNER: (0.65, -0.65, 1.1),
    texts.FRONT: (0.0, -1.3, 0.4),
    texts.SIDE: (1.3, 0.0, 0.4),
    texts.ABOVE: (0.0, -0.01, 1.7),
}
"""Places of the camera, in reaches of the arm; the first is high: it shows arms that fold."""
TURN_S = 0.5
"""Time in which the camera goes to another place [s]."""
LIGHT, DARK = "#eef1f4", "#1d2429"
"""Background on light and on dark pages."""
DARKEN = (
    "() => {if (!document.body.classList.contains('body--dark')) return;"
    f"const shown = getElement(%d); shown.renderer.setClearColor('{DARK}');"
    "for (const one of shown.scene.children)"
    f"if (one.object_id === 'ground') one.material.color.set('{DARK}')}}"
)
"""Darkens the background of a scene, by its number, on dark pages: only the browser knows those."""
REACHED, MISSED = [0.11, 0.43, 0.24], [0.7, 0.15, 0.12]


class Arm:
    """An arm of a scene, whose joints are groups in groups.

    Args:
        robot: The robot.
        solid: Whether it is drawn solid; a ghost is transparent.
    """

    def __init__(self, robot: Robot, scene: ui.scene, solid: bool) -> None:
        self._robot = robot
        self._slides = robot.slides
        self._joints: list[Object3D] = []
        self._motors: list[Object3D] = []
        self._shade = [""] * len(robot.motors)
        transforms, _ = robot.chain.constants
        radius = THICK * robot.reach * (1.0 if solid else 0.8)
        colour, opacity = (LINK, 1.0) if solid else (GHOST, 0.35)
        with scene:
            self._link(transforms[0][:3, 3], radius, colour, opacity)
            self._grow(scene, list(transforms), radius, colour, opacity, solid)

    def _grow(
        self,
        scene: ui.scene,
        transforms: list[FloatArray],
        radius: float,
        colour: str,
        opacity: float,
        solid: bool,
    ) -> None:
        """Draw a joint and what it carries."""
        place, rest = transforms[0], transforms[1:]
        with scene.group().move(*place[:3, 3].tolist()).rotate_R(place[:3, :3].tolist()):
            if not rest:
                scene.sphere(0.7 * radius).material(colour, opacity)
                return
            with scene.group() as joint:
                self._joints.append(joint)
                motor = scene.sphere(1.5 * radius).material(colour, opacity)
                if solid:
                    self._motors.append(motor)
                self._link(rest[0][:3, 3], radius, colour, opacity)
                self._grow(scene, rest, radius, colour, opacity, solid)

    def _link(self, end: FloatArray, radius: float, colour: str, opacity: float) -> None:
        length = float(np.linalg.norm(end))
        if length < 1e-6:
            return
        cylinder = ui.scene.cylinder(radius, radius, length, 16).material(colour, opacity)
        cylinder.move(*(0.5 * end).tolist()).rotate_R(_along(end))

    def pose(self, angles: FloatArray) -> None:
        """Move the joints to angles in the sense of the log, (motor,) [rad or m]."""
        for joint, slides, value in zip(
            self._joints, self._slides, (angles * self._robot.sensor_sense).tolist(), strict=True
        ):
            if slides:
                joint.move(0.0, 0.0, round(value, 5))
                continue
            c, s = round(cos(value), 5), round(sin(value), 5)
            joint.rotate_R([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def colour(self, shares: Mapping[str, float]) -> None:
        """Colour the motors by their probability of a fault."""
        for k, name in enumerate(self._robot.motor_names):
            shade = next(c for least, c in SHADES if shares.get(name, 0.0) >= least)
            if self._shade[k] != shade and self._motors:
                self._motors[k].material(shade, 1.0)
                self._shade[k] = shade


def _along(direction: FloatArray) -> list[list[float]]:
    """Return a rotation that turns y, the axis of a cylinder, to a direction."""
    turned: list[list[float]] = rotation_to_z(direction.tolist())[:, [1, 2, 0]].tolist()
    return turned


class ArmScene:
    """A scene with an arm where it is, its ghost where it was told to be, and points.

    Args:
        robot: The robot.
        label: What the scene shows, for screen readers.
    """

    def __init__(self, robot: Robot, label: str) -> None:
        self._robot, self._label = robot, label
        self._place = ui.element("div").classes("scene")
        self._scene: ui.scene | None = None
        with ui.row().classes("gap-2").props(f'role="group" aria-label="{texts.VIEW}"'):
            for name, place in VIEWS.items():
                draw.button(name, partial(self._view, place, TURN_S)).props("outline")
        self._arms: tuple[Arm, Arm] | None = None
        self._now: tuple[FloatArray, FloatArray, Mapping[str, float]] | None = None
        self._cloud: tuple[list[list[float]], list[list[float]]] = [], []
        draw.later(self._load)

    def _load(self) -> None:
        reach = self._robot.reach
        with self._place:
            scene = ui.scene(480, 380, grid=(2, 20), background_color=LIGHT, fps=10)
            scene.props(f'role="img" aria-label="{self._label}"').classes("full")
            scene.on("init", js_handler=DARKEN % scene.id)
        self._arms = Arm(self._robot, scene, solid=True), Arm(self._robot, scene, solid=False)
        with scene:
            self._points = ui.scene.point_cloud(*self._cloud, point_size=0.012 * reach / 0.3)
        self._scene = scene
        self._view(VIEWS[texts.CORNER], 0.0)
        if self._now is not None:
            self.show(*self._now)

    def _view(self, place: tuple[float, float, float], duration_s: float) -> None:
        """Look at the arm from a place [reaches of the arm]."""
        x, y, z = (self._robot.reach * one for one in place)
        if self._scene is not None:
            height = 0.4 * self._robot.reach
            self._scene.move_camera(x, y, z, 0.0, 0.0, height, duration=duration_s)

    def show(self, pose: FloatArray, command: FloatArray, shares: Mapping[str, float]) -> None:
        """Draw both arms: poses in the sense of the log, (motor,) [rad or m]."""
        self._now = pose, command, shares
        if self._arms is not None:
            solid, ghost = self._arms
            solid.pose(pose)
            ghost.pose(command)
            solid.colour(shares)

    def points(self, points: FloatArray, reached: BoolArray) -> None:
        """Draw points (point, 3) [m] in green where they can be reached, else in red."""
        colours = [REACHED if one else MISSED for one in reached.tolist()]
        self._cloud = points.tolist(), colours
        if self._arms is not None:
            self._points.set_points(*self._cloud)
