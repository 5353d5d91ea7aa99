"""Logs with other sensors than one of the tool's position: CSV by a map, and RTDE."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import failuretwin as ft
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.column_map import read_column_map
from failuretwin.digital_model.profile import SensorProfile

MAP = """
[time]
column = "t"
[command]
columns = ["c1", "c2", "c3", "c4"]
[[sensors]]
variable = "accelerometer"
columns = ["ax", "ay", "az"]
[[sensors]]
variable = "wire"
columns = ["l"]
"""


def table():
    time = np.arange(40) * 0.1
    return pd.DataFrame(
        {"t": time, "ax": 0.1 * time, "ay": 0.0, "az": 9.81, "l": 0.5 + time}
        | {f"c{k}": np.where(time < 1.0, 0.0, 0.1 * k) for k in range(1, 5)}
    )


def read(folder, anchor=(0.5, 0.0, 0.0)):
    known = ft.load_robot("armpi_fpv")
    wire = SensorProfile("wire", anchor=anchor)
    robot = replace(known, profile=replace(known.profile, sensors=(wire,)))
    mapping = read_column_map(folder / "map.toml", robot)
    return ft.read_runs(folder / "log.csv", robot, ft.ReadOptions(columns=mapping))


def test_a_log_with_an_accelerometer_alone_is_a_run_set(tmp_path):
    table().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "map.toml").write_text(MAP)
    runs = read(tmp_path)
    assert np.isnan(runs["measured"].values).all()
    seen = np.isfinite(runs["accelerometer"].values[0, :, 0])
    np.testing.assert_allclose(runs["accelerometer"].values[0, seen, 0], table()["ax"])
    np.testing.assert_allclose(runs["wire"].values[0, seen], table()["l"])
    assert runs.attrs["measured_rate_hz"] == pytest.approx(10.0)


def test_goals_that_motors_report_are_read_like_their_angles(tmp_path):
    log = table().assign(**{f"g{k}": np.rad2deg(0.1 * k) for k in range(1, 5)})
    log.to_csv(tmp_path / "log.csv", index=False)
    goals = '[goal]\ncolumns = ["g1", "g2", "g3", "g4"]\nunit = "deg"\n'
    (tmp_path / "map.toml").write_text(MAP + goals)
    found = read(tmp_path)["goal"].values[0]
    seen = np.isfinite(found[:, 0])
    np.testing.assert_allclose(found[seen], np.tile([0.1, 0.2, 0.3, 0.4], (seen.sum(), 1)))
    (tmp_path / "map.toml").write_text(MAP + goals.replace('"g1", ', ""))
    with pytest.raises(InputError, match="goal"):
        read(tmp_path)


def test_a_sensor_lacks_no_channel(tmp_path):
    table().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "map.toml").write_text(MAP.replace('"ax", ', ""))
    with pytest.raises(InputError, match="accelerometer: 2 columns, expected 3"):
        read(tmp_path)


def test_a_wire_that_begins_nobody_knows_where_is_refused(tmp_path):
    """The usual place is that of simulated wires; a real one taken to begin there looks faulty."""
    table().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "map.toml").write_text(MAP)
    with pytest.raises(InputError, match="does not say where it begins"):
        read(tmp_path, anchor=())


def test_rtde_recordings_bring_the_accelerometer_of_the_flange(tmp_path):
    robot, time = ft.load_robot("ur5e"), np.arange(100) * 0.01
    target = np.zeros((100, 6))
    target[30:] = [0.2, -0.1, 0.1, 0.0, 0.1, 0.0]
    columns = {"timestamp": time}
    columns |= {f"target_q_{k}": target[:, k] for k in range(6)}
    columns |= {f"actual_q_{k}": target[:, k] for k in range(6)}
    columns |= {f"actual_tool_accelerometer_{k}": 1.0 + k + time for k in range(3)}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", sep=" ", index=False)
    runs = ft.read_runs(tmp_path / "log.csv", robot)
    np.testing.assert_allclose(runs["accelerometer"].values[0, :, 1], 2.0 + time)
    assert np.isfinite(runs["measured"].values).all()
