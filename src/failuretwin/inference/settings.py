"""Lengths and angles by which runs are read: those of the arm and of its sensor.

Section: docs/diagnosis.md#settled-evidence-where-the-tool-rests
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, from_table
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Range

NOISE_FACTOR = 3.0
"""Lengths by which rest is told from motion are at least so many times the sensor's noise: the
distance of a reading from the median of many exceeds that once in 34 times if it is normal."""
ERROR_STEPS = (1.0, 1.75, 2.5)
"""Where ranges of steady-state errors begin, in the least error."""
WIDEST_ERROR = 5.0
"""Greatest error of a range, in its least one: the paper's 10 to 50 counts."""


@dataclass(frozen=True)
class InferenceSettings(Bounded):
    """Lengths and angles that belong to an arm and its sensor.

    The defaults are those of the ArmPi FPV, one count of whose servos moves the tool by 1 mm.

    Attributes:
        moving_spread_m: Median distance of readings from their median above which the tool is
            still moving [m]; ArmPi: four counts.
        nearly_still_m: A tool that stays this near stands still, give or take noise [m]; ArmPi:
            three counts.
        same_place_m: How near readings of a tool lie that rests, while its movement may still go
            on [m]; ArmPi: two counts, and slower than 2 cm/s.
        unmoved_m: A tool this near to where it rested before may not have set out yet [m].
        update_m: A tool that rests this near to where it was judged to rest is not judged anew
            [m]; ArmPi: a tenth of what a healthy one scatters.
        path_roughness_m: What straight lines between the knots of a path and bent ramps leave out
            [m]; ArmPi: links of 0.3 m in all.
        least_error_rad: Least size of a steady-state error [rad]; ArmPi: four counts of 0.24 deg,
            just above its healthy scatter.
    """

    moving_spread_m: AtLeastZero = 0.004
    nearly_still_m: AtLeastZero = 0.003
    same_place_m: AtLeastZero = 0.002
    unmoved_m: AtLeastZero = 0.02
    update_m: AtLeastZero = 0.0005
    path_roughness_m: AtLeastZero = 0.002
    least_error_rad: AtLeastZero = 4 * np.deg2rad(0.24)

    @property
    def error_ranges(self) -> tuple[Range, ...]:
        """Run-level ranges of a steady-state error's size [rad].

        From just above the healthy scatter to the paper's own, of the ArmPi FPV 10 to 50 counts.
        """
        least = np.array(ERROR_STEPS) * self.least_error_rad
        return tuple((float(low), float(WIDEST_ERROR * low)) for low in least)

    @classmethod
    def of(cls, robot: Robot, imperfections: Imperfections | None = None) -> InferenceSettings:
        """Return the settings of a robot.

        What the table `inference` of its profile says; else the defaults, of which those that tell
        rest from motion are no less than `NOISE_FACTOR` times the noise of its sensor.

        Args:
            robot: The robot.
            imperfections: What is known of its sensor; None: nothing.

        Raises:
            InputError: If the table holds anything else, or a negative number.
        """
        readings = None if imperfections is None else imperfections.readings
        noise = 0.0 if readings is None else NOISE_FACTOR * readings.noise_m
        table = asdict(cls())
        for name in ("moving_spread_m", "nearly_still_m", "same_place_m", "unmoved_m"):
            table[name] = max(table[name], noise)
        return from_table(cls, table | robot.profile.inference, f"{robot.name}: inference")


USUAL = InferenceSettings()
"""Settings where nothing is known of the arm and its sensor."""
