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

from failuretwin import load_robot
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.learned.diagnoser import LearnedDiagnoser
from failuretwin.decision.learned.feature_encoder import FeatureEncoder, expectation_of, signals_of
from failuretwin.decision.learned.networks import (
    NETWORKS,
    Batch,
    Shape,
    Standard,
    build_network,
    shuffled_batches,
    training,
)
from failuretwin.decision.learned.storage import export_onnx
from failuretwin.decision.training_data import CHUNK_RUNS, Stream, TrainingData
from failuretwin.digital_model.calibrated_robot import load_calibration

PAPER_ITERATIONS, PAPER_JOBS = 5050, 20
STREAMED = 324
"""Batches of the timed stream: six chunks."""


def paper_training(cores: int) -> float:
    """Return the time of one training of the paper's LSTM [s], from a few iterations.

    Args:
        cores: Threads that share the work.
    """
    rng = np.random.default_rng(0)
    features = rng.standard_normal((3240, 100, 6)).astype(np.float32)
    classes = rng.integers(0, 9, 3240)
    torch.set_num_threads(cores)
    network = build_network("lstm", Shape(6, 9))
    steps = training(network, shuffled_batches(features, classes, 32, rng), 1000)
    for _ in itertools.islice(steps, 10):
        pass
    begun, timed = time.perf_counter(), 60
    for _ in itertools.islice(steps, timed):
        pass
    torch.set_num_threads(1)
    return (time.perf_counter() - begun) / timed * PAPER_ITERATIONS


def share_waited(name: str, encoder: FeatureEncoder, data: TrainingData) -> tuple[float, float]:
    """Return the time of an iteration [s] and the share of it that training waits for runs.

    Of a training that has been going on: the first chunk, which it waits for once, is left out.
    """
    stream = Stream(data, encoder)
    waits: list[float] = []

    def timed(chunks: Iterator[Batch]) -> Iterator[Batch]:
        while True:
            begun = time.perf_counter()
            chunk = next(chunks)
            waits.append(time.perf_counter() - begun)
            yield chunk

    with closing(stream.chunks()) as chunks:
        standard = Standard.of(next(chunks)[0])
        for _ in range(stream.uses):  # until as many chunks are in use as there ever are
            next(chunks)
        diagnoser = LearnedDiagnoser(name, encoder, iterations=STREAMED, random_state=0)
        classes = [str(h) for h in data.hypotheses]
        begun = time.perf_counter()
        diagnoser.fit_batches(stream.batches(timed(chunks)), standard, classes, data.movements)
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


def exported(name: str, encoder: FeatureEncoder, folder: Path) -> float:
    """Return the time to classify one run by ONNX [ms]."""
    robot = encoder.robot
    runs = simulate(Plan(robot, paper_hypotheses(robot.motor_names), 2))
    diagnoser = LearnedDiagnoser(name, encoder, iterations=2, random_state=0).fit(runs)
    export_onnx(diagnoser, folder / "network.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(folder / "network.onnx", options)
    features = encoder.encode(signals_of(runs.isel(run=[0])))
    return milliseconds(lambda: session.run(None, {"features": features}))


def main() -> None:
    """Time everything and print a table."""
    torch.set_num_threads(1)
    robot = load_robot("armpi_fpv")
    imperfect = load_calibration("armpi_fpv", robot).imperfections
    encoder = FeatureEncoder("robust", robot, expectation_of(robot, imperfect))
    data = TrainingData(robot, imperfect)
    one, two = paper_training(1), paper_training(2)
    print(f"the paper's LSTM, 5050 iterations: {one:.0f} s on one core, {two:.0f} s on two")
    print(f"so the whole study takes {PAPER_JOBS * one / 2 / 60:.0f} minutes on two cores")
    begun = time.perf_counter()
    data.chunk(0, CHUNK_RUNS, encoder)
    each = 1000.0 * (time.perf_counter() - begun) / CHUNK_RUNS
    print(f"a training run with its features: {each:.2f} ms on one core\n")
    print(f"{'network':12s}{'iteration':>12s}{'waits':>8s}{'ONNX':>10s}")
    with tempfile.TemporaryDirectory() as folder:
        for name in NETWORKS:
            iteration, waits = share_waited(name, encoder, data)
            by_onnx = exported(name, encoder, Path(folder))
            print(f"{name:12s}{1000 * iteration:9.1f} ms{100 * waits:6.0f} %{by_onnx:7.2f} ms")


if __name__ == "__main__":
    main()
