"""Files of imperfections: what is left out does not happen, nonsense is refused."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.digital_model.calibrated_robot import load_calibration

HEAD = 'name = "own"\nsource = "test"\n'
NONSENSE = {
    "[readings]\nrate_hz = -5": "rate_hz is -5, expected a number from 0.1",
    "[readings]\nrate_hz = 10\nnoise_m = -0.001": "noise_m is -0.001",
    "[readings]\nrate_hz = 10\nglitch_rate = [0.0, 0.0, 0.0, 1.5]": "glitch_rate is 1.5",
    "[timing]\ndelay_s = [0.3, 0.1]": "delay_s is \\[0.3, 0.1\\], expected the lowest",
    "[timing]\nlate_s = [-5, -2]": "late_s is \\[-5, -2\\]",
    "[timing]\nlate_rate = 3": "late_rate is 3, expected a number from 0 to 1",
    "[timing]\nlag_s = [0.0, nan]": "lag_s is",
    "[schedule]\nperiod_s = [-1, 2]": "period_s is \\[-1, 2\\]",
    "[settling]\ntail_dof = 0": "tail_dof is 0",
    "[settling]\nbias = [nan, 0.0, 0.0, 0.0]": "bias is nan",
    "[settling]\nscatter = [-0.1, 0.0, 0.0, 0.0]": "scatter is -0.1",
    "[settling]\npayload = -1": "payload is -1",
    "[settling]\nfriction = [0.1]": "friction has 1 values, expected 4",
    "[variation]\nrates = -1": "rates is -1",
    '[[lost_commands]]\nmotors = ["motor_1"]\nrate = 2.1\nrate_when_late = 0': "rate is 2.1",
    '[[lost_commands]]\nmotors = ["motor_9"]\nrate = 0.1\nrate_when_late = 0': "motor 'motor_9'",
}


@pytest.fixture
def load(armpi, tmp_path):
    def loaded(text):
        path = tmp_path / "own.toml"
        path.write_text(HEAD + text + "\n")
        return load_calibration(path, armpi).imperfections

    return loaded


@pytest.mark.parametrize("text", NONSENSE)
def test_nonsense_is_refused_with_the_name_of_the_file(load, text):
    with pytest.raises(InputError, match=f"own.toml.*{NONSENSE[text]}"):
        load(text)


def test_unknown_protocol_is_refused(armpi, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(HEAD + 'protocol = "P9"\n')
    with pytest.raises(InputError, match=r"own.toml: .*protocol 'P9'"):
        load_calibration(path, armpi)


def test_rates_of_losses_are_shares_together(load):
    entry = '[[lost_commands]]\nmotors = ["motor_{}"]\nrate = 0.6\nrate_when_late = 0.1\n'
    with pytest.raises(InputError, match=r"rates add up to 1\.2"):
        load(entry.format(1) + entry.format(2))


def test_what_is_left_out_does_not_happen(load, armpi):
    found = load("[settling]\nfriction = [0.01, 0.0, 0.0, 0.02]")
    pose = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 4))
    offset = found.settling.offset(armpi, pose, np.ones((5, 4)))
    np.testing.assert_array_equal(offset, np.broadcast_to([-0.01, 0.0, 0.0, -0.02], (5, 4)))
    assert found.timing.late_rate == 0.0 and found.readings is None and not found.lost_commands
