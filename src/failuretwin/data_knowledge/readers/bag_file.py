"""Topics and messages of recorded ROS data: ROS 1 bags, ROS 2 bags and MCAP files, without ROS.

Types are taken from the recording wherever it holds them, each topic's on its own, so that one
strange topic spoils no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.core.errors import needs_extra
from failuretwin.core.foreign import reading
from failuretwin.data_knowledge.readers.bag_messages import BagMessage, BagTopic, Kind, kind_of
from failuretwin.data_knowledge.readers.file_claims import check_recording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.interfaces.typing import Typesdict
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
"""Suffixes of recordings, and what repairs one that was cut off."""
FOLDER_FILE = "metadata.yaml"
"""File that makes a folder a ROS 2 bag."""
MONITORING_TOPICS = ("condition_monitoring", "position_monitoring")
MONITORING_DEFINITION = """\
std_msgs/Header header
string[] name
float64[] position
float64[] temperature
float64[] voltage
"""
"""The message of the data set's authors on these topics. Older ROS 2 bags hold no definitions."""


def is_bag(path: Path) -> bool:
    """Return whether `path` is a ROS 1 bag, an MCAP file, or a ROS 2 bag (folder or .db3 file)."""
    return (path.is_file() and path.suffix in REPAIR) or (path / FOLDER_FILE).is_file()


def read_topics(path: Path) -> list[BagTopic]:
    """Return every topic of a recording, by name.

    Raises:
        InputError: If it cannot be read or rosbags is not installed.
    """
    with needs_extra(f"{path}: ROS bags need rosbags", "files"):
        import rosbags.rosbag1
        import rosbags.rosbag2  # noqa: F401
    with _guarded(path):
        for file in [path] if path.is_file() else filter(Path.is_file, path.iterdir()):
            check_recording(file)
    with _guarded(path), _reader(path) as reader:
        connections = sorted(reader.connections, key=lambda c: c.topic)
        names = dict.fromkeys(c.topic for c in connections)
        return [_topic([c for c in connections if c.topic == name]) for name in names]


def read_messages(path: Path, names: Sequence[str]) -> dict[str, list[BagMessage]]:
    """Return the messages of some topics, in the order in which they were received.

    Raises:
        InputError: If the recording or a message cannot be read.
    """
    messages: dict[str, list[BagMessage]] = {name: [] for name in names}
    with _guarded(path), _reader(path) as reader:
        wanted = [c for c in reader.connections if c.topic in messages]
        stores = {c.id: _typestore(c) for c in wanted}
        # An empty selection would mean all topics to rosbags.
        for connection, received_ns, raw in reader.messages(wanted) if wanted else ():
            store = stores[connection.id]
            decode = store.deserialize_ros1 if _is_ros1(path) else store.deserialize_cdr
            content = decode(raw, connection.msgtype)
            messages[connection.topic].append(BagMessage(received_ns, content))
    return messages


def _guarded(path: Path) -> AbstractContextManager[None]:
    """Return what turns an error in reading a recording into one that says how to repair it."""
    repair = REPAIR.get(path.suffix, REPAIR[".db3"])
    fix = f"If the recorder was cut off, repair it with `{repair}`; else record or copy it again."
    return reading(path, "a ROS recording", fix)


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag" and path.is_file()


def _reader(path: Path) -> Reader1 | Reader2:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    return Reader1(path) if _is_ros1(path) else Reader2(path)


def _topic(connections: Sequence[Connection]) -> BagTopic:
    """Return the topic that some connections make up, one for each of its publishers."""
    types = list(dict.fromkeys(c.msgtype for c in connections))
    kind = _kind(connections[0]) if len(types) == 1 else None
    count = sum(c.msgcount for c in connections)
    return BagTopic(connections[0].topic, " or ".join(types), count, kind)


def _kind(connection: Connection) -> Kind | None:
    """Return the kind of a connection's messages; None if their definition is not sound."""
    from rosbags.typesys import TypesysError

    try:
        return kind_of(message_fields(_typestore(connection), connection.msgtype))
    except TypesysError:
        return None


def message_fields(store: Typestore, type_: str) -> dict[str, str]:
    """Return the types of a message's fields by name, as in `FIELDS`; empty if it is unknown."""
    _, fields = store.fielddefs.get(type_, ((), ()))
    return {name: _type_text(description) for name, description in fields}


def _type_text(description: Any) -> str:
    """Return ``float``, ``string``, a message type, or one of these with ``[]``."""
    kind, detail = description
    if kind.name == "NAME":
        return str(detail)
    if kind.name == "BASE":
        return "float" if detail[0].startswith("float") else str(detail[0])
    return f"{_type_text(detail[0])}[]"


def _typestore(connection: Connection) -> Typestore:
    """Return a typestore that knows the message type of a connection, if that can be known."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if connection.msgdef.format != MessageDefinitionFormat.NONE:
        store = get_typestore(Stores.EMPTY)
        store.register(_recorded_types(connection))
        return store
    store = get_typestore(Stores.LATEST)
    monitoring = connection.topic.rpartition("/")[2] in MONITORING_TOPICS
    if monitoring and connection.msgtype not in store.fielddefs:
        store.register(get_types_from_msg(MONITORING_DEFINITION, connection.msgtype))
    return store


def _recorded_types(connection: Connection) -> Typesdict:
    """Return the types that a recording defines for a connection."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, connection.msgtype)
    # Several IDL files stand one after the other, each under a rule and a line with its name.
    parts = [part.partition("\n")[2] for part in text.split("=" * 80 + "\n") if part]
    types: Typesdict = {}
    for part in parts if text.startswith("=") else [text]:
        types.update(get_types_from_idl(part))
    return types
