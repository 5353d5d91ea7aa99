"""An arm whose two motors turn about the same axis: they differ by their commands alone."""

from __future__ import annotations

from failuretwin import DigitalTwin, load_robot

ARM_M = 0.3

URDF = f"""<robot name="coaxial">
<link name="base"/><link name="ring"/><link name="arm"/><link name="tip"/>
<joint name="lower" type="revolute"><parent link="base"/><child link="ring"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="5"/></joint>
<joint name="upper" type="revolute"><parent link="ring"/><child link="arm"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="5"/></joint>
<joint name="end" type="fixed"><parent link="arm"/><child link="tip"/>
<origin xyz="{ARM_M} 0 0"/></joint></robot>"""

MOTOR = """
[[motors]]
name = "{name}"
joint = "{joint}"
loop = {{ P = 0.3, I = 40.0, filter_s = 0.01 }}
speed_limit = 5.0
movement_range = [-1.0, 1.0]
"""

PROFILE = """name = "coaxial"
urdf = "coaxial.urdf"
base_link = "base"
tool_link = "tip"
"""


def coaxial_twin(folder):
    """Return the twin of an arm of 0.3 m that motors 1 and 2 turn about z."""
    (folder / "coaxial.urdf").write_text(URDF)
    motors = (("motor_1", "lower"), ("motor_2", "upper"))
    text = PROFILE + "".join(MOTOR.format(name=name, joint=joint) for name, joint in motors)
    (folder / "coaxial.toml").write_text(text)
    return DigitalTwin(load_robot(folder / "coaxial.toml"))
