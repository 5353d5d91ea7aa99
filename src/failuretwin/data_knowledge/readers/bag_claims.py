"""What the compressed chunks of a recording unfold to, tried step by step before any is kept.

A kilobyte of bzip2, LZ4 or Zstandard can unfold to gigabytes, whatever the record beside it says;
so each chunk is unfolded in small steps that are thrown away, and `check_size` judges the sum.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from failuretwin.core.foreign import MB, check_size

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
