"""Lengths and angles by which runs are read: those of the arm and of its sensor.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds, from_table
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Range

LEAST_NOISE_M = 1e-7
"""No settled position is told better than this [m]."""
NOISE_FACTOR = 3.0
"""Lengths by which rest is told from motion are at least so many times the sensor's noise: the
distance of a reading from the median of many exceeds that once in 34 times if it is normal."""
UNKNOWN_NOISE_M = 0.001
"""What the sensor of an arm is taken to tell apart where nothing is known of it [m]."""
RESOLUTION = 2.5e-4
"""What can be told apart at best, in the reach of the arm [-]: 0.3 mm of an arm of 1.3 m."""
ROUGHNESS = 0.007
"""What straight lines between the knots of a path leave out, in the reach [-]; ArmPi: 2 mm."""
NOISE_OF_REACH = 2e-4
"""Noise of a settled position that no motor makes, in the reach [-]: 0.2 mm of an arm of a metre.
Industrial arms come back to 0.05 to 0.1 mm, and a nominal geometry leaves more; assumed."""
NOISE_OF_FIT = 0.5
"""The same where the geometry is fitted, in what the fit leaves [-]: at least so much belongs to no
motor, however their scatter was told apart from it; assumed."""
ERROR_STEPS = (0.75, 1.12, 1.67, 2.5)
"""Where ranges of steady-state errors begin, in the least error that a profile states: even steps
of the logarithm of a run's scale, from what several movements show together to the paper's."""
WIDEST_ERROR = 5.0
"""Greatest size of a range, in its least one: the paper's 10 to 50 counts."""


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
        least_noise_m: Least noise of a settled tool position, beside that of the readings: bending
            links, bearings [m]; ArmPi: assumed.
        least_error_rad: Least size of a steady-state error of any motor [rad]; ArmPi: four counts
            of 0.24 deg, just above its healthy scatter. 0: what can be seen of each motor.
        idle_axes: Axes along which no motor moves the tool: one that stands still is not dead.
    """

    moving_spread_m: AtLeastZero = 0.004
    nearly_still_m: AtLeastZero = 0.003
    same_place_m: AtLeastZero = 0.002
    unmoved_m: AtLeastZero = 0.02
    update_m: AtLeastZero = 0.0005
    path_roughness_m: AtLeastZero = 0.002
    least_noise_m: Annotated[float, Bounds(LEAST_NOISE_M)] = 0.0003
    least_error_rad: AtLeastZero = 0.0
    idle_axes: tuple[bool, bool, bool] = (False, False, False)

    @property
    def error_ranges(self) -> tuple[Range, ...]:
        """Run-level ranges of a steady-state error's size, where the profile states the least.

        From what several movements show together to the paper's own, of the ArmPi FPV 10 to 50
        counts [rad].
        """
        least = np.array(ERROR_STEPS) * self.least_error_rad
        return tuple((float(low), float(WIDEST_ERROR * low)) for low in least)

    @classmethod
    def of(cls, robot: Robot, imperfections: Imperfections | None = None) -> InferenceSettings:
        """Return the settings of a robot.

        What the table `inference` of its profile says. Else multiples of what its sensor can tell
        apart: its noise, where that is known, and no less than a share of the reach. Those that
        tell rest from motion are no less than `NOISE_FACTOR` times the noise.

        Args:
            robot: The robot.
            imperfections: What is known of its sensor; None: nothing.

        Raises:
            InputError: If the table holds anything else, or a negative number.
        """
        readings = None if imperfections is None else imperfections.readings
        noise = UNKNOWN_NOISE_M if readings is None else readings.noise_m
        least = 0.0 if readings is None else NOISE_FACTOR * readings.noise_m
        apart = max(noise, RESOLUTION * robot.reach)
        fitted = robot.profile.geometry.sensor_noise_m
        # Readings that are no counts, and of which no noise is told, were not measured.
        told = readings is not None and (readings.whole_counts or readings.noise_m > 0.0)
        at_rest = NOISE_FACTOR * max(noise if told else UNKNOWN_NOISE_M, fitted)
        table = {
            "moving_spread_m": max(4.0 * apart, at_rest),
            "nearly_still_m": max(3.0 * apart, at_rest),
            "same_place_m": max(2.0 * apart, least),
            "unmoved_m": max(20.0 * apart, least),
            "update_m": 0.5 * apart,
            "path_roughness_m": ROUGHNESS * robot.reach,
            "least_noise_m": NOISE_OF_FIT * fitted if fitted else NOISE_OF_REACH * robot.reach,
        }
        read = from_table(cls, table | robot.profile.inference, f"{robot.name}: inference")
        return replace(read, idle_axes=robot.idle_axes)


USUAL = InferenceSettings()
"""Settings where nothing is known of the arm and its sensor."""
