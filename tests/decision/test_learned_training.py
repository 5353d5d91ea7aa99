from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from failuretwin.app.commands.learn import train as command
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.learned.log_pool import HybridDiagnoser
from failuretwin.decision.learned.networks import (
    Standard,
    build_network,
    scores_of,
    shuffled_batches,
    training,
)
from failuretwin.decision.training import TrainingPlan, train
from failuretwin.decision.training_data import KINDS, PopulationStream, widened

CHANNELS, CLASSES = 10, 3
ALL = pytest.mark.parametrize("name", ["lstm", "cnn", "tcn"])


def toy(runs=96, seed=0):
    """Runs whose class is the channel with a bump somewhere in time."""
    rng = np.random.default_rng(seed)
    features = 0.1 * rng.standard_normal((runs, 40, CHANNELS)).astype(np.float32)
    classes = rng.integers(0, CLASSES, runs)
    for run, kind in enumerate(classes):
        at = rng.integers(5, 30)
        features[run, at : at + 8, 4 * (kind % 2) + kind // 2] += 2.0
    return features, classes


def learn(name, seed=0, iterations=40):
    features, classes = toy()
    torch.manual_seed(seed)
    network = build_network(name, CHANNELS, CLASSES)
    batches = shuffled_batches(features, classes, 32, np.random.default_rng(seed))
    for _ in training(network, batches, iterations, 3e-3):
        pass
    return network


@ALL
def test_a_bump_is_learned(name):
    features, classes = toy(seed=1)
    said = scores_of(learn(name), features).argmax(axis=1)
    assert np.mean(said == classes) > 0.9


def test_the_same_seed_gives_the_same_network():
    features, _ = toy()
    first, again, other = (scores_of(learn("cnn", s, 5), features) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


def test_the_papers_network_has_its_size():
    """Two LSTM layers of 100 units with two bias vectors each, one dense layer."""
    network = build_network("lstm", 6, 9)
    layers = 4 * 100 * (6 + 100 + 2) + 4 * 100 * (100 + 100 + 2)
    assert sum(p.numel() for p in network.parameters()) == layers + 100 * 9 + 9


def test_the_papers_network_begins_as_in_matlab():
    """Orthogonal recurrent weights; a forget gate that starts open, about sigmoid(1)."""
    network = build_network("lstm", 6, 9)
    for layer in (network.first, network.second):
        back = layer.weight_hh_l0.detach()
        torch.testing.assert_close(back.T @ back, torch.eye(100), atol=1e-5, rtol=0.0)
        bias = (layer.bias_ih_l0 + layer.bias_hh_l0).detach().reshape(4, 100)
        torch.testing.assert_close(bias, torch.tensor([0.0, 1.0, 0.0, 0.0])[:, None].expand(4, 100))


def test_nothing_is_dropped_when_nothing_is_learned():
    network = build_network("lstm", CHANNELS, CLASSES)
    features, _ = toy(8)
    np.testing.assert_array_equal(scores_of(network, features), scores_of(network, features))


def test_an_unknown_network_is_refused():
    with pytest.raises(InputError, match="Did you mean 'lstm'"):
        build_network("lstms", CHANNELS, CLASSES)


@pytest.mark.parametrize("decay", [False, True])
def test_the_rate_falls_to_zero_or_stays(decay):
    """Adam moves a weight by about the rate at first, and by less later."""
    network, (features, classes) = build_network("cnn", CHANNELS, CLASSES), toy()
    batches = shuffled_batches(features, classes, 32, np.random.default_rng(0))
    weight, steps = network.dense.weight, []
    before = weight.detach().clone()
    for _ in training(network, batches, 40, 1e-3, decay):
        steps.append(float((weight.detach() - before).abs().max()))
        before = weight.detach().clone()
    assert steps[0] == pytest.approx(1e-3, rel=0.01)
    assert (steps[-1] < 0.02 * steps[0]) == decay


def test_an_epoch_is_101_batches_of_the_papers_data():
    batches = shuffled_batches(
        np.arange(3240, dtype=np.float32)[:, None, None],
        np.zeros(3240, dtype=np.int64),
        32,
        np.random.default_rng(0),
    )
    epoch = np.concatenate([next(batches)[0].ravel() for _ in range(101)])
    assert len(np.unique(epoch)) == len(epoch) == 3232


def test_standardised_channels_have_unit_spread():
    features = np.random.default_rng(0).normal(3.0, 5.0, (50, 20, 4)).astype(np.float32)
    features[..., 3] = 7.0
    made = Standard.of(features)(features)
    np.testing.assert_allclose(made.mean(axis=(0, 1)), 0.0, atol=1e-5)
    np.testing.assert_allclose(made.std(axis=(0, 1)), [1.0, 1.0, 1.0, 0.0], atol=1e-5)


def test_small_errors_come_most_often():
    small = [kind for kind in KINDS if kind.error_counts[0] <= 5.0]
    assert len(small) > len(KINDS) / 2
    assert (10.0, 50.0) in [kind.error_counts for kind in KINDS]  # the paper's


def test_widened_robots_differ_more(armpi):
    from failuretwin.digital_model.calibrated_robot import load_calibration

    known = load_calibration("armpi_fpv", armpi).imperfections
    wide = widened(known, 3.0)
    np.testing.assert_allclose(wide.variation.bias, 3.0 * np.array(known.variation.bias))
    assert wide.settling == known.settling
    assert widened(wide, 1.0) == wide


def test_a_network_is_trained_and_pooled_with_bayes_in_one_call(armpi, measured_armpi, monkeypatch):
    """In one process."""

    def made(stream):
        return (stream.data.chunk(number, 64) for number in itertools.count())

    monkeypatch.setattr(PopulationStream, "chunks", made)
    asked = tuple(h for h in paper_hypotheses(armpi.motor_names) if "error" not in str(h))
    plan = TrainingPlan(iterations=2, validation_runs=18, hypotheses=asked)
    both = train(armpi, measured_armpi, plan, with_bayes=True)
    assert isinstance(both, HybridDiagnoser)
    assert both.weights == both.network.weights_
    runs = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names)[:1], 1, 2, measured_armpi))
    (diagnosis,) = both.diagnose(runs)
    assert diagnosis.method.startswith("blended: bayes")
    assert set(diagnosis.posterior) == set(map(str, asked))


def test_the_command_trains_as_much_as_python_does():
    given = {option.name: option.default for option in command.params}
    assert given["iterations"] == TrainingPlan().iterations == 6000
