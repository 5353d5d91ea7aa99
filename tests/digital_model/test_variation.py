from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.disturbances import draw_disturbances, lagged, stack
from failuretwin.digital_model.nonidealities import Variation, vary

SURE = 1e-3
RUNS = 2000
SPREAD = Variation(
    bias=(0.002, 0.004, 0.0, 0.001),
    compliance=(0.3, 0.3, 0.1, 0.0),
    friction=(0.001, 0.0, 0.002, 0.002),
    scatter=(0.2, 0.2, 0.2, 0.2),
    rates=0.5,
    payload=(0.0, 0.1),
)


@pytest.fixture(scope="module")
def known(measured_armpi):
    return measured_armpi


@pytest.fixture(scope="module")
def varied(known):
    rng = np.random.default_rng(0)
    return [vary(replace(known, variation=SPREAD), rng) for _ in range(RUNS)]


def drawn(varied, name):
    return np.array([getattr(one.settling, name) for one in varied])


def test_without_variation_nothing_changes_and_nothing_is_drawn(known):
    rng = np.random.default_rng(5)
    assert vary(known, rng) is known
    assert rng.random() == np.random.default_rng(5).random()


@pytest.mark.parametrize("name", ["bias", "friction"])
def test_offsets_scatter_about_the_figures_as_declared(varied, known, name):
    spread = np.array(getattr(SPREAD, name))
    deviation = drawn(varied, name) - getattr(known.settling, name)
    for motor in range(4):
        if spread[motor] == 0.0:
            assert np.ptp(deviation[:, motor]) < 1e-15
        else:
            test = stats.kstest(deviation[:, motor] / spread[motor], "norm")
            assert test.pvalue > SURE


def log_factors(varied, known, name):
    """Yield the stated spread of each motor, and the logarithms of its drawn factors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.log(drawn(varied, name) / getattr(known.settling, name))
    spread = np.array(getattr(SPREAD, name))
    for motor in np.flatnonzero((spread > 0) & (np.array(getattr(known.settling, name)) > 0)):
        yield spread[motor], factor[:, motor]


def test_scatter_varies_by_factors(varied, known):
    for spread, factor in log_factors(varied, known, "scatter"):
        assert stats.kstest(factor / spread, "norm").pvalue > SURE


def test_compliance_is_log_normal_with_the_stated_mean_and_deviation(varied, known):
    for share, factor in log_factors(varied, known, "compliance"):
        law = stats.lognorm(np.sqrt(np.log(1.0 + share**2)), scale=1.0 / np.sqrt(1.0 + share**2))
        np.testing.assert_allclose([law.mean(), law.std()], [1.0, share])
        assert stats.kstest(np.exp(factor), law.cdf).pvalue > SURE


def test_rates_go_up_and_down_together_and_stay_shares(varied, known):
    late = np.array([one.timing.late_rate for one in varied])
    lost = np.array([one.lost_commands[0].rate for one in varied])
    assert stats.kstest(np.log(late / 0.16) / 0.5, "norm").pvalue > SURE
    common = late / 0.16 < 2.5  # farther up, the losses reach their bound
    np.testing.assert_allclose(
        lost[common] / known.lost_commands[0].rate, late[common] / 0.16, rtol=1e-12
    )
    wild = replace(known, variation=Variation(rates=5.0))
    rng = np.random.default_rng(1)
    for one in (vary(wild, rng) for _ in range(300)):
        assert 0.0 <= one.timing.late_rate <= 1.0
        assert sum(entry.rate_when_late for entry in one.lost_commands) <= 0.9 + 1e-12
        assert max(one.readings.glitch_rate) <= 1.0


def test_payload_is_drawn_from_its_range(varied):
    payload = np.array([one.settling.payload for one in varied])
    assert stats.kstest(payload, "uniform", (0.0, 0.1)).pvalue > SURE


def test_every_run_gets_its_own_robot(armpi, known):
    imperfections = replace(known, variation=SPREAD)
    draws = stack(
        [
            draw_disturbances(imperfections, armpi, 5, 10.0, np.random.default_rng([0, run]))
            for run in range(3)
        ]
    )
    assert draws.bias.shape == draws.compliance.shape == draws.friction.shape == (3, 4)
    assert len(np.unique(draws.bias[:, 0])) == 3


def test_variation_that_does_not_fit_the_robot_is_refused(armpi, tmp_path):
    file = tmp_path / "odd.toml"
    file.write_text('name = "odd"\nsource = "test"\n[variation]\nbias = [0.1, 0.2]\n')
    with pytest.raises(InputError, match="variation: bias has 2 values, expected 4"):
        load_calibration(file, armpi)


def test_lag_follows_a_ramp_as_the_closed_form_says():
    """Behind a first-order lag a ramp r t becomes r (t - T (1 - exp(-t / T)))."""
    time = np.arange(200) * 0.01
    reference = np.broadcast_to((0.3 + 2.0 * time)[None, :, None], (2, 200, 1))
    lag = np.array([0.04, 0.0])
    found = lagged(reference, time, lag)
    expected = 0.3 + 2.0 * (time - 0.04 * (1.0 - np.exp(-time / 0.04)))
    np.testing.assert_allclose(found[0, :, 0], expected, atol=1e-12)
    np.testing.assert_array_equal(found[1], reference[1])
