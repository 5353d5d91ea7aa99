"""Claims of files: sizes, codecs and links in their metadata, checked before any decoding.

A file of a kilobyte can say that it holds a terabyte, and a Zarr store may name a codec that runs
code. So sizes, codecs and links are read from the metadata first; what does not fit the file or
the memory is refused by `check_size`, whatever else it holds.
"""

from __future__ import annotations

import bz2
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Literal

import numpy as np

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.foreign import LEAST_BYTES, MB, check_size, read_text, reading

if TYPE_CHECKING:
    import zarr

TEXT_CELL_BYTES = 64
"""Memory of a short text in addition to its letters [bytes]."""

# NetCDF: HDF5 with conventions.


def check_netcdf(path: Path, most_runs: int | None) -> None:
    """Raise InputError unless the arrays of a NetCDF file can be meant and lie in it alone.

    `most_runs` are in memory at a time; None: all.
    """
    import h5py

    found: list[float] = []

    def weigh(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise _elsewhere(path, name)
            cell = TEXT_CELL_BYTES if h5py.check_string_dtype(item.dtype) else item.dtype.itemsize
            shape = _at_a_time(item.shape or (), most_runs)
            largest = max(math.prod(shape), math.prod(item.chunks or ()))
            found.append(float(largest) * cell)

    with h5py.File(path, "r") as file:
        for name in file:
            if isinstance(file.get(name, getlink=True), h5py.ExternalLink):
                raise _elsewhere(path, name)
        file.visititems(weigh)
    check_size(sum(found), path, "its arrays")


def _at_a_time(shape: tuple[int, ...], most_runs: int | None) -> tuple[int, ...]:
    """Return the shape of what is in memory at a time; the first axis is that of the runs."""
    return shape if most_runs is None or not shape else (min(shape[0], most_runs), *shape[1:])


def _elsewhere(path: Path, name: str) -> InputError:
    return InputError(f"{path}: {name!r} lies in another file. Write all of it into one.")


# Zarr: a folder of chunks, with a JSON file for each array.

ZARR_FORMAT: Final = 3
CODECS = ("bytes", "vlen-utf8", "zstd", "blosc")
"""Codecs that this package writes. Others are refused: some run code from the file."""
MAY_BE_EMPTY = ("onset", "magnitude", "position", "temperature", "voltage")
"""Variables that may be unknown throughout; other writers leave out chunks that are all unknown."""


def check_zarr(path: Path, most_runs: int | None) -> None:
    """Raise InputError unless a Zarr store has only known codecs, sane sizes and all its chunks.

    `most_runs` are in memory at a time; None: all.
    """
    import zarr

    total = 0.0
    for file in sorted(path.rglob("zarr.json")):
        node = json.loads(read_text(file, "Zarr metadata"))
        if not isinstance(node, dict) or node.get("zarr_format") != ZARR_FORMAT:
            raise _not_version_3(path)
        _check_codecs(node, file)
        if node.get("node_type") == "array":
            array = zarr.open_array(file.parent, mode="r", zarr_format=ZARR_FORMAT)
            cell = array.dtype.itemsize if array.dtype.kind in "biufU" else TEXT_CELL_BYTES
            shape = _at_a_time(array.shape, most_runs)
            total += float(max(math.prod(shape), math.prod(array.chunks))) * cell
            check_size(total, path, "its arrays")
            _check_chunks(array, file.parent)
    if any((path / name).exists() for name in (".zgroup", ".zarray", ".zmetadata")):
        raise _not_version_3(path)


def _not_version_3(path: Path) -> InputError:
    return InputError(
        f"{path}: is no Zarr store of format {ZARR_FORMAT}. Write it again with "
        f"to_zarr(..., zarr_format={ZARR_FORMAT})."
    )


def _check_codecs(node: Any, file: Path) -> None:
    """Raise InputError if any part of some metadata, however deep, names another codec."""
    if isinstance(node, Mapping):
        for key in ("codecs", "index_codecs", "storage_transformers"):
            for codec in node.get(key) or ():
                name = codec.get("name") if isinstance(codec, Mapping) else codec
                if key != "codecs" or name not in CODECS:
                    raise InputError(
                        f"{file}: has the codec {name!r}, expected {', '.join(CODECS)}: others may "
                        "run code of whoever made the file. Write it again with one of these."
                    )
        for value in node.values():
            _check_codecs(value, file)
    elif isinstance(node, list):
        for value in node:
            _check_codecs(value, file)


def _check_chunks(array: zarr.Array[Any], folder: Path) -> None:
    """Raise InputError if a chunk is missing, which would pass for readings that nobody took."""
    if folder.name in MAY_BE_EMPTY:
        return
    count = math.prod(array.cdata_shape)
    found = sum(1 for file in folder.rglob("*") if file.is_file() and file.name != "zarr.json")
    if found >= count:
        return
    keys = (array.metadata.encode_chunk_key(index) for index in np.ndindex(*array.cdata_shape))
    missing = next((key for key in keys if not (folder / key).is_file()), None)
    if missing is not None:
        raise InputError(
            f"{folder}: chunk {missing} is missing ({found} of {count} are there). "
            "Copy the store again; if it is whole, write it with write_empty_chunks=True."
        )


# MATLAB, versions 5 to 7: elements with a tag that says type and length, also within each other.

HEADER_BYTES = 128
MATRIX, COMPRESSED, INT32 = 14, 15, 5
DEEPEST = 32
"""Cells within cells; published files have three."""
ELEMENT_BYTES = 16
"""Largest memory of an element of a matrix: two doubles, or an object [bytes]."""
Order = Literal["little", "big"]


def check_matlab(path: Path) -> None:
    """Raise InputError unless the elements of a MATLAB file lie within it and can be meant."""
    with reading(path, "a MATLAB file", "Save it again with the option -v7."):
        data = path.read_bytes()
        if len(data) < HEADER_BYTES or data[126:128] not in (b"IM", b"MI"):
            raise InputError(f"{path}: is no MATLAB file. Save it with the option -v7.")
        order: Order = "little" if data[126:128] == b"IM" else "big"
        _weigh_elements(memoryview(data)[HEADER_BYTES:], order, path, 0.0, 0)


def _weigh_elements(data: memoryview, order: Order, path: Path, total: float, depth: int) -> float:
    """Return `total` and what the matrices in a buffer claim [bytes]; each has to lie in it."""
    if depth > DEEPEST:
        raise InputError(f"{path}: holds cells within cells more than {DEEPEST} deep.")
    for kind, body in _elements(data, order, path):
        if kind == COMPRESSED:
            total = _weigh_elements(_inflated(body, path, total), order, path, total, depth + 1)
        elif kind == MATRIX:
            total += _claim(body, order, path)
            check_size(total, path, "its matrices")
            total = _weigh_elements(body, order, path, total, depth + 1)
    return total


def _elements(data: memoryview, order: Order, path: Path) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of the elements in a buffer."""
    at = 0
    while at + 8 <= len(data):
        kind = int.from_bytes(data[at : at + 4], order)
        size, start = int.from_bytes(data[at + 4 : at + 8], order), at + 8
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(data) or (start == at + 4 and size > 4):
            raise InputError(
                f"{path}: an element claims {size} bytes where {len(data) - start} are left. The "
                "file was cut off or changed: copy it again."
            )
        yield kind, data[start : start + size]
        padding = 0 if kind == COMPRESSED else -size % 8
        at = at + 8 if start == at + 4 else start + size + padding


def _inflated(data: memoryview, path: Path, total: float) -> memoryview:
    limit = max(LEAST_BYTES, len(data))
    inflate, parts, rest = zlib.decompressobj(), list[bytes](), bytes(data)
    while rest and not inflate.eof:
        parts.append(inflate.decompress(rest, limit))
        rest = inflate.unconsumed_tail
        total += len(parts[-1])
        check_size(total, path, "what is compressed in it")
    return memoryview(b"".join(parts))


def _claim(matrix: memoryview, order: Order, path: Path) -> float:
    """Return what a matrix takes by its dimensions, the second of its elements [bytes]."""
    for kind, body in islice(_elements(matrix, order, path), 1, 2):
        if kind == INT32:
            whole = range(0, len(body) - 3, 4)
            sizes = [int.from_bytes(body[i : i + 4], order) for i in whole]
            return float(math.prod(sizes)) * ELEMENT_BYTES
    return 0.0


# npz: a ZIP archive of arrays, each with a header that says shape and type.


def check_npz(path: Path) -> None:
    """Raise InputError unless the arrays of an .npz archive can be meant."""
    from numpy.lib import format as npy

    total = 0.0
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as file:
                version = npy.read_magic(file)
                read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read(file)
                total += max(float(math.prod(shape)) * dtype.itemsize, float(entry.file_size))
            check_size(total, path, "its arrays")


# Recordings of ROS: a kilobyte of a compressed chunk can unfold to gigabytes, whatever the record
# beside it says, so each chunk is unfolded in steps that are thrown away.

STEP_BYTES = 16 * MB
MCAP_MAGIC = b"\x89MCAP0\r\n"
Unfold = Callable[[IO[bytes]], IO[bytes]]
"""Opens a compressed file."""


def check_recording(path: Path) -> None:
    """Raise InputError if the chunks of a ROS 1 bag or an MCAP file unfold to too much."""
    with path.open("rb") as file:
        is_mcap = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
        file.seek(0)
        if not is_mcap and path.suffix != ".bag":
            return
        total = 0
        for unfold, data in (_mcap_chunks if is_mcap else _ros1_chunks)(file, path):
            with unfold(BytesIO(data)) as chunk:
                while part := chunk.read(STEP_BYTES):
                    total += len(part)
                    check_size(total, path, "its messages")


def _ros1_chunks(file: IO[bytes], path: Path) -> Iterator[tuple[Unfold, bytes]]:
    import lz4.frame
    from rosbags.rosbag1 import Reader

    unfold: dict[Any, Unfold] = {bz2.decompress: bz2.open, lz4.frame.decompress: lz4.frame.open}
    with Reader(path) as bag:
        for chunk in bag.chunks.values():
            file.seek(chunk.datapos)
            yield unfold.get(chunk.decompressor, _as_it_is), file.read(chunk.datasize)


def _mcap_chunks(file: IO[bytes], path: Path) -> Iterator[tuple[Unfold, bytes]]:
    with needs_extra(f"{path}: MCAP files need mcap", "files"):
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader
    import lz4.frame

    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    unfold: dict[str, Unfold] = {"lz4": lz4.frame.open, "zstd": zstd.open}
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield unfold.get(record.compression, _as_it_is), record.data
    if file.read(1):
        raise InputError(f"{path}: goes on after its end. Record or copy it again.")


def _as_it_is(file: IO[bytes]) -> IO[bytes]:
    return file
