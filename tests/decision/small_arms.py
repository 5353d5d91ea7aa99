"""Arms that no bundled one is like: of slides, and of a joint that turns nearly all around."""

from __future__ import annotations

from failuretwin import DigitalTwin, load_robot

LINK = '<link name="{name}"/>'
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{xyz}"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="1" velocity="5"/></joint>"""
MOTOR = """
[[motors]]
name = "motor_{k}"
joint = "j{k}"
loop = {{ P = 0.3, I = 40.0, filter_s = 0.01 }}
speed_limit = 5.0
movement_range = [{low}, {high}]
"""

GANTRY = [
    ("prismatic", "0 0 0", "1 0 0", (-0.3, 0.3)),
    ("prismatic", "0 0 0", "0 1 0", (-0.2, 0.4)),
    ("prismatic", "0 0 0", "0 0 1", (0.0, 0.5)),
]
"""A tool on three slides that meet in the base: kind, origin, axis, range of movements."""
SCARA = [
    ("prismatic", "0 0 0.2", "0 0 1", (0.0, 0.3)),
    ("revolute", "0 0 0", "0 0 1", (-2.6, 2.6)),
    ("revolute", "0.25 0 0", "0 0 1", (-2.0, 2.0)),
]
"""A lift and two links in the plane."""

PLANAR = [
    ("revolute", "0 0 0.2", "0 0 1", (-1.2, 1.2)),
    ("revolute", "0.25 0 0", "0 0 1", (-1.2, 1.2)),
]
"""Two links in a plane 0.2 m above the base."""


def small_twin(folder, name, joints, tool="0 0 0"):
    """Return the twin of an arm; its files are written to `folder`."""
    links = ["base", *(f"l{k}" for k in range(1, len(joints) + 1)), "tip"]
    parts = [LINK.format(name=link) for link in links]
    motors = []
    for k, (kind, xyz, axis, (low, high)) in enumerate(joints, start=1):
        ends = {"low": 1.2 * low - 0.1, "high": 1.2 * high + 0.1}
        parts.append(
            JOINT.format(
                name=f"j{k}",
                kind=kind,
                parent=links[k - 1],
                child=links[k],
                xyz=xyz,
                axis=axis,
                **ends,
            )
        )
        motors.append(MOTOR.format(k=k, low=low, high=high))
    parts.append(
        f'<joint name="end" type="fixed"><parent link="{links[-2]}"/><child link="tip"/>'
        f'<origin xyz="{tool}"/></joint>'
    )
    (folder / f"{name}.urdf").write_text(f'<robot name="{name}">{"".join(parts)}</robot>')
    head = f'name = "{name}"\nurdf = "{name}.urdf"\nbase_link = "base"\ntool_link = "tip"\n'
    (folder / f"{name}.toml").write_text(head + "".join(motors))
    return DigitalTwin(load_robot(folder / f"{name}.toml"))
