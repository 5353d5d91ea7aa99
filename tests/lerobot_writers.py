"""Small LeRobot data sets, as the recorder writes them."""

from __future__ import annotations

import json

import numpy as np
import pytest

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
V2, V3 = "v2.1", "v3.0"
FPS = 30


def write_info(folder, version, names, dtype="float32"):
    feature = {"dtype": dtype, "shape": [6], "names": names}
    info = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "fps": FPS,
        "features": {"action": feature, "observation.state": feature},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def write_table(path, episodes, dtype="float32"):
    """Write a parquet file as the recorder does: a row a frame, vectors of fixed size."""
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: extra lerobot")
    import pyarrow.parquet as pq

    columns = {"action": [], "observation.state": [], "timestamp": []}
    columns |= {"frame_index": [], "episode_index": []}
    for number, (action, state) in episodes.items():
        columns["action"] += np.asarray(action).astype(dtype).tolist()
        columns["observation.state"] += np.asarray(state).astype(dtype).tolist()
        columns["timestamp"] += (np.arange(len(action)) / FPS).tolist()
        columns["frame_index"] += range(len(action))
        columns["episode_index"] += [number] * len(action)
    vector, whole = pa.list_(pa.type_for_alias(dtype.replace("float32", "float")), 6), pa.int64()
    kinds = [vector, vector, pa.float32(), whole, whole]
    arrays = [pa.array(v, k) for v, k in zip(columns.values(), kinds, strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(arrays, names=list(columns)).replace_schema_metadata({"huggingface": "{}"})
    pq.write_table(table, path)


def statistics(state):
    return {
        "observation.state": {
            **{kind: getattr(state, kind)(axis=0).tolist() for kind in ("min", "max", "mean")},
            "std": state.std(axis=0).tolist(),
            "count": [len(state)],
        },
        "timestamp": {"min": [0.0]},
    }


def write_episodes(folder, episodes, version, dtype="float32"):
    """Write a data set of some (action, state), each (frame, 6), with its statistics."""
    plain = version == V3
    names = [f"{n}.pos" for n in NAMES] if plain else {"motors": [f"main_{n}" for n in NAMES]}
    write_info(folder, version, names, dtype)
    numbered = dict(enumerate(episodes))
    told = [statistics(np.asarray(state)) for _, state in episodes]
    if plain:
        write_table(folder / "data" / "chunk-000" / "file-000.parquet", numbered, dtype)
        write_v3_statistics(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet", told)
    else:
        for number, episode in numbered.items():
            file = folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet"
            write_table(file, {number: episode}, dtype)
        rows = [json.dumps({"episode_index": k, "stats": one}) for k, one in enumerate(told)]
        (folder / "meta" / "episodes_stats.jsonl").write_text("\n".join(rows) + "\n")
    whole = statistics(np.concatenate([state for _, state in episodes]))
    (folder / "meta" / "stats.json").write_text(json.dumps(whole))
    video = folder / "videos" / "front.mp4"
    video.parent.mkdir()
    video.write_bytes(b"\x00film")
    return folder


def write_v3_statistics(path, told):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True)
    name = "observation.state"
    columns = {f"stats/{name}/{k}": [one[name][k] for one in told] for k in told[0][name]}
    pq.write_table(pa.table({"episode_index": list(range(len(told))), **columns}), path)


def write_calibration(path, ranges):
    """Write LeRobot's calibration file of an arm, of (range_min, range_max) of each joint."""
    entry = {"drive_mode": 0, "homing_offset": 0}
    joints = {
        name: {"id": k, **entry, "range_min": low, "range_max": high}
        for k, (name, (low, high)) in enumerate(zip(NAMES, ranges, strict=True), start=1)
    }
    path.write_text(json.dumps(joints))
    return path


# Simulated episodes, read by encoders of 4096 counts a turn.

RANGES = [(700, 3396), (896, 3200), (948, 3148), (905, 3191), (131, 3965), (1900, 3300)]
"""Ranges of an arm's joints, about its middle, 2048 [counts]."""


def simulated_counts(count=3, seed=0, hypothesis="healthy"):
    """Return commands and readings of simulated SO-101 episodes, (frame, 6) [counts] each."""
    import failuretwin as ft

    known = ft.load_calibration(None, "so101")
    plan = ft.Plan(
        "so101", [hypothesis], runs_per_class=count, seed=seed, imperfections=known.imperfections
    )
    runs, units = ft.simulate(plan), known.robot.servo_units
    time = runs["time"].values
    at = np.rint(np.arange(0.0, time[-1], 1.0 / FPS) / time[1]).astype(int)
    gripper = np.full((len(at), 1), 2600.0)
    return [
        tuple(
            np.concatenate([np.rint(units.to_counts(runs[name].values[k, at])), gripper], axis=1)
            for name in ("command", "position")
        )
        for k in range(count)
    ]


def in_unit(counts, unit):
    """Return counts as LeRobot writes them: deg, rad, servo or normalised."""
    if unit == "servo":
        return counts
    low, high = np.array(RANGES, dtype=float).T
    if unit == "normalised":
        return (counts - low) / (high - low) * 200.0 - 100.0
    degrees = (counts - (low + high) / 2.0) * 360.0 / 4095.0
    return np.deg2rad(degrees) if unit == "rad" else degrees
