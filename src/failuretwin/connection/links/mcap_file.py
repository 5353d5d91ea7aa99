"""MCAP files that grow while they can be read, in ROS 2's encoding.

That encoding is read by Foxglove and PlotJuggler alike, and by `failuretwin` itself: a recording is
a log like any other.
"""

from __future__ import annotations

import struct
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin import __version__
from failuretwin.connection.links.ros_writer import Outgoing
from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

CHUNK_BYTES = 16_384
"""Size from which messages go to the disk: a few seconds of a robot."""
_MAGIC = b"\x89MCAP0\r\n"
_END = (
    struct.pack("<BQI", 0x0F, 4, 0)  # end of the data, without a checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # footer: no summary
    + _MAGIC
)
"""What makes a file whole whose data end early, see https://mcap.dev/spec."""
_OWN_NAMES = {"sec": "secs", "nanosec": "nsecs"}
"""What ROS 2 calls the parts of a time, and what `Outgoing` does."""


class _Unbuffered:
    """A file of which all that was written is on its way to the disk."""

    def __init__(self, file: FileIO) -> None:
        self._file = file

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        return len(data)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Nothing waits here."""


class McapFile:
    """A recording that is being written.

    Args:
        path: The file; it must not exist.

    Raises:
        InputError: If mcap or rosbags is not installed, or the file exists.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise InputError(
                f"recording needs mcap and rosbags ({error}). Install them: "
                "pip install 'failuretwin[live]'."
            ) from error
        self.path = path
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        try:
            self._file = FileIO(path, "x")
        except FileExistsError as error:
            raise InputError(
                f"{path}: exists already. Choose another name, or remove it."
            ) from error
        self._channels: dict[str, int] = {}
        self._saved = 0
        self._stream = _Unbuffered(self._file)
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]
        try:
            self._writer.start(profile="ros2", library=f"failuretwin {__version__}")
        except OSError:
            self._file.close()
            path.unlink()
            raise
        self._saved = self._stream.tell()

    def write(self, message: Outgoing, time_ns: int) -> bool:
        """Write a message and return whether all messages so far are on the disk.

        Args:
            message: The message.
            time_ns: Its time [ns].

        Raises:
            OSError: If the disk is full or gone; `abandon` the file then.
        """
        type_ = message.type.replace("/", "/msg/")
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message.topic, type_)
        content = self._store.serialize_cdr(_build(self._store, type_, message.content), type_)
        self._writer.add_message(
            self._channels[message.topic], time_ns, bytes(content), time_ns, sequence=0
        )
        before, self._saved = self._saved, self._stream.tell()
        return self._saved > before

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: If the disk is full or gone.
        """
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def abandon(self) -> None:
        """Cut off what is half-written and finish the file; may be tried again.

        Raises:
            OSError: If the disk has no room even for that; `mcap recover` would repair the file.
        """
        self._file.close()
        with FileIO(self.path, "r+") as file:
            file.truncate(self._saved)
            file.seek(self._saved)
            _Unbuffered(file).write(_END)

    def _register(self, topic: str, type_: str) -> int:
        text, _ = self._store.generate_msgdef(type_, ros_version=2)
        schema = self._writer.register_schema(type_, "ros2msg", text.encode())
        return self._writer.register_channel(topic, "cdr", schema)


def _build(store: Typestore, type_: str, content: dict[str, Any]) -> Any:
    """Return a message object from plain values."""
    _, fields = store.fielddefs[type_]
    values = {
        name: _value(store, kind, content[_OWN_NAMES.get(name, name)]) for name, kind in fields
    }
    return store.types[type_](**values)


def _value(store: Typestore, description: Any, value: Any) -> Any:
    kind, detail = description
    if kind.name == "NAME":
        return _build(store, detail, value)
    if kind.name == "BASE":
        return value
    (item_kind, item), _ = detail
    if item_kind.name == "NAME":
        return [_build(store, item, part) for part in value]
    return list(value) if item[0] == "string" else np.array(value, dtype=item[0])
