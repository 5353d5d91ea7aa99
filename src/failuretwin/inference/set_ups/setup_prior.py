"""Prior of set-ups: how far a sensor may stand off the profile, and how probable that is."""

from __future__ import annotations

from dataclasses import dataclass

from failuretwin.core.config import AtLeastZero, Bounded, Share


@dataclass(frozen=True)
class SetupPrior(Bounded):
    """How far the set-up of a sensor may be off, and how probable that is.

    With the rest of the probability the sensor is registered as the profile says. Lengths are
    shares of the arm's reach. Figures: chosen on simulated runs and poses of a UR10 by how people
    mount cameras and trackers, never on faults.

    Attributes:
        origin: Deviations of the origin on each axis, small and large [share of reach].
        turn_rad: Deviations of the turn about each axis, small and large [rad].
        scale: Deviation of the scale [-].
        noise: Deviations of noise that nobody told of, small and large [share of reach].
        origin_rate: Probability that the origin alone is off, shared by both deviations.
        turn_rate: Probability that the turn alone is off, shared by both deviations.
        scale_rate: Probability that the scale alone is off.
        all_rate: Probability that all three are off.
        noise_rate: Probability that the noise is larger, shared by both deviations.
        wrong_rate: Probability that the log does not fit the profile in some other way, such as a
            motor that turns the other way: with a calibration that fitted this robot, and of an
            arm whose logs are seen for the first time.
        another_rate: Probability that the robot is not the one of its calibration, or has changed
            since: then it is as others of its class.
    """

    origin: tuple[float, float] = (0.0065, 0.026)
    turn_rad: tuple[float, float] = (0.0087, 0.035)
    scale: AtLeastZero = 0.015
    noise: tuple[float, float] = (0.004, 0.01)
    origin_rate: Share = 0.16
    turn_rate: Share = 0.16
    scale_rate: Share = 0.07
    all_rate: Share = 0.08
    noise_rate: Share = 0.08
    wrong_rate: tuple[float, float] = (0.01, 0.3)
    another_rate: Share = 0.1

    @property
    def doubt(self) -> float:
        """Probability that the set-up is off in some way."""
        rates = (self.origin_rate, self.turn_rate, self.scale_rate, self.all_rate)
        return sum(rates) + self.noise_rate

    @property
    def odds(self) -> float:
        """Odds that the set-up is off in some way."""
        return self.doubt / (1.0 - self.doubt)

    @classmethod
    def known(cls) -> SetupPrior:
        """Return the belief that robot, sensor and noise are exactly as told."""
        return cls(
            origin_rate=0.0,
            turn_rate=0.0,
            scale_rate=0.0,
            all_rate=0.0,
            noise_rate=0.0,
            wrong_rate=(0.0, 0.0),
            another_rate=0.0,
        )
