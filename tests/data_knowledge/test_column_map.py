from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from failuretwin import (
    BayesDiagnoser,
    DigitalTwin,
    ReadOptions,
    SetupPrior,
    load_robot,
    read_runs,
)
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.column_guess import column_map_text
from failuretwin.data_knowledge.readers.column_map import read_column_map
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.profile_text import profile_text
from failuretwin.digital_model.urdf.check import check_urdf
from failuretwin.inference.faults.priors import Priors

ARMS = ("armpi_fpv", "ur5e", "panda", "so101")
MAP = """
[time]
column = "t"
unit = "{time}"
[command]
columns = ["a", "b", "c", "d"]
kind = "{kind}"
unit = "{angle}"
{more}
[tool]
columns = ["x", "y", "z"]
unit = "mm"
"""


def foreign_table(runs):
    """Return the runs as another logger would write them: degrees, millimetres, uneven times."""
    rng, parts = np.random.default_rng(0), []
    time = runs["time"].values
    for i, name in enumerate(runs["run"].values):
        seen = np.isfinite(runs["measured"].values[i]).all(axis=1)
        kept = np.flatnonzero(
            (seen & (rng.random(len(time)) < 0.9)) | (rng.random(len(time)) < 0.3)
        )
        columns = {"trial": str(name), "Time (ms)": np.round(1000 * time[kept], 1)}
        for k in range(runs.sizes["motor"]):
            angle = np.rad2deg(runs["command"].values[i, kept, k])
            columns[f"J{k + 1}_cmd_deg"] = np.round(angle, 3)
        for a, axis in enumerate("xyz"):
            columns[f"TCP {axis} [mm]"] = np.round(1000 * runs["measured"].values[i, kept, a], 3)
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts)


@pytest.mark.parametrize("name", ARMS)
def test_a_foreign_log_gets_the_diagnosis_of_the_direct_way(tmp_path, name):
    robot = load_robot(name)
    own = "none" if robot.imperfections_file is None else name
    hypotheses = paper_hypotheses(robot.motor_names)[:: len(robot.motors)]
    known = load_calibration(own, robot).imperfections
    plan = Plan(robot, hypotheses, 1, seed=2, imperfections=known)
    runs, log = simulate(plan), tmp_path / "log.csv"
    foreign_table(runs).to_csv(log, index=False)
    mapping = tmp_path / "map.toml"
    mapping.write_text(column_map_text(log, robot))

    options = ReadOptions(columns=read_column_map(mapping, robot))
    foreign = read_runs(log, robot, options)

    known_set_up = Priors(setup=SetupPrior.known())  # nothing makes up for a wrong unit or sign
    diagnoser = BayesDiagnoser(DigitalTwin(robot), priors=known_set_up)
    direct = diagnoser.diagnose(runs)
    mapped = diagnoser.diagnose(foreign)
    assert [d.diagnosis for d in mapped] == [d.diagnosis for d in direct]


def write(folder, table, **words):
    words = {"time": "s", "kind": "sampled", "angle": "rad", "more": ""} | words
    (folder / "map.toml").write_text(MAP.format(**words))
    table.to_csv(folder / "log.csv", index=False)
    return folder / "log.csv"


def read(folder, robot):
    mapping = read_column_map(folder / "map.toml", robot)
    return read_runs(folder / "log.csv", robot, ReadOptions(columns=mapping))


def table(time, command, tool):
    columns = dict(zip("abcd", np.transpose(command), strict=True))
    return pd.DataFrame({"t": time} | columns | dict(zip("xyz", 1000 * tool.T, strict=True)))


@pytest.mark.parametrize(
    ("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("iso", None)]
)
def test_times_in_every_unit(armpi, twin, tmp_path, unit, scale):
    time = np.arange(100) * 0.1
    command = np.outer(np.clip(time - 1.0, 0.0, 1.0), [0.5, -0.4, 0.3, 0.2])
    stamps = 1.7e9 * (scale or 1.0) + time * (scale or 1.0)
    if scale is None:
        stamps = [str(t) for t in pd.to_datetime(1_700_000_000_000 + 1000 * time, unit="ms")]
    write(tmp_path, table(stamps, command, twin.path(command)), time=unit)

    runs = read(tmp_path, armpi)

    assert runs.sizes["time"] == 991
    np.testing.assert_allclose(runs["command"][0, ::10], command, atol=3e-3)
    np.testing.assert_allclose(runs["measured"][0, ::10], twin.path(command), atol=1e-6)


def test_targets_with_durations_in_servo_counts(armpi, tmp_path):
    rows = pd.DataFrame(
        {
            "t": [0.0, 0.5, 1.0, 2.5, 3.0, 4.5],
            **{m: [np.nan, np.nan, 600, 600, 400, 400] for m in "abcd"},
            **{axis: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5] for axis in "xyz"},
            "d": [np.nan, np.nan, 600, 600, 400, 400],
            "ms": [np.nan, np.nan, 800, np.nan, 1000, np.nan],
        }
    )
    more = 'duration_columns = ["ms"]\nduration_unit = "ms"'
    write(tmp_path, rows, kind="target", angle="servo", more=more)

    runs = read(tmp_path, armpi)

    np.testing.assert_allclose(runs["movement_start"][0], [1.0, 3.0])
    np.testing.assert_allclose(runs["ramp_duration"][0], [[0.8] * 4, [1.0] * 4])
    np.testing.assert_allclose(np.rad2deg(runs["target"][0, :, 0]), [-24.0, 24.0])


def test_sign_and_zero_of_another_convention(armpi, twin, tmp_path):
    time = np.arange(50) * 0.1
    command = np.outer(np.clip(time - 1.0, 0.0, 1.0), [0.5, -0.4, 0.3, 0.2])
    logged = command * [1, 1, -1, 1] + [0.1, 0.0, 0.0, 0.0]
    more = "sign = [1, 1, -1, 1]\nzero = [0.1, 0, 0, 0]"
    write(tmp_path, table(time, logged, twin.path(command)), more=more)

    runs = read(tmp_path, armpi)

    np.testing.assert_allclose(runs["command"][0, ::10], command, atol=3e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"time": "sec"}, "unknown unit 'sec'"),
        ({"angle": "radians"}, r"unknown unit 'radians'\. Did you mean 'rad'"),
        ({"kind": "sample"}, "unknown kind 'sample'. Did you mean 'sampled'"),
        ({"kind": "target"}, "targets need to know how long a movement takes"),
        ({"more": "sing = [1, 1, 1, 1]"}, r"unknown key 'sing'\. Did you mean 'sign'"),
        ({"more": "sign = [1, 1]"}, "sign has 2 entries, expected 4"),
    ],
)
def test_a_wrong_map_is_explained(armpi, tmp_path, words, message):
    write(tmp_path, pd.DataFrame({"t": [0.0]}), **words)

    with pytest.raises(InputError, match=message):
        read(tmp_path, armpi)


def spoilt(change):
    time = np.arange(20) * 0.1
    good = table(time, np.zeros((20, 4)), np.ones((20, 3))).astype(object)
    change(good)
    return good


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("c"), "unknown column 'c'"),
        (lambda t: t.__setitem__("b", ["x", *t["b"][1:]]), "line 2, column b: got 'x'"),
        (
            lambda t: t.__setitem__("x", [np.inf, *t["x"][1:]]),
            r"line 2, column x: got 'inf', expected a finite number\. Leave the cell empty where "
            r"there is no value\.$",
        ),
        (lambda t: t.__setitem__("t", t["t"].to_numpy()[::-1]), "time runs backwards"),
        (lambda t: t.__setitem__("t", [*t["t"][:10], *(t["t"][10:] + 900)]), "clock jumps by 900"),
        (lambda t: t.__setitem__("x", np.nan), "no reading of the tool"),
    ],
)
def test_a_broken_table_is_explained(armpi, tmp_path, change, message):
    write(tmp_path, spoilt(change))
    if message == "no reading of the tool":  # an axis that is never there is a quality matter
        runs = read(tmp_path, armpi)
        assert np.isnan(runs["measured"].values).any(axis=-1).all()
        return

    with pytest.raises(InputError, match=message):
        read(tmp_path, armpi)


def test_a_csv_without_a_map_says_how_to_get_one(armpi, tmp_path):
    write(tmp_path, pd.DataFrame({name: [0.0] for name in "tabcd"}))

    with pytest.raises(InputError, match=r"needs a column map.*--columns"):
        read_runs(tmp_path / "log.csv", armpi)


JOINTS = ("cmd_waist", "cmd_shoulder", "cmd_elbow")


def bench_arm(folder):
    """An arm of three joints: waist, shoulder and elbow."""
    links = "".join(f'<link name="l{k}"/>' for k in range(5))
    joints = "".join(
        f'<joint name="{name.removeprefix("cmd_")}" type="revolute"><parent link="l{k}"/>'
        f'<child link="l{k + 1}"/><origin xyz="0.1 0.2 0.3"/><axis xyz="0 {k % 2} {1 - k % 2}"/>'
        '<limit lower="-2" upper="2" effort="9" velocity="1"/></joint>'
        for k, name in enumerate(JOINTS)
    )
    joints += (
        '<joint name="flange" type="fixed"><parent link="l3"/><child link="l4"/>'
        '<origin xyz="0.1 0.2 0.3"/></joint>'
    )
    (folder / "arm.urdf").write_text(f'<robot name="bench_arm">{links}{joints}</robot>')
    profile = folder / "arm.toml"
    profile.write_text(profile_text(check_urdf(folder / "arm.urdf"), profile))
    return load_robot(profile)


def commanded(folder, columns):
    """Write a log with such columns of commands; return its path."""
    time = np.arange(20) * 0.1
    table = pd.DataFrame(dict.fromkeys(("time", *columns, "x", "y", "z"), time))
    table.to_csv(folder / "log.csv", index=False)
    return folder / "log.csv"


def test_a_log_of_another_robot_than_the_default_asks_for_its_name(armpi, tmp_path):
    message = (
        r"too few columns of commands .* armpi_fpv \(4 motors\), the default where --robot names "
        r"none\. .* 3 columns may be commands\. --robot NAME\|PROFILE names another"
    )
    with pytest.raises(InputError, match=message):
        read_runs(commanded(tmp_path, JOINTS), armpi)


def test_too_few_commands_are_no_matter_of_a_map(tmp_path):
    log, robot = commanded(tmp_path, JOINTS[:2]), bench_arm(tmp_path)
    message = r"no column map can mend that.*waist \(cmd_waist\).*elbow \(no column\)"
    for read_or_draft in (read_runs, column_map_text):
        with pytest.raises(InputError, match=message) as error:
            read_or_draft(log, robot)
        assert "--columns" not in str(error.value)


def test_a_wrong_name_is_told_and_its_map_keeps_the_others(tmp_path):
    log, robot = commanded(tmp_path, (*JOINTS[:2], "cmd_elbo")), bench_arm(tmp_path)
    message = (
        r"bench_arm \(3 motors\)\. Its joints: waist \(cmd_waist\), shoulder \(cmd_shoulder\), "
        r"elbow \(no column\).*--columns"
    )
    with pytest.raises(InputError, match=message):
        read_runs(log, robot)
    draft = column_map_text(log, robot)
    assert 'columns = ["cmd_waist", "cmd_shoulder", "FILL IN"]' in draft
    (tmp_path / "map.toml").write_text(draft)
    with pytest.raises(InputError, match=r"line \d+ is not filled in: columns = \[.*FILL IN"):
        read_column_map(tmp_path / "map.toml", robot)
    (tmp_path / "map.toml").write_text(draft.replace("FILL IN", "cmd_elbo"))
    mapped = ReadOptions(columns=read_column_map(tmp_path / "map.toml", robot))
    np.testing.assert_allclose(read_runs(log, robot, mapped)["command"][0, -1], 1.9, atol=1e-6)


def test_readings_do_not_stand_in_for_commands_of_which_one_lacks(tmp_path):
    columns = (*JOINTS[:2], *(name.removeprefix("cmd_") for name in JOINTS))
    with pytest.raises(InputError, match=r"2 columns may be commands"):
        read_runs(commanded(tmp_path, columns), bench_arm(tmp_path))


# Columns that need no map: their names tell all.


def plain_log(folder, armpi_twin, names, *, angle=1.0, length=1.0, tool="tool_{}", separator=","):
    """Write a log of a ramp whose command columns have some names; return its path and angles."""
    time = np.arange(50) * 0.1
    command = np.outer(np.clip(time - 1.0, 0.0, 1.0), [0.5, -0.4, 0.3, 0.2])
    place = armpi_twin.path(command)
    columns = {"time": time} | {n: angle * c for n, c in zip(names, command.T, strict=False)}
    columns |= {tool.format(axis): length * place[:, i] for i, axis in enumerate("xyz")}
    pd.DataFrame(columns).to_csv(folder / "log.csv", index=False, sep=separator)
    return folder / "log.csv", command, place


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["q1", "q2", "q3", "q4"], {}),
        (["joint_1", "joint_2", "joint_3", "joint_4"], {}),
        (["target_q_0", "target_q_1", "target_q_2", "target_q_3"], {}),
        (["target_q_0", "target_q_1", "target_q_2", "target_q_3"], {"separator": " "}),
        (["q1_deg", "q2_deg", "q3_deg", "q4_deg"], {"angle": 180.0 / np.pi}),
        (["cmd1_rad", "cmd2_rad", "cmd3_rad", "cmd4_rad"], {"tool": "tcp_{}_m"}),
        (["q1", "q2", "q3", "q4"], {"length": 1000.0, "tool": "tool_{}_mm"}),
    ],
)
def test_columns_in_joint_order_need_no_map(armpi, twin, tmp_path, names, words):
    log, command, place = plain_log(tmp_path, twin, names, **words)

    runs = read_runs(log, armpi)

    np.testing.assert_allclose(runs["command"][0, ::10], command, atol=3e-3)
    np.testing.assert_allclose(runs["measured"][0, ::10], place, atol=1e-9)
    assert runs.attrs["source"] == "CSV, columns by their names"


def test_columns_of_all_joints_go_by_their_place_in_the_urdf(tmp_path):
    """A UR5e log has six joints; the profile leaves out the last, which cannot move the tool."""
    time = np.arange(20) * 0.1
    columns = {"timestamp": time} | {f"target_q_{k}": 0.1 * k * time for k in range(6)}
    columns |= {"x": time, "y": time, "z": time, "target_qd_0": time}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)

    runs = read_runs(tmp_path / "log.csv", "ur5e")

    np.testing.assert_allclose(runs["command"][0, -1], [0.0, 0.19, 0.38, 0.57, 0.76], atol=1e-6)


LIFT = """<robot name="lift">
<link name="base"/><link name="column"/><link name="arm"/><link name="tool0"/>
<joint name="lift" type="prismatic"><parent link="base"/><child link="column"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.4" effort="9" velocity="1"/></joint>
<joint name="shoulder_lift" type="revolute"><parent link="column"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="1"/></joint>
<joint name="mount" type="fixed"><parent link="arm"/><child link="tool0"/>
<origin xyz="0.5 0 0"/></joint></robot>"""


def arm_on_a_lift(folder):
    (folder / "lift.urdf").write_text(LIFT)
    profile = folder / "lift.toml"
    profile.write_text(profile_text(check_urdf(folder / "lift.urdf"), profile))
    return load_robot(profile)


@pytest.mark.parametrize("lead", ["cmd_", "target_"])
def test_slides_have_a_unit_of_their_own_and_names_within_names_are_told_apart(tmp_path, lead):
    """`lift` is part of `shoulder_lift`; one is in millimetres, the other in degrees."""
    robot, time = arm_on_a_lift(tmp_path), np.arange(20) * 0.1
    columns = {f"{lead}shoulder_lift_deg": 18.0 * time, f"{lead}lift_mm": 100.0 + 50.0 * time}
    columns |= {"time": time, "x": time, "y": time, "z": time}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)

    runs = read_runs(tmp_path / "log.csv", robot)

    told = runs["command"].values[0]
    np.testing.assert_allclose(told[[0, -1], 0], [0.1, 0.1 + 0.05 * 1.9], atol=1e-9)
    np.testing.assert_allclose(told[-1, 1], np.deg2rad(18.0 * 1.9), atol=1e-9)
    (tmp_path / "map.toml").write_text(column_map_text(tmp_path / "log.csv", robot))
    mapped = ReadOptions(columns=read_column_map(tmp_path / "map.toml", robot))
    again = read_runs(tmp_path / "log.csv", robot, mapped)
    np.testing.assert_allclose(again["command"].values, runs["command"].values)


def test_the_examples_in_the_comments_of_a_guess_fit_the_robot(tmp_path):
    robot = arm_on_a_lift(tmp_path)
    (tmp_path / "log.csv").write_text(
        "time,lift_mm,shoulder_lift_deg,x,y,z\n0,0,0,0,0,0\n1,1,1,1,1,1\n"
    )
    text = column_map_text(tmp_path / "log.csv", robot)
    lines = [line[2:] for line in text.splitlines() if line.startswith(("# sign", "# zero"))]
    lists = "\n".join(line.partition("   ")[0] for line in lines)
    (tmp_path / "map.toml").write_text(text.replace("[command]\n", f"[command]\n{lists}\n"))
    assert read_column_map(tmp_path / "map.toml", robot) is not None


def test_a_map_wins_over_names(armpi, twin, tmp_path):
    log, command, _ = plain_log(tmp_path, twin, ["q1", "q2", "q3", "q4"])
    mapping = """
        time = { column = "time" }
        command = { columns = ["q4", "q2", "q3", "q1"] }
        tool = { columns = ["tool_x", "tool_y", "tool_z"] }
    """
    (tmp_path / "map.toml").write_text(mapping)

    runs = read(tmp_path, armpi)

    np.testing.assert_allclose(runs["command"][0, -1, 0], command[-1, 3], atol=3e-3)
    assert log.exists()


@pytest.mark.parametrize(
    ("rename", "message"),
    [
        ({"time": "time", "extra": "timestamp"}, "the time of the log may be time or timestamp"),
        ({"extra": "joint_2"}, "the command of motor_2 may be q2 or joint_2"),
        ({"q3": "third"}, "which columns are the commands, one for each motor, of time, q1, q2"),
        ({"q1": "actual_q1"}, "which columns are the commands"),
        ({"tool_z": "height"}, r"which columns are the tool \(x, y, z\) or the readings"),
        ({"extra": "flange_x"}, "the place of the tool in x may be tool_x or flange_x"),
    ],
)
def test_what_names_leave_open_is_told_with_the_candidates(armpi, twin, tmp_path, rename, message):
    log, _, _ = plain_log(tmp_path, twin, ["q1", "q2", "q3", "q4"])
    pd.read_csv(log).assign(extra=0.0).rename(columns=rename).to_csv(log, index=False)

    with pytest.raises(InputError, match=rf"{message}.*--columns"):
        read_runs(log, armpi)


@pytest.mark.parametrize(
    ("scales", "message"),
    [
        ({"angle": 57.3}, r"the unit of q1, whose numbers reach 28.*no _rad or _deg"),
        ({"length": 1000.0}, r"the unit of tool_x, whose numbers reach .*no _mm or _cm or _m"),
    ],
)
def test_numbers_in_no_named_unit_that_cannot_be_si_are_not_guessed(
    armpi, twin, tmp_path, scales, message
):
    log, _, _ = plain_log(tmp_path, twin, ["q1", "q2", "q3", "q4"], **scales)

    with pytest.raises(InputError, match=message):
        read_runs(log, armpi)
