from __future__ import annotations

import copy
import itertools
from contextlib import closing
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from scipy.stats import binom
from sklearn.base import clone

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision import training_data as stream_module
from failuretwin.decision.learned.diagnoser import (
    MotorwiseDiagnoser,
    best_temperature,
    check_modes,
)
from failuretwin.decision.learned.estimates import Onset, Size, fitted_factor
from failuretwin.decision.learned.moment_encoder import MomentEncoder, Tokens
from failuretwin.decision.learned.motorwise import Labels, onset_bins
from failuretwin.decision.learned.networks import device_of
from failuretwin.decision.learned.storage import export_onnx, load_network, save_network
from failuretwin.decision.training_data import PopulationData, PopulationStream
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibrated
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.registry import MODES
from user_modes import code_on_the_page, registered_from

PAPER_MODES = {mode: MODES[mode] for mode in ("stuck", "steady_state_error")}
BUNDLED = ("armpi_fpv", "so101", "ur5e", "panda")


def test_set(robot, imperfections, per_class=3, seed=2):
    hypotheses = paper_hypotheses(robot.motor_names)
    return simulate(Plan(robot, hypotheses, per_class, seed, imperfections))


test_set.__test__ = False


@pytest.fixture(scope="module")
def runs(armpi, measured_armpi):
    return test_set(armpi, measured_armpi)


@pytest.fixture(scope="module")
def encoder(armpi, measured_armpi):
    return MomentEncoder(armpi, measured_armpi)


@pytest.fixture(scope="module")
def trained(encoder, runs):
    return MotorwiseDiagnoser(encoder, iterations=12, random_state=1).fit(runs)


def test_a_token_says_how_far_its_motor_is_off(armpi):
    """Of a robot without imperfections, to a hundredth of a count."""
    states = parse_hypotheses(["motor_2:encoder_bias"], armpi.motor_names)
    modes = {"encoder_bias": replace(MODES["encoder_bias"], magnitude=(0.1, 0.1), onset_s=(0, 0))}
    found = simulate(Plan(armpi, states, 3, 1, NO_IMPERFECTIONS, modes=modes))
    tokens = MomentEncoder(armpi, NO_IMPERFECTIONS).encode(found)
    log_rms = tokens.anchor[:, 0, 1, 2]
    np.testing.assert_allclose(np.exp(log_rms), np.abs(found["magnitude"].values), rtol=0.01)


def test_the_common_angle_is_that_at_which_a_motor_is_held(armpi):
    states = parse_hypotheses([f"motor_{k}:stuck" for k in range(1, 5)], armpi.motor_names)
    found = simulate(Plan(armpi, states, 5, 1, NO_IMPERFECTIONS))
    tokens = MomentEncoder(armpi, NO_IMPERFECTIONS).encode(found)
    motor = np.repeat(np.arange(4), 5)
    angle = tokens.anchor[np.arange(20), 2, motor, 0]
    np.testing.assert_allclose(angle, found["magnitude"].values, atol=1e-3)


def test_an_onset_lies_in_its_bin(armpi, encoder, runs):
    tokens = encoder.encode(runs)
    faulty = np.flatnonzero(np.isfinite(runs["onset"].values))
    truth = Labels.of_runs(runs, list(runs["fault"].values), armpi.motor_names, list(PAPER_MODES))
    row, place = onset_bins(tokens[faulty], truth.motor[faulty], truth.onset[faulty])
    edges = tokens.edges[faulty, row, truth.motor[faulty]]
    at = np.arange(len(faulty))
    assert np.all(edges[at, place] <= truth.onset[faulty] + 1e-6)
    assert np.all(truth.onset[faulty] <= edges[at, place + 1] + 1e-6)


def test_an_onset_before_the_run_has_a_bin_of_its_own(encoder, runs):
    tokens = encoder.encode(runs)[slice(0, 2)]
    row, place = onset_bins(tokens, np.zeros(2, dtype=np.int64), np.array([0.0, 1e-3]))
    assert (row.tolist(), place.tolist()) == ([0, 0], [0, 1])


def test_motors_in_another_order_get_the_answers_in_that_order(encoder, trained, runs):
    tokens = encoder.encode(runs)
    order = np.array([2, 0, 3, 1])
    other = Tokens(
        tokens.features[:, :, order],
        tokens.exists,
        tokens.anchor[:, :, order],
        tokens.edges[:, :, order],
    )
    first, second = trained.scores(tokens), trained.scores(other)
    classes = np.r_[0, 1 + order, 5 + order]
    np.testing.assert_allclose(second, first[:, classes], atol=1e-4)


def test_room_for_more_moments_changes_nothing(encoder, trained, runs):
    tokens = encoder.encode(runs)
    np.testing.assert_allclose(trained.scores(tokens.padded(9)), trained.scores(tokens), atol=1e-4)


@pytest.mark.parametrize("arm", BUNDLED)
def test_one_network_answers_for_every_arm(trained, arm):
    known = calibrated(arm)
    found = trained.for_robot(MomentEncoder(known.robot, known.imperfections))
    for diagnosis in found.diagnose(test_set(known.robot, known.imperfections, 1)):
        assert sum(diagnosis.posterior.values()) == pytest.approx(1.0)
        assert set(diagnosis.posterior) == set(map(str, paper_hypotheses(known.robot.motor_names)))
        strange = [remark for remark in diagnosis.quality if "other arms" in remark]
        assert bool(strange) == (arm != "armpi_fpv")


def test_diagnoses_tell_onset_and_size(runs, trained):
    for diagnosis in trained.diagnose(runs[["command", "measured", "duration"]]):
        assert diagnosis.truth is None
        if diagnosis.diagnosis == "healthy":
            assert diagnosis.onset_s is None
            continue
        low, high = diagnosis.onset_90
        assert 0.0 <= low <= diagnosis.onset_s <= high <= runs["time"].values[-1]
        least, most = diagnosis.magnitude_90
        assert least <= diagnosis.magnitude <= most
        assert diagnosis.magnitude_unit == "rad"


def test_a_log_without_readings_gets_no_verdict(runs, trained):
    silent = runs.isel(run=[0]).copy(deep=True)
    silent["measured"].values[:] = np.nan
    (diagnosis,) = trained.diagnose(silent)
    assert diagnosis.diagnosis is None
    assert diagnosis.magnitude is None


def test_quantiles_of_a_sum_of_normals_hold_their_share():
    rng = np.random.default_rng(0)
    share, mean, deviation = np.array([0.3, 0.7]), np.array([-1.0, 2.0]), np.array([0.5, 1.5])
    which = rng.choice(2, 200_000, p=share)
    drawn = rng.normal(mean[which], deviation[which])
    found = Size(share, mean, deviation).quantiles()
    np.testing.assert_allclose(found, np.quantile(drawn, [0.05, 0.5, 0.95]), atol=0.02)


def test_it_follows_the_protocol_of_scikit_learn(trained, runs):
    fresh = clone(trained)
    assert not hasattr(fresh, "network_")
    assert fresh.get_params()["iterations"] == 12
    right = np.mean(trained.predict(runs) == runs["fault"].values)
    assert trained.score(runs) == pytest.approx(right)
    again = fresh.fit(runs)
    np.testing.assert_array_equal(again.predict_proba(runs), trained.predict_proba(runs))
    cooler = copy.copy(trained).calibrate(runs)
    np.testing.assert_array_equal(cooler.predict(runs), trained.predict(runs))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda runs: runs.drop_vars("onset"), "lacks onset"),
        (lambda runs: np.zeros((3, 4)), "not arrays"),
        (lambda runs: runs.assign(fault=("run", ["motor_1:drift"] * runs.sizes["run"])), "drift"),
    ],
)
def test_runs_to_learn_from_need_their_truth(encoder, runs, change, words):
    with pytest.raises(InputError, match=words):
        MotorwiseDiagnoser(encoder, iterations=1).fit(change(runs))


def test_a_stored_network_answers_the_same(trained, runs, tmp_path):
    trained = copy.copy(trained)
    trained.temperature_ = 0.7
    save_network(trained, tmp_path / "network.npz")
    again = load_network(tmp_path / "network.npz")
    first, second = (d.diagnose(runs)[0].to_record() for d in (again, trained))
    assert first == second
    assert again.coder.imperfections == trained.coder.imperfections


def test_a_stored_network_takes_other_robots_and_calibrations(trained, armpi, tmp_path):
    save_network(trained, tmp_path / "network.npz")
    ur5e = load_network(tmp_path / "network.npz", load_robot("ur5e"))
    assert len(ur5e.classes_) == 1 + 2 * len(ur5e.known_robot.motors)
    named = load_network(tmp_path / "network.npz", "ur5e")
    assert list(named.classes_) == list(ur5e.classes_)
    with pytest.raises(InputError, match="ur5"):
        load_network(tmp_path / "network.npz", "ur55")
    ideal = load_network(tmp_path / "network.npz", CalibratedRobot(armpi, NO_IMPERFECTIONS))
    assert "healthy behaviour: none" in ideal.about[1]


def test_onnx_runtime_agrees_for_any_arm(trained, runs, encoder, tmp_path):
    pytest.importorskip("onnxscript")
    export_onnx(trained, tmp_path / "network.onnx")
    session = onnxruntime.InferenceSession(
        tmp_path / "network.onnx", providers=["CPUExecutionProvider"]
    )
    known = calibrated("panda")
    panda = MomentEncoder(known.robot, known.imperfections)
    others = panda.encode(test_set(known.robot, known.imperfections, 1))
    for network, tokens in (
        (trained, encoder.encode(runs)),
        (trained.for_robot(panda), others),
        (trained, encoder.encode(runs)[slice(0, 1)].padded(7)),
    ):
        given = {"features": tokens.features, "exists": tokens.exists}
        chances, *_ = session.run(None, given)
        np.testing.assert_allclose(chances, network.predict_proba(tokens), atol=5e-6)
    assert session.get_modelmeta().custom_metadata_map["modes"] == "stuck,steady_state_error"


def test_hypotheses_are_each_mode_at_each_motor(armpi):
    names = armpi.motor_names
    told = ["healthy", *(f"{n}:drift" for n in names), *(f"{n}:stuck" for n in names)]
    assert check_modes(told, armpi) == ("drift", "stuck")
    for wrong in (["healthy", "motor_1:stuck"], [*told, "motor_1:stuck+motor_2:stuck"]):
        with pytest.raises(InputError, match="each mode at each motor"):
            check_modes(wrong, armpi)


def test_networks_are_trained_on_a_gpu_where_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("auto").type == "cuda"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of("auto").type == "cpu"
    with pytest.raises(InputError, match="no GPU"):
        device_of("cuda")


def test_chunks_depend_on_seed_and_number_alone():
    robots = tuple(calibrated(name) for name in ("armpi_fpv", "ur5e"))
    first, again, other = (PopulationData(robots, PAPER_MODES, seed) for seed in (4, 4, 5))
    for number, motors in ((0, 4), (1, 5)):
        tokens, labels = first.chunk(number, 9)
        assert tokens.features.shape[2] == motors
        same_tokens, same_labels = again.chunk(number, 9)
        np.testing.assert_array_equal(tokens.features, same_tokens.features)
        np.testing.assert_array_equal(labels.size, same_labels.size)
        assert not np.array_equal(labels.size, other.chunk(number, 9)[1].size)


def test_every_run_of_every_arm_is_used_as_often_as_asked():
    robots = tuple(calibrated(name) for name in ("armpi_fpv", "ur5e"))
    data = PopulationData(robots, PAPER_MODES, 3)
    network = MotorwiseDiagnoser(MomentEncoder(robots[0].robot, robots[0].imperfections))
    chunks = [data.chunk(number, 18) for number in range(6)]
    stream = PopulationStream(data, network.batch_of, batch_runs=2, uses=2)
    seen = [batch.size[batch.mode >= 0] for batch in stream.batches(iter(chunks))]
    for number, (_, labels) in enumerate(chunks):
        size = labels.size[labels.mode == 1]
        times = sum(int(np.isin(np.log(size).astype(np.float32), batch).sum()) for batch in seen)
        assert times == len(size) * (2 if number < 4 else 1)


@pytest.fixture(scope="module")
def population(armpi, measured_armpi):
    """A network that has learned for half a minute, and runs that it has not seen."""
    known = CalibratedRobot(armpi, measured_armpi)
    data = PopulationData((known,), PAPER_MODES, 11)
    network = MotorwiseDiagnoser(
        MomentEncoder(armpi, measured_armpi), iterations=500, random_state=0
    )
    chunks = [data.chunk(number, 540) for number in range(10)]
    stream = PopulationStream(data, network.batch_of, uses=6)
    batches = list(stream.batches(iter(chunks)))[-500:]
    network.fit_batches(batches, [chunks[0][0]], (3, 8), ["armpi_fpv"])
    exam = replace(data, seed=12, widening=(1.0,))
    return network, exam.run_set(0, 900)


@pytest.mark.slow
def test_intervals_hold_as_often_as_they_say(population):
    """Simulation-based: truths drawn from the population, 90 % intervals of the named fault."""
    network, exam = population
    onset, size = exam["onset"].values, exam["magnitude"].values
    found = network.diagnose(exam)
    right = [i for i, d in enumerate(found) if d.diagnosis == d.truth != "healthy"]
    assert len(right) > 0.8 * np.isfinite(onset).sum()

    def inside(interval, value):
        return interval[0] - 1e-6 <= value <= interval[1] + 1e-6

    for kind in ("stuck", "steady_state_error"):
        some = [i for i in right if found[i].diagnosis.endswith(kind)]
        held = [sum(inside(found[i].onset_90, onset[i]) for i in some)]
        held.append(sum(inside(found[i].magnitude_90, size[i]) for i in some))
        least = binom.ppf(1e-3, len(some), 0.86)
        assert min(held) >= least


@pytest.mark.slow
def test_it_is_nearly_as_good_as_its_teacher_soon(population):
    network, exam = population
    assert network.score(exam) > 0.85


def test_sizes_are_widened_until_their_intervals_hold():
    """Deviations that are half of what they should be."""
    rng = np.random.default_rng(0)
    one = np.ones(1)
    held = [(float(x), Size(one, 0.0 * one, 0.5 * one)) for x in rng.standard_normal(2000)]
    assert fitted_factor(held, narrower=False) == pytest.approx(2.0, rel=0.08)
    assert fitted_factor(held[:5], narrower=False) == 1.0


def test_onsets_are_sharpened_until_their_intervals_hold():
    """Shares that are the square roots of what they should be, normalised."""
    rng = np.random.default_rng(0)
    edges = np.linspace(-4.0, 4.0, 81)
    middle = 0.5 * (edges[1:] + edges[:-1])
    said = Onset(edges[:-1], edges[1:], np.exp(-0.25 * middle**2)).powered(1.0)
    held = [(float(x), said) for x in rng.standard_normal(2000)]
    assert fitted_factor(held, narrower=True) == pytest.approx(2.0, rel=0.12)
    low, half, high = said.powered(2.0).quantiles()
    np.testing.assert_allclose((low, half, high), (-1.645, 0.0, 1.645), atol=0.02)


def test_intervals_are_calibrated_by_robot_and_change_no_verdict(trained, runs, armpi):
    other = copy.copy(trained).calibrate_intervals(test_set(armpi, NO_IMPERFECTIONS, 12))
    assert set(other.widths_) == {"armpi_fpv"}
    assert trained.widths_ == {}
    np.testing.assert_array_equal(other.predict_proba(runs), trained.predict_proba(runs))
    panda = calibrated("panda")
    strange = other.for_robot(MomentEncoder(panda.robot, panda.imperfections))
    assert strange._widths == other.widths_["armpi_fpv"]


def test_temperature_of_scores_that_are_too_sure():
    """Scores three times the logs of honest chances need a temperature of three."""
    rng = np.random.default_rng(0)
    chances = rng.dirichlet([0.5] * 4, 4000)
    truth = np.array([rng.choice(4, p=p) for p in chances])
    assert best_temperature(3.0 * np.log(chances + 1e-12), truth) == pytest.approx(3.0, rel=0.1)


def test_calibration_on_unknown_classes_is_refused(runs, trained):
    with pytest.raises(InputError, match="does not know motor_9:stuck"):
        trained.calibrate(runs, ["motor_9:stuck"] * runs.sizes["run"])


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"batch_runs": 0}])
def test_learning_from_nothing_is_refused(encoder, runs, wrong):
    with pytest.raises(InputError, match="Expected one at least"):
        MotorwiseDiagnoser(encoder, **wrong).fit(runs)


def test_fresh_runs_come_from_other_processes_in_order(
    armpi, measured_armpi, monkeypatch, tmp_path
):
    """Runs of a mode that a user has registered, too."""
    monkeypatch.setattr(stream_module, "CHUNK_RUNS", 18)
    known = CalibratedRobot(armpi, measured_armpi)
    with registered_from(code_on_the_page(), tmp_path, "shaft_to_learn"):
        data = PopulationData((known,), {"bent_shaft": MODES["bent_shaft"]}, 3)
        stream = PopulationStream(data, lambda tokens, labels: None)
        with closing(stream.chunks()) as chunks:
            streamed = list(itertools.islice(chunks, 2))
        expected = [data.chunk(number, 18) for number in range(2)]
    for (tokens, labels), (same_tokens, same_labels) in zip(streamed, expected, strict=True):
        np.testing.assert_array_equal(tokens.features, same_tokens.features)
        np.testing.assert_array_equal(labels.mode, same_labels.mode)
        assert set(labels.mode) == {-1, 0}


def test_runs_of_an_unknown_kind_are_told(runs, trained):
    """Half of the movements: the network says something, and that it means little."""
    short = runs.isel(run=[0], time=slice(0, 450))[["command", "measured"]]
    (diagnosis,) = trained.diagnose(short)
    assert any("learned from runs of 5" in remark for remark in diagnosis.quality)
    (whole,) = trained.diagnose(runs.isel(run=[0]))
    assert not any("learned from runs" in remark for remark in whole.quality)
