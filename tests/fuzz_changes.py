"""What a fuzzer does to a file: to its bytes, to its text, and to what it means."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np

NASTY = (
    *("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-308", "9" * 30, "9" * 5000, "1e9"),
    *("", "abc", "true", "[]", "{}", '"x"', "\x1b[31m", "[red]", "=cmd|' /C calc'!A0", "\u202e"),
)
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, 1e-308, 1e9, 1e5, -1e5)
VALUES = (None, True, -1, 0, 10**30, 2**31, 2**63, 1.5, "", "nan", [], [1], {}, "\x1b[31mx")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
WORD = re.compile(r"\w+")


def bytes_changed(data: bytes, rng) -> bytes:
    """Return data with a few bytes flipped, cut, doubled, taken out, or overwritten."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        size = len(data)
        if size == 0:
            return bytes(rng.integers(0, 256, 20, dtype=np.uint8))
        at, length = int(rng.integers(size)), int(rng.integers(1, 65))
        kind = int(rng.integers(7))
        if kind == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = data[at : at + length]
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            ends = (b"\xff" * 4, b"\x00" * 4, b"\x7f\xff\xff\xff", b"\x80" * 4)
            data[at : at + 4] = ends[int(rng.integers(4))]
        elif kind == 5:
            ends = (b"\xff" * 8, b"\x00" * 8, b"\x00" * 6 + b"\x01\x00")
            data[at : at + 8] = ends[int(rng.integers(3))]
        else:
            data[at:at] = bytes(rng.integers(0, 256, length, dtype=np.uint8))
    return bytes(data)


def text_changed(text: str, rng) -> str:
    """Return text with numbers and words replaced, or lines moved, doubled or taken out."""
    for _ in range(int(rng.integers(1, 3))):
        kind = int(rng.choice(6, p=[0.35, 0.3, 0.1, 0.1, 0.1, 0.05]))
        lines = text.split("\n")
        at, other = (int(rng.integers(len(lines))) for _ in range(2))
        if kind <= 1:
            text = _replaced(text, NUMBER, rng)
        elif kind == 2:
            text = _replaced(text, WORD, rng)
        elif kind == 3:
            lines[at], lines[other] = lines[other], lines[at]
            text = "\n".join(lines)
        elif kind == 4:
            text = "\n".join(
                lines[:at] + lines[at : at + 1] * int(rng.integers(3)) + lines[at + 1 :]
            )
        else:
            depth = int(rng.choice([5, 5000]))
            text = text.replace(lines[at], lines[at] + rng.choice(["[", "{", "<a>"]) * depth, 1)
    return text


def _replaced(text: str, pattern: re.Pattern[str], rng) -> str:
    found = list(pattern.finditer(text))
    if not found:
        return text
    match = found[int(rng.integers(len(found)))]
    new = str(rng.choice(NASTY))
    if pattern is NUMBER and rng.random() < 0.5:  # what may still be meant
        new = f"{float(match.group()) * rng.choice([0.5, 1.1, -1.0, 100.0]):.6g}"
    return text[: match.start()] + new + text[match.end() :]


def json_changed(text: str, rng) -> str:
    """Return JSON with one value replaced, taken out, or named otherwise."""
    value = json.loads(text)
    places = list(_places(value))
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(4))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[str(rng.choice(NASTY))] = holder.pop(key)
    else:
        holder[key] = VALUES[int(rng.integers(len(VALUES)))]
    return json.dumps(value)


def _places(value):
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in list(items):
        yield value, key
        if isinstance(item, dict | list):
            yield from _places(item)


def file_changed(path: Path, rng) -> None:
    """Change one file, or one file of a folder, as its kind asks for."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        path = files[int(rng.integers(len(files)))]
        if rng.random() < 0.1:
            path.unlink()
            return
    data, meaning = path.read_bytes(), rng.random() < 0.7
    if meaning and path.suffix in MEANING:
        MEANING[path.suffix](path, rng)
    elif meaning and path.suffix in (".csv", ".toml", ".urdf", ".txt", ".jsonl", ".yaml"):
        path.write_text(text_changed(data.decode(), rng), encoding="utf-8", errors="replace")
    else:
        path.write_bytes(bytes_changed(data, rng))


# Binary files whose meaning is changed: read by another library, changed, written again.


def _numbers_changed(values: np.ndarray, rng) -> np.ndarray:
    """Return an array with some numbers, its type or its shape changed."""
    kind = int(rng.integers(6))
    if kind == 0:
        return values.reshape(-1)[: int(rng.integers(0, values.size + 1))]
    if kind == 1:
        return np.swapaxes(values, 0, -1) if values.ndim else values[None]
    if kind == 2:
        return np.asarray(rng.choice(["a", "", "x"]) if values.ndim == 0 else values.astype("S8"))
    if kind == 3:
        return values.astype(rng.choice(["int8", "complex128", "float16", "bool"]))
    if not np.issubdtype(values.dtype, np.floating) or values.size == 0:
        return values[:0] if values.ndim else values
    values = values.copy()
    count = int(rng.choice([1, max(1, values.size // 3), values.size]))
    values.flat[rng.integers(0, values.size, count)] = rng.choice(NUMBERS)
    return values


def _hdf5(path: Path, rng) -> None:
    import h5py

    with h5py.File(path, "r+") as file:
        names = sorted(file)
        name = str(rng.choice(names))
        kind = int(rng.integers(5))
        if kind == 0:
            del file[name]
        elif kind == 1:
            key = str(
                rng.choice(["units", "_FillValue", "scale_factor", "DIMENSION_LIST", "calendar"])
            )
            file[name].attrs[key] = str(rng.choice(["days since 2000-01-01", "", "x"]))
        elif kind == 2:
            key = str(
                rng.choice(["measured_rate_hz", "robot", "configuration", "seed", "_NCProperties"])
            )
            file.attrs[key] = VALUES[int(rng.integers(5, len(VALUES) - 4))]
        else:
            old = file[name]
            scales = [dict(dimension) for dimension in old.dims]
            values = old[()]
            if values.dtype == object:
                values = np.array([b"healthy"] * len(values), dtype="S") if values.ndim else values
                values[:1] = [rng.choice(["", "motor_9:stuck", "x", "\x1b[31m"]).encode()]
            else:
                values = _numbers_changed(values, rng)
            del file[name]
            new = file.create_dataset(name, data=values)
            for dimension, known in zip(new.dims, scales, strict=False):
                for scale in known.values():
                    dimension.attach_scale(scale)


def _matlab(path: Path, rng) -> None:
    from scipy.io import loadmat, savemat

    content = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    name = str(rng.choice(sorted(content)))
    value = content[name]
    kind = int(rng.integers(4))
    if kind == 0:
        content[str(rng.choice(["dataset", "X_array", "y_array", "hidden_dataset"]))] = content.pop(
            name
        )
    elif kind == 1:
        content[name] = rng.choice([np.nan, 0.0]) * np.ones((int(rng.integers(0, 5)), 6))
    elif value.dtype == object and kind == 2:
        value.flat[int(rng.integers(value.size))] = rng.choice([1.0, np.nan]) * np.ones((3, 3))
    elif value.dtype == object:
        content[name] = value.reshape(-1)[: int(rng.integers(value.size + 1))]
    else:
        content[name] = _numbers_changed(value, rng)
    try:
        savemat(path, content, do_compression=bool(rng.integers(2)))
    except (TypeError, ValueError):
        path.write_bytes(b"MATLAB 5.0")


def _parquet(path: Path, rng) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    place = int(rng.integers(table.num_columns))
    name = table.column_names[place]
    rows = table.column(place).to_pylist()
    at = int(rng.integers(len(rows)))
    kind = int(rng.integers(6))
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.slice(0, int(rng.integers(3)))
    else:
        nasty = [None, -1, 10**15, 0]
        if isinstance(rows[0], list):
            nasty = [None, [], [1.0], [float("nan")] * 6, [1e38] * 6, [float("inf")] * 6]
        rows = [
            nasty[int(rng.integers(len(nasty)))] if k == at or kind == 5 else row
            for k, row in enumerate(rows)
        ]
        kind = pa.list_(pa.float32()) if isinstance(nasty[1], list) else pa.int64()
        table = table.set_column(place, name, pa.array(rows, kind))
    pq.write_table(table, path)


def _npz(path: Path, rng) -> None:
    with np.load(path) as stored:
        arrays = dict(stored)
    name = str(rng.choice(sorted(arrays)))
    if name == "configuration" or rng.random() < 0.4:
        text = json_changed(arrays["configuration"].tobytes().decode(), rng)
        arrays["configuration"] = np.frombuffer(text.encode(), dtype=np.uint8)
    elif rng.random() < 0.2:
        del arrays[name]
    else:
        arrays[name] = _numbers_changed(arrays[name], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for key, value in arrays.items():
            inner = io.BytesIO()
            np.save(inner, value, allow_pickle=False)
            archive.writestr(f"{key}.npy", inner.getvalue())
    path.write_bytes(buffer.getvalue())


def _json(path: Path, rng) -> None:
    path.write_text(json_changed(path.read_text(), rng))


MEANING = {
    ".nc": _hdf5,
    ".mat": _matlab,
    ".parquet": _parquet,
    ".npz": _npz,
    ".json": _json,
}


def entries_changed(entries, rng):
    """Return messages of a recording with some contents changed."""
    entries = list(entries)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(entries)))
        item = entries[at]
        content = dict(item.content)
        kind = int(rng.integers(6))
        keys = [key for key in content if key != "header"]
        key = keys[int(rng.integers(len(keys)))]
        if kind == 0:
            del entries[at]
        elif kind == 1:
            stamp = int(rng.choice([0, 1, 10**9, 2**31 - 1, 1_700_000_002]))
            content["header"] = {
                "stamp": {"sec": stamp, "nanosec": int(rng.choice([0, 2**32 - 1]))}
            }
        elif kind == 2 and isinstance(content[key], list):
            content[key] = content[key][: int(rng.integers(len(content[key]) + 1))]
        elif kind == 3:
            content[key] = _content_changed(content[key], rng)
        elif kind == 4:
            content["header"] = {**content["header"], "frame_id": "\x1b[31m[red]"}
        else:
            content = {"header": content["header"]}
        if kind:
            entries[at] = type(item)(item.topic, item.type, content, item.received_ns)
        if not entries:
            break
    return entries


def _content_changed(value, rng):
    number = float(rng.choice(NUMBERS))
    if isinstance(value, dict):
        return {key: number if isinstance(old, float) else old for key, old in value.items()}
    if value and isinstance(value[0], str):
        return [str(rng.choice(NASTY)) for _ in value]
    if value and isinstance(value[0], dict):
        point = dict(value[0])
        if rng.random() < 0.5:
            point["positions"] = [number] * int(rng.integers(6))
        else:
            late = {"sec": int(rng.choice([-1, 0, 2**31 - 1])), "nanosec": 0}
            point["time_from_start"] = late
        return [point] * int(rng.integers(4))
    return [number for _ in value]
