"""A robot with a single motor: a point mass on a rod, a case with closed forms."""

from __future__ import annotations

from failuretwin import load_robot
from failuretwin.digital_model.physics.motors import MotorPhysics, PhysicsParameters

MASS_KG = 0.7
ROD_M = 0.4
GRAVITY_M_S2 = 9.81
SPEED_LIMIT = 30.0
POINT_INERTIA = 1e-6
INERTIA = MASS_KG * ROD_M**2 + POINT_INERTIA
"""About the joint, which carries the rod along z."""

MOTOR = MotorPhysics(
    name="motor_1",
    stiffness=40.0,
    derivative=1.5,
    filter_s=0.02,
    damping=0.5,
    armature=0.03,
    friction=0.0,
    friction_yield=0.001,
    torque_limit=100.0,
    flex_stiffness=120.0,
    flex_damping=0.8,
    flex_inertia=0.004,
)

URDF = """<robot name="rod">
<link name="base"/><link name="rod">{inertial}</link><link name="tip"/>
<joint name="swing" type="revolute"><parent link="base"/><child link="rod"/>
<origin xyz="0 0 1" rpy="{rpy}"/><axis xyz="{axis}"/>
<limit lower="-3" upper="3" effort="{effort}" velocity="30"/></joint>
<joint name="end" type="fixed"><parent link="rod"/><child link="tip"/>
<origin xyz="{along}"/></joint>
{more}</robot>"""

PROFILE = f"""name = "rod"
urdf = "rod.urdf"
base_link = "base"
tool_link = "tip"
[[motors]]
name = "motor_1"
joint = "swing"
sense = {{sense}}
loop = {{{{ P = 0.3, I = 40.0, filter_s = 0.01 }}}}
speed_limit = {SPEED_LIMIT}
movement_range = [-1.0, 1.0]
"""

POINT_MASS = (
    f'<inertial><origin xyz="{{along}}"/><mass value="{MASS_KG}"/><inertia ixx="{POINT_INERTIA}" '
    f'iyy="{POINT_INERTIA}" izz="{POINT_INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def pendulum(folder, sense=1.0, inertial=POINT_MASS, more="", effort=100):
    """Return the robot that swings about x, upright at zero."""
    return _robot(folder, f"0 0 {ROD_M}", "1 0 0", "0 0 0", sense, inertial, more, effort)


def turntable(folder):
    """Return the robot that turns about z, which no weight loads."""
    return _robot(folder, f"{ROD_M} 0 0", "0 0 1", "0 0 0", 1.0, POINT_MASS, "", 100)


def _robot(folder, along, axis, rpy, sense, inertial, more, effort):
    text = URDF.format(
        inertial=inertial.format(along=along),
        along=along,
        axis=axis,
        rpy=rpy,
        more=more,
        effort=effort,
    )
    (folder / "rod.urdf").write_text(text)
    (folder / "rod.toml").write_text(PROFILE.format(sense=sense))
    return load_robot(folder / "rod.toml")


def motors(*motors):
    return PhysicsParameters("test", motors)
