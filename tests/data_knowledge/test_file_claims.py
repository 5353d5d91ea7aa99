"""What a stranger's file claims is checked before anything of it is decoded or allocated."""

from __future__ import annotations

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from failuretwin import read_runs
from failuretwin.core import foreign
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.foreign import (
    EXPANSION,
    LEAST_BYTES,
    as_cell,
    check_size,
    printable,
    read_text,
)
from failuretwin.core.hypothesis import parse_hypotheses
from failuretwin.data_knowledge import store
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.data_knowledge.readers.file_claims import check_matlab, check_npz, check_recording
from failuretwin.data_knowledge.readers.matlab import export_runs, write_csv
from failuretwin.data_knowledge.resumable import produce
from failuretwin.data_knowledge.store import filling, load_run_set, replacing, save_run_set


@pytest.fixture(scope="module")
def runs(armpi):
    hypotheses = parse_hypotheses(["healthy", "motor_2:stuck"], armpi.motor_names)
    return simulate(Plan(armpi, hypotheses, 1, 3))


@pytest.fixture
def zarr(runs, tmp_path):
    save_run_set(runs, tmp_path / "runs.zarr")
    return tmp_path / "runs.zarr"


@pytest.fixture
def small_limit(monkeypatch):
    """Let small files unfold to a megabyte, so that bombs can be small too."""
    monkeypatch.setattr(foreign, "LEAST_BYTES", 1_000_000)


def peak_of(call):
    """Return by how much a call raised the most memory that this process ever had [bytes]."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call()
    return 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)


def test_the_limit_is_a_share_of_the_file_and_of_the_memory(tmp_path, monkeypatch):
    path = tmp_path / "log.bin"
    path.write_bytes(b"x" * 5_000_000)
    monkeypatch.setattr(foreign, "free_bytes", lambda: 1e12)
    check_size(EXPANSION * 5_000_000, path, "its arrays")
    with pytest.raises(InputError, match="its arrays would take 1 GB, and it has 5 MB"):
        check_size(EXPANSION * 5_000_000 + 1, path, "its arrays")
    path.write_bytes(b"x")
    check_size(LEAST_BYTES, path, "its arrays")
    with pytest.raises(InputError, match="256 MB"):
        check_size(LEAST_BYTES + 1, path, "its arrays")
    monkeypatch.setattr(foreign, "free_bytes", lambda: 1e8)
    check_size(5e7, path, "its arrays")
    with pytest.raises(InputError, match="60 MB, expected half of the 100 MB of free memory"):
        check_size(6e7, path, "its arrays")


def test_a_limit_of_the_process_counts_as_its_memory():
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_DATA, (10**9, 10**9));"
        "from failuretwin.core.foreign import free_bytes; print(free_bytes() <= 10**9)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "True"


def test_a_netcdf_file_of_megabytes_that_claims_terabytes(runs, tmp_path):
    import h5py

    path = tmp_path / "runs.nc"
    save_run_set(runs, path)
    with h5py.File(path, "r+") as file:
        file.create_dataset("huge", shape=(37_000_000_000,), dtype="f8", chunks=(1000,))

    def refuse():
        with pytest.raises(InputError, match="its arrays would take 296 GB"):
            load_run_set(path)

    assert peak_of(refuse) < 100_000_000


@pytest.mark.parametrize("kind", ["external", "link"])
def test_a_netcdf_file_that_reads_from_another_is_refused(runs, tmp_path, kind):
    import h5py

    path, other = tmp_path / "runs.nc", tmp_path / "secret"
    save_run_set(runs, path)
    other.write_bytes(bytes(80))
    with h5py.File(path, "r+") as file:
        if kind == "external":
            file.create_dataset("x", (10,), "f8", external=[(str(other), 0, 80)])
        else:
            file["x"] = h5py.ExternalLink(str(other), "/x")
    with pytest.raises(InputError, match="lies in another file"):
        load_run_set(path)


def change(file, edit):
    node = json.loads(file.read_text())
    edit(node)
    file.write_text(json.dumps(node))


@pytest.mark.parametrize("codec", ["numcodecs.pickle", "pickle", "gzip", "sharding_indexed"])
def test_a_codec_that_we_do_not_write_is_refused_before_it_is_looked_up(zarr, codec):
    change(zarr / "fault" / "zarr.json", lambda n: n["codecs"].insert(0, {"name": codec}))
    with pytest.raises(InputError, match=f"has the codec '{codec}'"):
        load_run_set(zarr)


def test_pickled_objects_in_a_store_of_the_old_format_run_nothing(tmp_path):
    numcodecs = pytest.importorskip("numcodecs")
    folder, told = tmp_path / "runs.zarr", tmp_path / "ran"

    class Evil:
        def __reduce__(self):
            return os.system, (f"touch {told}",)

    (folder / "command").mkdir(parents=True)
    (folder / ".zgroup").write_text('{"zarr_format": 2}')
    array = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "order": "C"}
    array |= {"compressor": None, "fill_value": None, "filters": [{"id": "pickle"}]}
    (folder / "command" / ".zarray").write_text(json.dumps(array))
    codec = numcodecs.Pickle()
    (folder / "command" / "0").write_bytes(codec.encode(np.array([Evil()], dtype=object)))
    told.unlink(missing_ok=True)

    with pytest.raises(InputError, match="no Zarr store of format 3"):
        load_run_set(folder)
    assert not told.exists()


def test_the_copy_of_the_metadata_in_the_root_is_not_believed(zarr):
    def lie(node):
        shape = node["consolidated_metadata"]["metadata"]["command"]["shape"]
        shape[0] = 10**12

    sound = load_run_set(zarr)
    change(zarr / "zarr.json", lie)
    assert load_run_set(zarr).sizes["run"] == sound.sizes["run"]


@pytest.mark.parametrize("key", ["shape", "chunks"])
def test_a_zarr_array_that_claims_too_much(zarr, key):
    def claim(node):
        node["shape" if key == "shape" else "chunk_grid"] = (
            [10**7, 1000, 4] if key == "shape" else
            {"name": "regular", "configuration": {"chunk_shape": [10**7, 1000, 4]}}
        )  # fmt: skip

    change(zarr / "command" / "zarr.json", claim)
    with pytest.raises(InputError, match="its arrays would take 320 GB"):
        load_run_set(zarr)


@pytest.mark.parametrize("name", ["command", "measured", "duration", "fault", "time"])
def test_a_chunk_that_got_lost_is_said(zarr, name):
    next(f for f in (zarr / name).rglob("*") if f.is_file() and not f.suffix).unlink()
    with pytest.raises(InputError, match=f"{name}: chunk c.* is missing"):
        load_run_set(zarr)


def test_runs_that_were_written_chunk_by_chunk_hold_every_chunk(armpi, tmp_path):
    hypotheses = parse_hypotheses(["healthy"], armpi.motor_names)
    produce(Plan(armpi, hypotheses, 5, 3), tmp_path / "runs.zarr", chunk_runs=2)
    for name in ("onset", "magnitude", "command"):  # onset and magnitude are unknown throughout
        assert len(list((tmp_path / "runs.zarr" / name).glob("c.*"))) == 3
    (tmp_path / "runs.zarr" / "measured" / "c.1.0.0").unlink()
    with pytest.raises(InputError, match=r"chunk c\.1\.0\.0 is missing \(2 of 3 are there\)"):
        load_run_set(tmp_path / "runs.zarr")


@pytest.mark.parametrize("length", [-1.0, 0.0, np.nan, np.inf, 1e4])
def test_a_duration_that_no_run_has(runs, tmp_path, length):
    wrong = runs.copy(deep=True)
    wrong["duration"].values[1] = length
    wrong.to_netcdf(tmp_path / "runs.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=r"`duration` of run '.*' is .*, expected a time above 0"):
        load_run_set(tmp_path / "runs.nc")


# MATLAB


def element(kind, body):
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def matrix(sizes, data):
    flags = element(6, struct.pack("<II", 6, 0))
    dims = element(5, struct.pack(f"<{len(sizes)}i", *sizes))
    return element(14, flags + dims + element(1, b"dataset") + element(9, data))


def mat_file(path, body):
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + body)
    return path


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (matrix((100_000, 10_000), b""), "its matrices would take 16 GB"),
        (struct.pack("<II", 14, 2**32 - 1), "claims 4294967295 bytes where 0 are left"),
        (element(14, struct.pack("<II", 9, 10**9) + bytes(8)), "claims 1000000000 bytes"),
        (
            struct.pack("<II", 15, len(zlib.compress(bytes(20_000_000), 9)))
            + zlib.compress(bytes(20_000_000), 9),
            "what is compressed in it would take 20 MB",
        ),
    ],
    ids=["dimensions", "length", "inner length", "zip bomb"],
)
def test_a_matlab_file_that_claims_too_much(tmp_path, small_limit, body, said):
    path = mat_file(tmp_path / "dataset_1.mat", body)
    with pytest.raises(InputError, match=said):
        check_matlab(path)


def test_cells_within_cells_without_end(tmp_path):
    body = b""
    for _ in range(2000):
        body = element(14, body)
    with pytest.raises(InputError, match="more than 32 deep"):
        check_matlab(mat_file(tmp_path / "dataset_1.mat", body))


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_files_of_others_pass(tmp_path, compressed):
    cells = np.empty((2, 3), dtype=object)
    cells[:] = [["a", np.arange(5), "éß"], [np.zeros((0, 2)), {"a": 1.0}, 1 + 2j]]
    path = tmp_path / "x.mat"
    scipy.io.savemat(path, {"cells": cells, "n": 3, "text": "x"}, do_compression=compressed)
    check_matlab(path)


def test_published_matlab_files_pass(data):
    for path in sorted((data / "processed_samples").rglob("*.mat")):
        check_matlab(path)


# Networks and recordings


def test_an_npz_archive_whose_header_claims_too_much(tmp_path):
    path = tmp_path / "network.npz"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,), }"
    header = header.ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    with pytest.raises(InputError, match="its arrays would take 80 GB"):
        check_npz(path)


def bag_of(path, data, compression):
    """Write a ROS 1 bag with one chunk, and let it say that the chunk unfolds to 1000 bytes."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    bag = rosbag1.Writer(path)
    bag.set_compression(bag.CompressionFormat[compression])
    with bag:
        bag.write(bag.add_connection("/odd", "std_msgs/msg/String", typestore=store), 0, data)
    written = path.read_bytes()
    at = written.index(b"size=") + len(b"size=")
    path.write_bytes(written[:at] + struct.pack("<I", 1000) + written[at + 4 :])


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_a_bag_whose_chunk_unfolds_to_more_than_it_says(tmp_path, small_limit, compression):
    path = tmp_path / "run.bag"
    bag_of(path, bytes(20_000_000), compression)
    assert path.stat().st_size < 100_000
    for read in (check_recording, read_runs):
        with pytest.raises(InputError, match=r"its messages would take (16|20) MB"):
            read(path)


def mcap_chunk(data, compression):
    name = compression.encode()
    record = struct.pack("<QQQI", 0, 0, 1000, 0) + struct.pack("<I", len(name)) + name
    record += struct.pack("<Q", len(data)) + data
    return b"\x89MCAP0\r\n\x06" + struct.pack("<Q", len(record)) + record


@pytest.mark.parametrize("pieces", [1, 20])
def test_an_mcap_file_whose_chunk_unfolds_to_more_than_it_says(tmp_path, small_limit, pieces):
    """Also where the chunk is many frames, each of them small."""
    lz4 = pytest.importorskip("lz4.frame")
    data = lz4.compress(bytes(20_000_000 // pieces)) * pieces
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap_chunk(data, "lz4"))
    with pytest.raises(InputError, match=r"its messages would take (16|20) MB"):
        check_recording(path)


def test_an_mcap_file_that_goes_on_after_its_end_is_refused(tmp_path):
    writer = pytest.importorskip("mcap.writer").Writer(str(tmp_path / "run.mcap"))
    writer.start(profile="ros2")
    writer.finish()
    path = tmp_path / "run.mcap"
    check_recording(path)
    path.write_bytes(path.read_bytes() * 2)
    with pytest.raises(InputError, match="goes on after its end"):
        check_recording(path)


# Text of files


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("motor 1 [red]stuck[/red], 30 °", "motor 1 [red]stuck[/red], 30 °"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("a\u202eb\x9bc\u2028d", "a\\u202eb\\x9bc\\u2028d"),
        ("one\ntwo\tthree", "one\ntwo\tthree"),
        ("\ud800", "\\ud800"),
    ],
)
def test_what_a_terminal_acts_on_is_written_out(text, shown):
    assert printable(text) == shown


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1", "-1", "@x", "\tx", "\rx"])
def test_text_like_a_formula_is_quoted_in_cells(text):
    assert as_cell(text) == f"'{printable(text)}"
    assert as_cell(-1.5) == -1.5
    assert as_cell("motor_1=") == "motor_1="
    assert as_cell("a\x1b[31mb") == "a\\x1b[31mb"


def test_names_of_runs_are_quoted_in_csv(runs, tmp_path):
    named = runs.assign_coords(run=np.array(["=1+1", "b"], dtype=object))
    write_csv(named, tmp_path / "runs.csv")
    lines = (tmp_path / "runs.csv").read_text().splitlines()
    assert lines[1].startswith("'=1+1,0.0,")
    assert lines[-1].startswith("b,")


# Work of processes that died


def test_unfinished_work_of_dead_processes_is_swept(tmp_path):
    file, folder = tmp_path / "out.jsonl", tmp_path / "plots"
    (tmp_path / ".out.jsonl.partial.jsonl").write_text("half")
    (tmp_path / ".plots.partial").mkdir()
    (tmp_path / ".plots.partial" / "a.png").write_text("half")
    (tmp_path / ".out.jsonl.lock").write_text("process 1 on arm-1")
    with replacing(file) as partial:
        partial.write_text("whole")
    with filling(folder) as partial:
        (partial / "b.png").write_text("whole")
    assert file.read_text() == "whole"
    assert [found.name for found in folder.iterdir()] == ["b.png"]
    assert sorted(found.name for found in tmp_path.iterdir()) == ["out.jsonl", "plots"]


def test_two_writers_of_a_file_wait_for_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "PATIENCE_S", 0.2)
    path = tmp_path / "out.jsonl"
    with replacing(path) as partial:
        partial.write_text("first")
        with pytest.raises(OutputError, match="is writing it"), replacing(path):
            pass
    assert path.read_text() == "first"
    monkeypatch.setattr(store, "PATIENCE_S", 10.0)
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda text: store.write_text(text, path), map(str, range(20))))
    assert path.read_text() in map(str, range(20))
    assert [found.name for found in tmp_path.iterdir()] == ["out.jsonl"]


def test_matlab_exports_of_our_own_pass(runs, twin, tmp_path):
    for name in ("cells.mat", "pairs"):
        export_runs(runs, tmp_path / name, twin)
        for path in sorted(tmp_path.rglob("*.mat")):
            check_matlab(path)
    shutil.rmtree(tmp_path / "pairs")


def test_what_has_no_end_is_no_file():
    with pytest.raises(InputError, match="device or a pipe"):
        read_runs("/dev/zero")
    with pytest.raises(InputError, match="device or a pipe"):
        read_text(Path("/dev/zero"), "a profile")
