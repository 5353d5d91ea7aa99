"""Speed of learning and of learned diagnosers, against what they must reach on two cores."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from failuretwin.decision.learned.diagnoser import MotorwiseDiagnoser
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.networks import (
    build_network,
    shuffled_batches,
    training,
)
from failuretwin.decision.learned.paper_study import in_bfloat16
from failuretwin.decision.learned.storage import export_onnx
from failuretwin.decision.training_data import (
    CHUNK_RUNS,
    Chunk,
    PopulationData,
    PopulationStream,
)
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.failure_behavior.registry import MODES

PAPER_ITERATIONS, PAPER_JOBS = 5050, 20
STREAMED = 200
"""Batches of the timed stream."""


def paper_training(cores: int) -> float:
    """Return the time of one training of the paper's LSTM [s], from a few iterations.

    Args:
        cores: Threads that share the work.
    """
    rng = np.random.default_rng(0)
    features = rng.standard_normal((3240, 100, 6)).astype(np.float32)
    classes = rng.integers(0, 9, 3240)
    torch.set_num_threads(cores)
    network = build_network("lstm", 6, 9)
    batches = shuffled_batches(features, classes, 32, rng)
    steps = in_bfloat16(training(network, batches, 1000))
    for _ in itertools.islice(steps, 10):
        pass
    begun, timed = time.perf_counter(), 60
    for _ in itertools.islice(steps, timed):
        pass
    torch.set_num_threads(1)
    return (time.perf_counter() - begun) / timed * PAPER_ITERATIONS


def share_waited(network: MotorwiseDiagnoser, data: PopulationData) -> tuple[float, float]:
    """Return the time of an iteration [s] and the share of it that training waits for runs.

    Of a training that has been going on: the first chunk, which it waits for once, is left out.
    """
    stream = PopulationStream(data, network.batch_of)
    waits: list[float] = []

    def timed(chunks: Iterator[Chunk]) -> Iterator[Chunk]:
        while True:
            begun = time.perf_counter()
            chunk = next(chunks)
            waits.append(time.perf_counter() - begun)
            yield chunk

    with closing(stream.chunks()) as chunks:
        sample = next(chunks)[0]
        for _ in range(stream.uses):  # until as many chunks are in use as there ever are
            next(chunks)
        begun = time.perf_counter()
        network.fit_batches(stream.batches(timed(chunks)), [sample], (3, 8), [])
        whole = time.perf_counter() - begun - waits[0]
    return whole / STREAMED, sum(waits[1:]) / whole


def milliseconds(work: Callable[[], object], times: int = 50) -> float:
    """Return the median time of some work [ms]."""
    work()
    taken = []
    for _ in range(times):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return 1000.0 * float(np.median(taken))


def exported(network: MotorwiseDiagnoser, tokens: Tokens, folder: Path) -> float:
    """Return the time to classify one run by ONNX [ms]."""
    export_onnx(network, folder / "network.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(folder / "network.onnx", options)
    one = tokens[slice(0, 1)]
    given = {"features": one.features, "exists": one.exists}
    return milliseconds(lambda: session.run(None, given))


def main() -> None:
    """Time everything and print it."""
    torch.set_num_threads(1)
    known = calibrated("armpi_fpv")
    modes = {name: MODES[name] for name in ("stuck", "steady_state_error")}
    data = PopulationData((known,), modes)
    one, two = paper_training(1), paper_training(2)
    print(f"the paper's LSTM, 5050 iterations: {one:.0f} s on one core, {two:.0f} s on two")
    print(f"so the whole study takes {PAPER_JOBS * one / 2 / 60:.0f} minutes on two cores")
    begun = time.perf_counter()
    tokens, _ = data.chunk(0, CHUNK_RUNS)
    each = 1000.0 * (time.perf_counter() - begun) / CHUNK_RUNS
    print(f"a training run with its tokens: {each:.2f} ms on one core")
    encoder = MomentEncoder(known.robot, known.imperfections)
    network = MotorwiseDiagnoser(encoder, iterations=STREAMED, random_state=0)
    iteration, waits = share_waited(network, data)
    print(f"an iteration of `train`: {1000 * iteration:.1f} ms, {100 * waits:.0f} % of it waiting")
    with tempfile.TemporaryDirectory() as folder:
        print(f"a run by ONNX: {exported(network, tokens, Path(folder)):.2f} ms")


if __name__ == "__main__":
    main()
