"""Writes ROS 1 bags, ROS 2 bags and MCAP files from plain values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FORMATS = ("ros1", "ros2", "mcap")
MONITORING = "cm/msg/msg_cm"
MONITORING_TEXT = """
Header header
string[] name         # joint name
float64[] position # motor position, same order as name
float64[] temperature # motor temperatures, same order as name
float64[] voltage # motor voltage, same order as name
"""
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
POINT = "geometry_msgs/msg/PointStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TRANSFORMS_TEXT = "geometry_msgs/TransformStamped[] transforms"


@dataclass(frozen=True)
class Entry:
    """A message to write.

    Attributes:
        topic: Its topic.
        type: Its type.
        content: Its fields; those left out are empty or zero.
        received_ns: When it was received.
    """

    topic: str
    type: str
    content: dict[str, Any]
    received_ns: int


def time_of(ns):
    return {"sec": int(ns) // 10**9, "nanosec": int(ns) % 10**9}


def entry(topic, type_, stamp_ns, received_ns=None, **content):
    """Make an entry whose header bears `stamp_ns`; it is received then, if not told otherwise."""
    header = {"stamp": time_of(stamp_ns)}
    received_ns = stamp_ns if received_ns is None else received_ns
    return Entry(topic, type_, {"header": header, **content}, int(received_ns))


def write_bag(folder: Path, form: str, entries, name="run", types=None, declared=()):
    """Write entries as a ``ros1``, ``ros2`` or ``mcap`` recording and return its path.

    Args:
        folder: Where it goes.
        form: One of `FORMATS`.
        entries: What to write, in this order.
        name: Its name.
        types: Definitions of more message types, text by name.
        declared: More topics, (name, type), without messages.
    """
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.LATEST)
    texts = {MONITORING: MONITORING_TEXT, TRANSFORMS: TRANSFORMS_TEXT, **(types or {})}
    for type_, text in texts.items():
        if type_ not in store.types:
            store.register(get_types_from_msg(text, type_))
    if form == "ros1":
        path = folder / f"{name}.bag"
        _write(Writer1(path), store, store.serialize_ros1, entries, declared)
        return path
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    path = folder / (f"{name}_folder" if form == "mcap" else name)
    writer = Writer2(path, version=9, storage_plugin=plugin)
    _write(writer, store, store.serialize_cdr, entries, declared)
    if form == "ros2":
        return path
    (file,) = path.glob("*.mcap")
    return file.rename(folder / f"{name}.mcap")


def _write(writer, store, serialize, entries, declared):
    with writer:
        topics = dict.fromkeys([*((item.topic, item.type) for item in entries), *declared])
        connections = {topic: writer.add_connection(*topic, typestore=store) for topic in topics}
        for item in entries:
            content = serialize(_build(store, item.type, item.content), item.type)
            writer.write(connections[item.topic, item.type], item.received_ns, content)


def _build(store, type_, content):
    _, fields = store.fielddefs[type_]
    values = {name: _value(store, desc, content.get(name)) for name, desc in fields}
    return store.types[type_](**values)


def _value(store, description, value):
    kind, detail = description
    if kind.name == "NAME":
        return _build(store, detail, value or {})
    if kind.name == "BASE":
        empty = "" if detail[0] == "string" else 0
        return empty if value is None else value
    item = detail[0]
    if item[0].name == "NAME":
        return [_build(store, item[1], part) for part in value or ()]
    if item[1][0] == "string":
        return list(value or ())
    return np.array(() if value is None else value, dtype=item[1][0])
