"""Rivals: kernels, filters and adaptation against brute force; the study in small."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from failuretwin.app.reports.study_page import rivals_table, write_rivals
from failuretwin.core.errors import InputError
from failuretwin.decision.benchmark.baselines import Displacement, KalmanBank, Readings
from failuretwin.decision.benchmark.tasks import PREFIXES_S
from failuretwin.decision.learned.feature_encoder import POINTS
from failuretwin.decision.learned.paper_study import PLAN_FILE, WORK, StudyPlan, stand_in_test_set
from failuretwin.decision.rivals import study
from failuretwin.decision.rivals.training import LATE, RivalJob, RivalPlan, folds, rival_jobs
from failuretwin.digital_model.twin import DigitalTwin

TINY = RivalPlan(0, 4, 2, 1, 2)
SOME = ("cnn", "motorwise", "dann", "fine-tuned", "nearest", "bayes", "hybrid")
"""Methods of the small study: one of each way that a job can go."""


def test_a_filter_gives_the_joint_density_of_its_readings(armpi):
    """The likelihood of a linear Gaussian model is that of all readings as one normal vector."""
    rng, steps, motors = np.random.default_rng(1), 4, 4
    bank, angle = KalmanBank(DigitalTwin(armpi)), rng.uniform(-0.5, 0.5, (1, steps, motors))
    path, jacobian = bank.twin.path_and_jacobian(angle)
    first, drift = rng.uniform(1e-4, 4e-4, motors), rng.uniform(1e-5, 4e-5, motors)
    measured = path + 1e-4 * rng.standard_normal(path.shape)
    readings = Readings(measured, np.ones((1, steps), dtype=bool))
    displacement = Displacement(first, drift, np.zeros(motors))
    found = bank.log_likelihood(readings, angle, displacement)[0]
    # Displacement at step k: the first one plus k + 1 drifts; steps share what came before.
    share = [[np.diag(first + (min(i, j) + 1) * drift) for j in range(steps)] for i in range(steps)]
    rows = np.zeros((3 * steps, motors * steps))
    for k in range(steps):
        rows[3 * k : 3 * k + 3, motors * k : motors * (k + 1)] = jacobian[0, k]
    noise = (1e-3 * armpi.reach) ** 2
    spread = rows @ np.block(share) @ rows.T + noise * np.eye(3 * steps)
    density = multivariate_normal(np.zeros(3 * steps), spread).logpdf((measured - path).ravel())
    constant = 1.5 * steps * np.log(2.0 * np.pi)
    assert found == pytest.approx(density + constant, rel=1e-9)


def test_kernels_are_convolutions():
    """Each is the sum of its channels, convolved with weights of 2 and -1, spread by dilation."""
    classical = pytest.importorskip("failuretwin.decision.rivals.classical")
    rng = np.random.default_rng(0)
    series, rocket = rng.standard_normal((3, POINTS, 2)), classical.MiniRocket()
    rocket._transformed(series, fresh=True)
    kernels = len(rocket.KERNELS)
    for number, found in enumerate(rocket._convolved(series)):
        if number % 97:
            continue
        dilation = rocket.DILATIONS[number // kernels]
        weights = np.full(9, -1.0)
        weights[list(rocket.KERNELS[number % kernels])] = 2.0
        spread = np.zeros(8 * dilation + 1)
        spread[::dilation] = weights
        for run in range(3):
            summed = series[run][:, rocket.channels_[number]].sum(axis=1)
            expected = np.convolve(summed, spread[::-1], mode="same")
            np.testing.assert_allclose(found[run], expected, atol=1e-12)


@pytest.mark.parametrize("name", ["MiniRocket", "GradientBoosting", "NearestSimulation"])
def test_classifiers_separate_what_is_separate(name):
    classical = pytest.importorskip("failuretwin.decision.rivals.classical")
    rng = np.random.default_rng(0)
    classes = np.repeat(["a", "b"], 120)
    features = rng.standard_normal((240, POINTS, 2))
    features[120:, 40:60] += 2.0
    model = getattr(classical, name)().fit(features[::2], classes[::2])
    chances = model.predict_proba(features[1::2].reshape(120, -1))
    assert (model.predict(features[1::2]) == classes[1::2]).mean() > 0.9
    np.testing.assert_allclose(chances.sum(axis=1), 1.0)


def test_the_gradient_is_reversed():
    torch = pytest.importorskip("torch")
    from failuretwin.decision.learned.networks import _Reversed

    x = torch.ones(3, requires_grad=True)
    (_Reversed.apply(x, 0.5) * torch.tensor([1.0, 2.0, 3.0])).sum().backward()
    np.testing.assert_allclose(x.grad, [-0.5, -1.0, -1.5])


def test_the_past_alone_decides_a_temporal_convolution():
    torch = pytest.importorskip("torch")
    from failuretwin.decision.learned.networks import build_network

    network = build_network("tcn", 2, 3).eval()
    x = torch.zeros(1, 70, 2)
    later = x.clone()
    later[0, 0] = 5.0  # 62 steps before the last one is the furthest that is seen
    assert torch.equal(network(x), network(later))
    later[0, -1] = 5.0
    assert not torch.equal(network(x), network(later))


def test_views_end_early_and_rest(armpi):
    runs = stand_in_test_set(StudyPlan(0, stand_in_runs=1), armpi).runs
    whole, *early = study.views_of(runs)
    assert whole.equals(runs)
    for end, view in zip(PREFIXES_S, early, strict=True):
        seen = runs["time"].values < end
        for name in ("command", "measured"):
            np.testing.assert_array_equal(view[name][:, seen], runs[name][:, seen])
        assert view["measured"][:, ~seen].isnull().all()
        assert (view["command"][:, ~seen] == view["command"][:, seen][:, -1]).all()


def test_folds_hold_blocks_of_every_class():
    truth = np.repeat([0, 1], 10)
    fold = folds(truth)
    assert fold.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4] * 2


def test_every_method_of_the_text_has_a_job():
    jobs = rival_jobs(RivalPlan())
    assert len(set(jobs)) == len(jobs)
    seeds = {j.method: sum(o.method == j.method and o.twin == j.twin for o in jobs) for j in jobs}
    assert {name for name, count in seeds.items() if count == 1} == {
        "kalman",
        "bayes",
        "self-calibrating",
    }
    assert set(seeds.values()) == {1, 5}
    letters = {job.name: job.protocol for job in jobs}
    assert letters["lstm_published_0"] == "P0"
    assert letters["lstm_imperfect_0"] == "P0c"
    assert letters["dann_published_0"] == "P1"
    assert letters["fine-tuned_imperfect_0"] == "P2"


def test_the_study_in_small(armpi, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    done = []

    def one_by_one(work, jobs, on_progress):
        for job in jobs:
            work(job)
            done.append(job)
            on_progress(1)

    jobs = [j for j in rival_jobs(TINY) if j.method in SOME and j.twin == "imperfect"]
    jobs.append(RivalJob("nearest", "published", 0))
    monkeypatch.setattr(study, "spread", one_by_one)
    monkeypatch.setattr(study, "rival_jobs", lambda plan: jobs)
    exam = stand_in_test_set(StudyPlan(0, stand_in_runs=TINY.stand_in_runs), armpi)
    out = tmp_path / "out"
    study.run_rivals(TINY, armpi, exam, out, lambda count: None)
    assert done == sorted(jobs, key=lambda job: job.method in LATE)
    done.clear()
    answers = out / WORK / study.ANSWERS
    (answers / "nearest_published_0.json").unlink()
    study.run_rivals(TINY, armpi, exam, out, lambda count: None)
    assert [job.name for job in done] == ["nearest_published_0"]
    scores = list(study.rival_scores(TINY, out / WORK))
    bayes = next(s for s in scores if (s.method, s.twin) == ("bayes", "imperfect"))
    assert bayes.gain[0] == 0.0 and bayes.p == 1.0
    assert bayes.accuracy[0] > 0.8
    assert 0.0 <= bayes.delay_s < 10.0 and bayes.alarms[0] > 80.0
    page = write_rivals(scores, TINY, armpi, exam, out).read_text("utf-8")
    assert "80.22" in page and "A small version" in page
    assert (out / "rivals.tex").read_text("utf-8").count(r"\\") == len(scores) + 1
    assert len(rivals_table(scores).rows) == len(scores)
    stored = json.loads((out / PLAN_FILE).read_text("utf-8"))
    assert stored["iterations"] == 2
    with pytest.raises(InputError, match="has repeats 1, this one 5"):
        study.run_rivals(RivalPlan(0, 4, 2, 5, 2), armpi, exam, out, lambda count: None)
