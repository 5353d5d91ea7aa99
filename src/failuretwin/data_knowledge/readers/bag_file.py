"""Topics and messages of recorded ROS data: ROS 1 bags, ROS 2 bags and MCAP files, without ROS.

Types are taken from the recording wherever it holds them, each topic's on its own, so that one
strange topic spoils no other.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from failuretwin.core.errors import needs_extra
from failuretwin.core.foreign import MB, check_size, reading
from failuretwin.data_knowledge.readers.bag_messages import BagMessage, BagTopic, Kind, kind_of

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
    _check_installed(path)
    with _guarded(path):
        for file in [path] if path.is_file() else sorted(path.glob("*.mcap")):
            check_chunks(file)
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


def _check_installed(path: Path) -> None:
    with needs_extra(f"{path}: ROS bags need rosbags", "files"):
        import rosbags.rosbag1
        import rosbags.rosbag2  # noqa: F401


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


# Compressed chunks: a kilobyte of bzip2, LZ4 or Zstandard can unfold to gigabytes, whatever the
# record beside it says. Each chunk is unfolded in small steps that are thrown away, and
# `check_size` judges the sum before any is kept.

STEP_BYTES = 16 * MB
ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
ROS1_CHUNK, MCAP_CHUNK = 5, 6
"""Codes of the records that hold compressed messages."""
MCAP_CHUNK_HEAD = 8 + 8 + 8 + 4
"""Start, end, size and checksum, before the name of the compression [bytes]."""


def check_chunks(path: Path) -> None:
    """Raise InputError if the chunks of a ROS 1 bag or an MCAP file unfold to too much."""
    with path.open("rb") as file:
        end = path.stat().st_size
        magic = file.read(len(ROS1_MAGIC))
        if magic == ROS1_MAGIC:
            found = _ros1_chunks(file, end)
        elif magic.startswith(MCAP_MAGIC):
            file.seek(len(MCAP_MAGIC))
            found = _mcap_chunks(file, end)
        else:
            return  # the reader says what is wrong
        total = 0
        for compression, data in found:
            for part in _unfolded(compression, data):
                total += part
                check_size(total, path, "its messages")


def _ros1_chunks(file: BinaryIO, end: int) -> Iterator[tuple[str, bytes]]:
    """Yield compression and data of every chunk; what is no record ends the search."""
    while (head := _sized(file, "<I", end)) is not None:
        fields = dict(_ros1_fields(head))
        if fields.get(b"op") == bytes([ROS1_CHUNK]):
            data = _sized(file, "<I", end)
            if data is not None:
                yield fields.get(b"compression", b"").decode("latin-1"), data
            continue
        size = file.read(4)
        if len(size) < 4:
            return
        file.seek(struct.unpack("<I", size)[0], 1)


def _ros1_fields(head: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 4 <= len(head):
        size = struct.unpack_from("<I", head, at)[0]
        name, _, value = head[at + 4 : at + 4 + size].partition(b"=")
        yield name, value
        at += 4 + size


def _mcap_chunks(file: BinaryIO, end: int) -> Iterator[tuple[str, bytes]]:
    while code := file.read(1):
        if code[0] != MCAP_CHUNK:
            size = file.read(8)
            if len(size) < 8:
                return
            file.seek(min(struct.unpack("<Q", size)[0], end), 1)
            continue
        record = _sized(file, "<Q", end)
        if record is None or len(record) < MCAP_CHUNK_HEAD + 4:
            return
        size = struct.unpack_from("<I", record, MCAP_CHUNK_HEAD)[0]
        start = MCAP_CHUNK_HEAD + 4 + size
        yield record[start - size : start].decode("latin-1"), record[start + 8 :]


def _sized(file: BinaryIO, kind: str, end: int) -> bytes | None:
    """Return what stands behind its own size; None where the file does not hold that much."""
    head = file.read(struct.calcsize(kind))
    if len(head) < struct.calcsize(kind):
        return None
    size: int = struct.unpack(kind, head)[0]
    return file.read(size) if size <= end - file.tell() else None


def _unfolded(compression: str, data: bytes) -> Iterator[int]:
    """Yield the sizes of the steps in which data unfold [bytes]."""
    make = _inflater(compression)
    if make is None:
        yield len(data)
        return
    inflater = make()
    part = inflater.decompress(data, STEP_BYTES)
    while part:
        yield len(part)
        part = b"" if inflater.eof else inflater.decompress(b"", STEP_BYTES)


def _inflater(compression: str) -> Callable[[], Any] | None:
    if compression == "bz2":
        return bz2.BZ2Decompressor
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor
    if compression == "zstd":
        try:
            from compression import zstd
        except ImportError:
            from backports import zstd
        return zstd.ZstdDecompressor
    return None
