from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.digital_model.kinematics import CANNOT_MOVE, levers
from failuretwin.digital_model.profile_text import movement_range, profile_text, speed_limit
from failuretwin.digital_model.robot import bundled_folder, load_robot
from failuretwin.digital_model.urdf.check import check_urdf
from failuretwin.digital_model.urdf.file import read_urdf


def link(name, mass="0.5", moment="1e-4", more=""):
    inertia = f'<inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>'
    weight = f'<inertial><mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{weight}{more}</link>'


TURN = """<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="2" effort="3"/></joint>"""
LIFT = """<joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/>
<origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-0.5" upper="1.5" velocity="2" effort="3"/></joint>"""
ROLL = """<joint name="roll" type="revolute"><parent link="fore"/><child link="hand"/>
<origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="2" effort="3"/></joint>"""
MOUNT = """<joint name="mount" type="fixed"><parent link="hand"/><child link="tip"/>
<origin xyz="0.1 0 0"/></joint>"""
LINKS = link("base") + link("upper") + link("fore") + link("hand") + '<link name="tip"/>'
ARM = f'<robot name="arm">{LINKS}{TURN}{LIFT}{ROLL}{MOUNT}</robot>'

FINGER = """<joint name="finger" type="revolute"><parent link="hand"/><child link="jaw"/>
<origin xyz="0 0.05 0"/><limit lower="0" upper="1" velocity="1" effort="1"/>{}</joint>"""
MIMIC = '<mimic joint="lift" multiplier="-1"/>'


@pytest.fixture
def arm(tmp_path):
    """Write the arm with pieces of its text replaced, and return the path."""

    def write(*replacements, name="arm.urdf"):
        text = ARM
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def end(*more):
    return ("</robot>", "".join(more) + "</robot>")


def test_a_sound_arm_has_no_findings(arm):
    report = check_urdf(arm())

    assert report.findings == ()
    assert (report.name, report.base_link, report.tool_link) == ("arm", "base", "tip")
    assert [(m.motor, m.joint.name) for m in report.motors] == [
        ("motor_1", "turn"),
        ("motor_2", "lift"),
    ]
    assert [(o.joint.name, o.reason) for o in report.others] == [
        ("roll", "its axis runs through the tool point"),
        ("mount", "fixed"),
    ]
    assert report.moving_mass == pytest.approx(1.5)
    # Stretched out at the lift angle that is in line with the base's origin as far as limits let.
    assert report.reach == pytest.approx(np.hypot(0.3 + 0.4 * np.sin(0.5), 0.4 * np.cos(0.5)))
    turn = report.motors[0].joint
    assert (turn.low, turn.high, turn.velocity, turn.effort) == (-1.0, 1.0, 2.0, 3.0)


ERRORS = {
    "unknown type": (
        [('type="revolute"', 'type="revolut"')],
        "joint 'turn': unknown joint type 'revolut'. Did you mean 'revolute'?",
    ),
    "several roots": (
        [end(link("table"))],
        "2 links hang from no joint: 'base', 'table'. A URDF has one root. Name the base with "
        "--base LINK.",
    ),
    "no root": (
        [
            end(
                '<joint name="back" type="fixed"><parent link="tip"/><child link="base"/></joint>',
            )
        ],
        "no link is a root: every link is the child of a joint",
    ),
    "no moving joint": (
        [(f'"{name}" type="revolute"', f'"{name}" type="fixed"') for name in ("turn", "lift")]
        + [('"roll" type="revolute"', '"roll" type="fixed"')],
        "no joint on the way to the tool moves, so there is no motor to watch.",
    ),
    "motors that only roll": (
        [(f'"{name}" type="revolute"', f'"{name}" type="fixed"') for name in ("turn", "lift")],
        "no motor can move the tool point, the origin of link 'tip'",
    ),
    "loop": (
        [end('<joint name="rod" type="fixed"><parent link="base"/><child link="fore"/></joint>')],
        "link 'fore' is the child of several joints, which closes a loop on the way to the tool",
    ),
    "link twice": ([end(link("fore"))], "link 'fore' stands in the file twice."),
    "joint twice": (
        [('"lift" type', '"turn" type')],
        "joint 'turn' stands in the file twice. Give each its own name.",
    ),
}

WARNINGS = {
    "missing mesh": (
        [(link("fore"), link("fore", more='<visual><mesh filename="meshes/fore.stl"/></visual>'))],
        "1 mesh is not found ('meshes/fore.stl')",
    ),
    "no inertia": (
        [(link("fore"), '<link name="fore"/>')],
        "link 'fore' has no <inertial> mass: gravity cannot be computed for it.",
    ),
    "mass zero": (
        [(link("fore"), link("fore", mass="0"))],
        "the mass of link 'fore' is not above zero: gravity cannot be computed for it.",
    ),
    "mass below zero": (
        [(link("hand"), link("hand", mass="-1"))],
        "the mass of link 'hand' is not above zero",
    ),
    "mass unreadable": (
        [(link("hand"), link("hand", mass="heavy"))],
        "link 'hand' has no <inertial> mass",
    ),
    "no moments": (
        [(link("fore"), link("fore", moment="0"))],
        "link 'fore' has a mass but no moments of inertia above zero",
    ),
    "no limits": (
        [('<limit lower="-1" upper="1" velocity="2" effort="3"/>', "")],
        "joint 'turn' has no limits: a range will be assumed.",
    ),
    "limits of zero": (
        [('lower="-1" upper="1"', 'lower="0" upper="0"')],
        "joint 'turn' has no room in its limits: a range will be assumed.",
    ),
    "mimic on the way": (
        [(LIFT, LIFT.replace("</joint>", '<mimic joint="turn"/></joint>'))],
        "joint 'lift' follows joint 'turn' (mimic), so it is no motor. It lies on the way to the "
        "tool and is held at zero",
    ),
    "floating": (
        [('"lift" type="revolute"', '"lift" type="floating"')],
        "joint 'lift' is floating and is held at zero",
    ),
    "sliding": (
        [('"lift" type="revolute"', '"lift" type="prismatic"')],
        "joint 'lift' slides: its angles and faults are in m",
    ),
    "loop beside": (
        [
            end(
                link("jaw"),
                FINGER.format(MIMIC),
                '<joint name="rod" type="fixed"><parent link="fore"/><child link="jaw"/></joint>',
            )
        ],
        "link 'jaw' is the child of several joints; not on the way to the tool",
    ),
    "link without element": (
        [end('<joint name="eye" type="fixed"><parent link="fore"/><child link="camera"/></joint>')],
        "link 'camera' is named by a joint but has no <link> element. Add it.",
    ),
}

NOTES = {
    "package mesh": (
        [
            (
                link("fore"),
                link("fore", more='<visual><mesh filename="package://a/b.stl"/></visual>'),
            )
        ],
        "1 mesh is named by a package address that only ROS can resolve ('package://a/b.stl')",
    ),
    "endless": (
        [('"turn" type="revolute"', '"turn" type="continuous"')],
        "joint 'turn' turns without end, so a range will be assumed.",
    ),
    "several tools": (
        [end(link("tip2"), FINGER.format(MIMIC).replace("jaw", "tip2"))],
        "several links could be the tool: tip (3 moving), tip2 (3 moving). Took 'tip'",
    ),
    "mimic beside": (
        [end(link("jaw"), FINGER.format(MIMIC))],
        "joint 'finger' follows another joint (mimic), so it is no motor.",
    ),
    "short lever": (
        [('<origin xyz="0.1 0 0"/>', '<origin xyz="0.1 0.004 0"/>')],
        "joint 'roll' moves the tool by 4 mm for each rad at most",
    ),
}


@pytest.mark.parametrize(("changes", "message"), ERRORS.values(), ids=ERRORS)
def test_errors_keep_a_file_from_use(arm, changes, message):
    path = arm(*changes)
    report = check_urdf(path)

    assert [m for m in report.having("error") if m.startswith(message)] != []
    with pytest.raises(InputError) as error:
        report.raise_errors()
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("severity", "changes", "message"),
    [("warning", *case) for case in WARNINGS.values()]
    + [("note", *case) for case in NOTES.values()],
    ids=[*WARNINGS, *NOTES],
)
def test_findings_that_leave_a_file_usable(arm, severity, changes, message):
    report = check_urdf(arm(*changes))

    assert [m for m in report.having(severity) if m.startswith(message)] != []
    assert report.having("error") == []
    report.raise_errors()
    assert report.motors != []


@pytest.mark.parametrize(
    "changes", [c for c, _ in WARNINGS.values()] + [c for c, _ in NOTES.values()]
)
def test_every_usable_file_becomes_a_robot_that_moves(arm, tmp_path, changes):
    path = tmp_path / "arm.toml"
    report = check_urdf(arm(*changes))
    path.write_text(profile_text(report, path), encoding="utf-8")

    robot = load_robot(path)

    assert robot.motor_names == [motor.motor for motor in report.motors]
    assert np.all(levers(robot.chain) >= CANNOT_MOVE)


def test_kinematics_does_not_need_masses_meshes_or_mimic_joints(arm):
    whole = read_urdf(arm()).chain("base", "tip", ["turn", "lift", "roll"])
    bare = [(link(name), f'<link name="{name}"/>') for name in ("base", "upper", "fore", "hand")]
    mesh = '<visual><geometry><mesh filename="package://lost/fore.dae"/></geometry></visual>'
    bare[2] = (link("fore"), f'<link name="fore">{mesh}</link>')
    path = arm(*bare, end('<link name="jaw"/>', FINGER.format(MIMIC)))
    report = check_urdf(path, tool="tip")
    poses = np.random.default_rng(3).uniform(-1, 1, (20, 3))

    assert report.having("error") == []
    chain = read_urdf(path).chain("base", "tip", ["turn", "lift", "roll"])
    np.testing.assert_array_equal(chain.position(poses), whole.position(poses))


def test_an_axis_through_the_tool_point_is_seen_through_rounding(arm):
    skew = ROLL.replace("1 0 0", "1 2 3")
    path = arm((ROLL, skew), ('<origin xyz="0.1 0 0"/>', '<origin xyz="0.1 0.2 0.3"/>'))
    chain = read_urdf(path).chain("base", "tip", ["turn", "lift", "roll"])

    assert 0.0 < levers(chain)[2] < 1e-15
    assert [motor.joint.name for motor in check_urdf(path).motors] == ["turn", "lift"]


def test_a_moving_joint_off_the_way_has_no_motor(arm):
    report = check_urdf(arm(end(link("jaw"), FINGER.format(""))), tool="tip")
    reasons = {other.joint.name: other.reason for other in report.others}
    assert reasons["finger"] == "not on the way to the tool"
    assert report.findings == ()


def test_what_a_motor_moves_against_a_hand_is_no_tool_whatever_its_name(arm):
    further = FINGER.format("").replace("0.05", "0.001").replace("jaw", "tip2")
    assert check_urdf(arm(end(link("tip2"), further))).tool_link == "tip"


def test_base_and_tool_can_be_named(arm):
    report = check_urdf(arm(end(link("table"))), base="upper", tool="hand")
    assert (report.base_link, report.tool_link) == ("upper", "hand")
    assert [motor.joint.name for motor in report.motors] == ["lift"]
    assert report.having("warning") == [
        "2 links hang from no joint: 'base', 'table'. A URDF has one root. The base is 'upper'.",
        "the base 'upper' moves with turn, which are then no motors. Name a link that is fixed to "
        "the foot.",
    ]


@pytest.mark.parametrize(
    ("base", "tool", "message"),
    [
        ("bse", None, "unknown link 'bse'. Did you mean 'base'?"),
        (None, "tipp", "unknown link 'tipp'. Did you mean 'tip'?"),
        ("fore", "upper", "no chain of joints leads from 'fore' to 'upper'"),
    ],
)
def test_links_that_do_not_fit_are_refused(arm, base, tool, message):
    with pytest.raises(InputError) as error:
        check_urdf(arm(), base, tool)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("content", "name", "out"),
    [
        ("<xacro:macro name='m'/>", "arm.urdf.xacro", "arm.urdf"),
        ("<xacro:macro name='m'/>", "arm.xacro", "arm.urdf"),
        ("<xacro:include filename='a'/>", "arm.urdf", "arm_expanded.urdf"),
        ("<link name='${prefix}base'/>", "arm.urdf", "arm_expanded.urdf"),
        ("<link name='$(arg prefix)base'/>", "arm.urdf", "arm_expanded.urdf"),
    ],
)
def test_a_xacro_file_says_how_to_expand_it(arm, content, name, out):
    path = arm(end(content), name=name)
    with pytest.raises(InputError) as error:
        check_urdf(path)
    assert str(error.value) == (
        f"{path}: contains xacro tags, so it is the template of a URDF. Expand it with "
        f"`xacro {name} > {out}` and give that file."
    )


def test_an_expanded_file_may_still_speak_of_xacro(arm):
    origin = "<!-- made by <xacro:macro> from ${name}.xacro -->"
    declared = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">'
    path = arm(('<robot name="arm">', declared + origin), name="arm.xacro")
    assert check_urdf(path).having("note") == [
        "the name ends in .xacro but the file holds no xacro tags. Taken as a URDF."
    ]


def test_meshes_that_exist_are_found(arm, tmp_path):
    (tmp_path / "fore.stl").write_text("solid")
    visual = '<visual><mesh filename="fore.stl"/></visual>'
    assert check_urdf(arm((link("fore"), link("fore", more=visual)))).findings == ()


def test_a_frame_without_mass_on_a_heavy_link_is_fine(arm):
    path = arm((link("hand"), '<link name="hand"/>'), ('<link name="tip"/>', link("tip")))
    assert check_urdf(path).findings == ()


def test_what_exporters_write_for_frames_is_fine(arm):
    axis = '<origin xyz="0.1 0 0"/><axis xyz="0 0 0"/>'
    tip = ('<link name="tip"/>', link("tip", mass="1e-9", moment="0"))
    path = arm(('<origin xyz="0.1 0 0"/>', axis), tip)
    assert check_urdf(path).findings == ()


def test_errors_are_all_named_at_once(arm):
    path = arm(('type="revolute"', 'type="hinge"'), ('type="revolute"', 'type="ball"'))
    with pytest.raises(InputError) as error:
        check_urdf(path).raise_errors()
    assert "'hinge'" in str(error.value)
    assert "\n  also: joint 'lift': unknown joint type 'ball'" in str(error.value)


def test_reach_is_that_of_an_arm_stretched_out():
    report = check_urdf(bundled_folder() / "armpi_fpv.urdf", tool="link5")
    assert report.reach == pytest.approx(0.310509, abs=1e-6)


def test_speed_and_effort_of_zero_mean_that_they_are_not_known(arm):
    path = arm(('velocity="2" effort="3"', 'velocity="0" effort="0"'))
    turn = check_urdf(path).motors[0].joint
    assert (turn.velocity, turn.effort) == (None, None)
    assert speed_limit(turn) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("limits", "low", "high", "note"),
    [
        ('lower="-0.4" upper="0.6" velocity="2"', -0.4, 0.6, "The limits of the URDF."),
        ('lower="0" upper="4" velocity="2"', 1.0, 3.0, "Limits of the URDF (0 to 4) narrowed so"),
        ('lower="-6" upper="6" velocity="9"', -np.pi / 2, np.pi / 2, "Limits of the URDF (-6 to"),
        ('lower="0" upper="0" velocity="9"', -np.pi / 2, np.pi / 2, "Assumed: the URDF has no"),
    ],
)
def test_movement_ranges_leave_time_at_rest(arm, limits, low, high, note):
    path = arm(('lower="-1" upper="1" velocity="2"', limits))
    found = movement_range(check_urdf(path).motors[0].joint)
    assert found[:2] == pytest.approx((low, high))
    assert found[2].startswith(note)


def test_the_profile_says_what_is_assumed(arm, tmp_path):
    report = check_urdf(arm(('<limit lower="-1" upper="1" velocity="2" effort="3"/>', "")))
    text = profile_text(report, tmp_path / "arm.toml")
    sources = text[text.index("[sources]") : text.index("[[motors]]")]

    assert 'speed_limit = "URDF; assumed for motor_1"' in sources
    assert (
        'movement_range = "URDF limits, narrowed to keep plateaus; assumed for motor_1"' in sources
    )
    assert 'loop = "assumed: typical position servo"' in sources
    assert '#   "roll": its axis runs through the tool point' in text
    assert '#   "mount": fixed' in text


def test_every_line_of_a_profile_fits_a_screen(arm, tmp_path):
    text = profile_text(check_urdf(arm()), tmp_path / "arm.toml")
    assert max(len(line) for line in text.splitlines()) <= 100


def test_the_profile_finds_its_urdf_from_another_folder(arm, tmp_path):
    profile = tmp_path / "profiles" / "mine.toml"
    profile.parent.mkdir()
    text = profile_text(check_urdf(arm()), profile)
    profile.write_text(text, encoding="utf-8")

    assert 'urdf = "../arm.urdf"' in text
    assert load_robot(profile).name == "arm"


def test_odd_names_survive_the_profile(arm, tmp_path):
    odd = 'turn "1" \\ ä'
    path = arm(('joint name="turn"', f"joint name='{odd}'"))
    profile = tmp_path / "arm.toml"
    profile.write_text(profile_text(check_urdf(path), profile), encoding="utf-8")
    assert load_robot(profile).motors[0].joint == odd


def test_no_profile_is_made_of_a_file_with_errors(arm, tmp_path):
    report = check_urdf(arm(end(link("table"))))
    with pytest.raises(InputError, match="2 links hang from no joint"):
        profile_text(report, tmp_path / "arm.toml")
