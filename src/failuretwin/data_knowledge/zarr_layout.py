"""The Zarr layout of a run set that is written in pieces, each by whoever made it.

A piece is a fixed number of runs over their whole time: one file of every variable. Metadata are
those that xarray writes for a run set of this kind, with the number of runs put in.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr
    from zarr.core.buffer import Buffer

RUN = "run"
COMPRESSION_LEVEL = 5


@dataclass(frozen=True)
class Layout:
    """Everything of a Zarr run set but its runs.

    Attributes:
        root: The group's metadata, which make the store readable: the last file to write.
        shared: All other files that do not depend on the runs, by name.
        per_run: File of each variable's first piece, by the variable's name.
    """

    root: bytes
    shared: Mapping[str, bytes]
    per_run: Mapping[str, str]

    def piece_files(self, piece: int) -> list[str]:
        """Return the names of the files that a piece may have; what is all missing has none."""
        return [name.replace("/c.0", f"/c.{piece}", 1) for name in self.per_run.values()]


def layout_of(example: xr.Dataset, runs: int, piece_runs: int) -> Layout:
    """Return the layout of a run set.

    Args:
        example: A run set of the same kind, with any number of runs.
        runs: Number of runs in all.
        piece_runs: Runs in a piece.
    """
    from zarr.codecs import BloscCodec
    from zarr.storage import MemoryStore

    varying = [str(name) for name, v in example.variables.items() if v.dims[:1] == (RUN,)]
    numbers = [name for name in varying if example[name].dtype.kind == "f"]
    codec = BloscCodec(cname="lz4", clevel=COMPRESSION_LEVEL, shuffle="shuffle", typesize=8)
    content: dict[str, Buffer] = {}
    with _quiet():
        example.to_zarr(
            MemoryStore(content),
            mode="w",
            consolidated=True,
            encoding={name: {"compressors": (codec,)} for name in numbers},
        )
    files = {key: value.to_bytes() for key, value in content.items()}
    root = json.loads(files.pop("zarr.json"))
    shared = {}
    for key, value in files.items():
        name, _, rest = key.partition("/")
        if name not in varying:
            shared[key] = value
        elif rest == "zarr.json":
            whole = _resized(json.loads(value), runs, piece_runs)
            root["consolidated_metadata"]["metadata"][name] |= whole
            shared[key] = _to_json(whole)
    per_run = {name: f"{name}/c.0" + ".0" * (example[name].ndim - 1) for name in varying}
    return Layout(_to_json(root), shared, per_run)


def _resized(array: dict[str, Any], runs: int, piece_runs: int) -> dict[str, Any]:
    """Return an array's metadata with the number of runs in all and in a piece."""
    grid = {"chunk_shape": [piece_runs, *array["shape"][1:]]}
    return {
        **array,
        "shape": [runs, *array["shape"][1:]],
        "chunk_grid": {"name": "regular", "configuration": grid},
        # Dots, not folders: every variable is one flat folder, made before the first piece.
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
    }


def _to_json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, indent=2).encode()


def piece_content(layout: Layout, part: xr.Dataset, first: int) -> dict[str, bytes]:
    """Return the files of one piece by name; what is all missing has no file.

    Args:
        layout: Layout of the whole run set.
        part: The runs of the piece.
        first: Number of its first run.

    Raises:
        ValueError: If the runs do not fit the layout.
    """
    import zarr
    from zarr.core.buffer import default_buffer_prototype
    from zarr.storage import MemoryStore

    new_buffer = default_buffer_prototype().buffer.from_bytes
    metadata = {f"{name}/zarr.json" for name in layout.per_run}
    content = {key: new_buffer(layout.shared[key]) for key in metadata}
    store = MemoryStore(content)
    with _quiet(), _one_thread():
        for name in layout.per_run:
            array = zarr.open_array(store, path=name, mode="r+")
            values = part[name].values
            if values.shape[1:] != array.shape[1:]:
                raise ValueError(f"{name} is {values.shape} in a run set of {array.shape}")
            array[first : first + len(values)] = values
    return {key: value.to_bytes() for key, value in content.items() if key not in metadata}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep to ourselves that text and consolidated metadata are not in Zarr's final text yet."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Zarr (V3|format 3).*")
        yield


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compress in one thread: several may store blocks in any order, so bytes would differ."""
    from numcodecs import blosc

    before = blosc.use_threads
    blosc.use_threads = False
    try:
        yield
    finally:
        blosc.use_threads = before
