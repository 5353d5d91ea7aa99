"""The closed loop of one arm and one task, without clock or robot: what to order next.

    plan with the believed arm -> order -> tool at rest -> belief -> reached? correct, or plan anew

Every reaction stands on feedback: whatever is believed, what the tool misses is taken off its
commands by the Jacobian of the believed arm, and what is out of reach under the belief is done as
if there were none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.links.base import Order
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.belief import Belief, Judge, Judgement
from failuretwin.decision.acting.believed_arm import BelievedArm, BelievedFault, Seen
from failuretwin.decision.acting.planner import Plan, Planner, Standing
from failuretwin.decision.acting.reach import parking_place
from failuretwin.decision.acting.task import (
    DIRECTION_TOLERANCE_RAD,
    ActingSettings,
    Target,
    TargetResult,
    Task,
)
from failuretwin.decision.test_motions.design import next_movement
from failuretwin.digital_model.inverse_kinematics import angle_between
from failuretwin.failure_behavior.mode import Reaction
from failuretwin.inference.observation.healthy_model import HealthyModel

SMALLEST_NEWS_RAD = 0.02
"""A held angle that is believed to lie so far from where it was planned with calls for a new plan
[rad]."""
LEFT_OPEN = 0.9
"""What is wrong is open as long as nothing is more probable, healthy included."""
FIRST_GAIN, LATER_GAIN = 1.0, 0.7
"""Share of the error that the first correction takes off, and each later one."""
HALVINGS = 3
"""A correction that is not safe is tried at half, a quarter and an eighth."""


@dataclass
class _Attempt:
    """What was tried for the present target."""

    movements: int = 0
    corrections: int = 0
    repeats: int = 0
    reachable: bool = True
    as_healthy: bool = False
    planned_with: BelievedFault | None = None
    first_error_m: float = np.nan
    asks: bool = False
    anew: bool = False
    pose: FloatArray = field(default_factory=lambda: np.zeros(0))


class Actor:
    """Carries out a task on one arm.

    `command` is what the motors were told last, (motor,) [rad]. Without a `judge` nothing is
    diagnosed. `tell` is called with what is found out and done, as it happens.
    """

    def __init__(
        self,
        planner: Planner,
        model: HealthyModel,
        task: Task,
        belief: Belief,
        command: FloatArray,
        settings: ActingSettings | None = None,
        judge: Judge | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._planner, self.model, self._task, self._judge = planner, model, task, judge
        self.belief, self._settings = belief, settings or ActingSettings()
        self._say = tell
        self.results: list[TargetResult] = []
        self._command = self._previous = command
        self._order: Order | None = None
        self._time_s = self._pace_s = 0.0
        self._seen: Seen | None = None
        self._attempt = _Attempt()
        self._since_probe = 0
        self.ways: list[tuple[FloatArray, Standing]] = []  # see `Planner.sparing_lines`
        self.judgement: Judgement | None = None
        self._questions = self._settings.questions

    # What is known.

    @property
    def done(self) -> bool:
        """Whether every target was reached or given up."""
        return len(self.results) == len(self._task.targets)

    @property
    def target(self) -> Target:
        """The target that is worked on."""
        return self._task.targets[len(self.results)]

    @property
    def arm(self) -> BelievedArm:
        """The arm as it is worked with: as it is believed to be, or as if it were healthy."""
        fault = None if self._attempt.as_healthy else self.belief.believed
        return BelievedArm(self.model, fault)

    def standing(self) -> Standing:
        """Return where the arm stands as far as is believed."""
        arm = BelievedArm(self.model, self.belief.believed)
        pose = arm.settle(self._command, self._previous, self._time_s)
        travel = self._command - self._previous
        return Standing(pose, self._command, self._time_s + self._pace_s, travel)

    # What was seen.

    def see(self, point: FloatArray | None, start_s: float, rest_s: float) -> None:
        """Learn from where the tool came to rest, and conclude the target if it is time to.

        `point` is (3,) [m], None: it was not seen at rest. Times are those of the robot's clock
        [s].
        """
        if self._order is None or self.done:
            return
        self._time_s, self._pace_s = rest_s, rest_s - start_s
        told = self._command, self._previous, self._order.duration
        self._seen = seen = Seen(*told, start_s, rest_s, point)
        self.belief.add(seen)
        judge, belief = self._judge, self.belief
        self.judgement = None if judge is None else judge(belief.window, belief.believed)
        news = self.belief.take(seen, self.judgement)
        if news:
            self._say(news)
            self._tell_reaction()
        if self._attempt.asks:
            self._attempt.asks, self._attempt.anew = False, True
            return
        attempt = self._attempt
        attempt.movements += 1
        error, feedback = self._error_m(seen), self._settings.feedback
        if attempt.movements == 1:
            attempt.first_error_m = error
        if error <= self.target.tolerance_m and self._error_rad(seen) <= DIRECTION_TOLERANCE_RAD:
            self._conclude("")
        elif attempt.movements >= (self._settings.most_movements if feedback else 1):
            self._conclude(f"not reached in {attempt.movements} movements")
        elif attempt.as_healthy and self.belief.confirmed and not attempt.repeats:
            self._conclude("out of reach, tried once as if the arm were healthy")

    def _error_m(self, seen: Seen) -> float:
        if seen.point is None:
            return np.nan
        return float(np.linalg.norm(seen.point - self.target.point))

    def _error_rad(self, seen: Seen) -> float:
        """Return how far the tool is from its approach direction [rad].

        The tool sensor tells positions: directions are those of the most probable pose.
        """
        axis = self.target.axis
        if axis is None or seen.point is None:
            return 0.0 if axis is None else np.nan
        seen_axis = self._planner.whole.axis(self.arm.most_probable_pose(seen))
        return float(angle_between(seen_axis, axis))

    def _conclude(self, why: str) -> None:
        seen, attempt = self._seen, self._attempt
        error, turned = np.nan, np.nan
        if seen is not None and attempt.movements > 0:
            error, turned = self._error_m(seen), self._error_rad(seen)
        believed = self.belief.believed
        self.results.append(
            TargetResult(
                self.target,
                not why,
                error,
                turned,
                attempt.first_error_m,
                attempt.movements,
                attempt.reachable,
                "" if believed is None else str(believed.fault),
                why,
            )
        )
        if why:
            self._say(f"target {len(self.results)}: {why}")
        self._since_probe += 1
        self._attempt = _Attempt()

    # What to do next.

    def next(self) -> Order | None:
        """Return the next order; None: the task is over."""
        while not self.done:
            order = self._question()
            if order is None:
                order = self._begin() if self._plans_anew() else self._corrected()
            if order is not None:
                self._previous, self._command = self._command, order.target
                self._order = order
                return order
        return None

    def _plans_anew(self) -> bool:
        """Return whether the target is new, or is looked at with other eyes than before."""
        attempt, believed = self._attempt, self.belief.believed
        if attempt.movements == 0 or attempt.anew:
            attempt.anew = False
            return True
        before = attempt.planned_with
        if believed is None or before is None:
            return believed is not before and not attempt.as_healthy
        if believed.fault != before.fault:
            attempt.as_healthy = False
            return True
        if attempt.as_healthy or believed.reaction is not Reaction.LOCK:
            return False
        return abs(believed.angle - before.angle) > SMALLEST_NEWS_RAD

    def _question(self) -> Order | None:
        """Return a movement that asks what is wrong, while that is open; None: none is made."""
        judgement = self.judgement
        if not self._questions or judgement is None or self.belief.believed is not None:
            return None
        if judgement.probability(judgement.best) >= LEFT_OPEN:
            return None
        gate = self._planner.gate
        asked = judgement.posterior, self._command, len(self.results)
        order = next_movement(self.model, gate, *asked)
        if order is None:
            return None
        self._questions -= 1
        self._attempt.asks = True
        self._say(f"it is open what is wrong ({judgement.best} the most probable): asked")
        return order

    def _begin(self) -> Order | None:
        """Return the order that a new plan begins with; None where the target is given up."""
        attempt, at = self._attempt, self.standing()
        self._set_aside(at)
        attempt.planned_with, attempt.corrections = self.belief.believed, 0
        if attempt.planned_with is None:
            attempt.as_healthy = False
        plan = self._planner.plan(self.target, self.arm, at)
        attempt.reachable = plan.reachable
        if not plan.reachable and self.arm.locked.any():
            plan = self._out_of_reach(plan, at)
        if plan.order is None:
            self._conclude(f"no safe way: {plan.why}")
            return None
        if not plan.reachable:
            self._conclude(f"out of reach by {plan.misses}")
            return None
        attempt.pose = plan.pose
        if plan.unspared is not None:
            self.ways.append((np.stack([plan.pose, plan.unspared]), at))
        return self._probed(plan.order, at)

    def _set_aside(self, at: Standing) -> None:
        """Choose where to park a motor that sticks now and then, unless it is parked."""
        believed = self.belief.believed
        if believed is None or not believed.obeys or believed.set_aside:
            return
        if believed.reaction is not Reaction.PARK or self._attempt.as_healthy:
            return
        left = self._task.targets[len(self.results) :]
        stands = float(at.pose[believed.motor])
        place = parking_place(self._planner.gate, believed.motor, left, stands)
        reached = int(place.reached.sum())
        if reached:
            self.belief.stands_at(place.angle, 0.0)
            self._say(
                f"{place.motor} is parked at {np.rad2deg(place.angle):.0f} deg before it stops "
                f"elsewhere: {reached} of the next {len(place.points)} targets can be reached "
                "without it"
            )

    def _out_of_reach(self, plan: Plan, at: Standing) -> Plan:
        """Return what to do where the motor that rests keeps the tool from its target."""
        believed = self.belief.believed
        assert believed is not None
        if believed.reaction is Reaction.PARK:
            self.belief.stands_at(np.nan, 0.0)
            return self._planner.plan(self.target, self.arm, at)
        self._attempt.as_healthy = True
        other = self._planner.plan(self.target, self.arm, at)
        tried = "; tried as if it were not there" if other.reachable else ""
        self._say(
            f"target {len(self.results) + 1} is out of reach with {believed.fault}, "
            f"{plan.misses} at the nearest{tried}"
        )
        return other

    def _probed(self, order: Order, at: Standing) -> Order:
        """Return an order that also asks whether a motor that is held has been repaired."""
        if self._since_probe < self._settings.probe_every or not self._settings.feedback:
            return order
        command = self.arm.probing(order.target)
        if command is None:
            return order
        self._since_probe = 0
        probed, wrong = self._planner.checked(command, self.arm, at)
        return order if wrong else probed

    def _corrected(self) -> Order | None:
        """Return the next order for a target that was missed; None where it is given up."""
        seen, attempt = self._seen, self._attempt
        assert seen is not None and self._order is not None
        if attempt.repeats < self._settings.most_repeats:
            lost = [] if seen.point is None else self.arm.lost_command(seen)
            if lost or seen.point is None:
                attempt.repeats += 1
                names = ", ".join(self.model.motor_names[k] for k in lost)
                why = f"the command of {names} seems lost" if lost else "the tool was not seen"
                self._say(f"{why}: sent again")
                return self._again(lost)
        if seen.point is None:
            self._conclude("the tool is not seen at rest")
            return None
        parked = self._parked(seen)
        if parked is not None:
            return parked
        return self._fed_back(seen)

    def _again(self, lost: Sequence[int]) -> Order | None:
        """Return the last order once more, with the time that it needs from where it began.

        Motors that have lost it stand where they were told to be before.
        """
        assert self._order is not None
        self._command = self._command.copy()
        self._command[lost] = self._previous[lost]
        order, wrong = self._planner.checked(self._order.target, self.arm, self.standing())
        if wrong:
            self._conclude(f"no safe way: {wrong}")
            return None
        return replace(order, duration=np.maximum(order.duration, self._order.duration))

    def _parked(self, seen: Seen) -> Order | None:
        """Return the order that works round a motor that is at rest now; None: there is none."""
        believed = self.belief.believed
        if believed is None or believed.reaction is not Reaction.PARK or self._attempt.as_healthy:
            return None
        if believed.obeys:  # it was parked before, by its command
            return None
        arm = self.arm
        pose = arm.most_probable_pose(seen)
        angle = float(pose[believed.motor])
        self.belief.stands_at(angle, float(self.model.scatter[believed.motor]))
        at = Standing(pose, self._command, self._time_s)
        plan = self._planner.plan(self.target, self.arm, at)
        if not plan.reachable or plan.order is None:
            self.belief.stands_at(np.nan, 0.0)
            return None
        self._attempt.pose, self._attempt.reachable = plan.pose, True
        return plan.order

    def _fed_back(self, seen: Seen) -> Order | None:
        """Return the correction of what the tool misses, by the Jacobian of the believed arm."""
        attempt, arm = self._attempt, self.arm
        assert seen.point is not None
        first = attempt.corrections == 0
        attempt.corrections += 1
        taken_off = FIRST_GAIN if first else LATER_GAIN
        wrong = ""
        miss, turn = self.target.point - seen.point, self._turn(seen)
        then = arm.settle(seen.command, seen.previous, self._time_s + self._pace_s)
        slips = then - arm.settle(seen.command, seen.previous, seen.rest_s)
        gain = arm.gain(seen.command, seen.previous, seen.rest_s)
        for share in taken_off * 0.5 ** np.arange(HALVINGS + 1):
            step = self._step(arm, attempt.pose, share * miss, share * turn)
            command = np.clip(self._command + (step - slips) / gain, *arm.limits)
            command = arm.rounded(arm.with_rest(command, self._command))
            order, wrong = self._planner.checked(command, arm, self.standing())
            if not wrong:
                attempt.pose = attempt.pose + step
                return order
        self._conclude(f"no safe correction: {wrong}")
        return None

    def _turn(self, seen: Seen) -> FloatArray:
        """Return by how much the tool's axis must change, (3,); 0 where no direction is asked."""
        axis = self.target.axis
        if axis is None:
            return np.zeros(3)
        return np.asarray(axis - self._planner.whole.axis(self.arm.most_probable_pose(seen)))

    def _step(
        self, arm: BelievedArm, pose: FloatArray, miss: FloatArray, turn: FloatArray
    ) -> FloatArray:
        """Return the step from a pose that moves the tool and turns its axis, (motor,) [rad].

        The tool goes by `miss`, (3,) [m]; its axis changes by `turn`, (3,). The point comes first:
        what the motors cannot do of both is taken from the direction.
        """
        whole = self._planner.whole
        goal, start = whole.tool(pose[None])[0] + miss, pose[None]
        if self.target.axis is not None:
            axis = whole.axis(pose) + turn
            axis /= np.linalg.norm(axis)
            start = whole.solve(goal, start, arm.locked, axis[None]).pose[0]
        return np.asarray(whole.solve(goal, start, arm.locked).pose[0, 0] - pose)

    # What is told.

    def _tell_reaction(self) -> None:
        believed = self.belief.believed
        if believed is None:
            return
        self._say(believed.in_words(self.model.twin.robot))
        if not believed.rests:
            return
        left = self._task.targets[len(self.results) :]
        at, arm = self.standing(), self.arm
        near = [self._planner.plan(target, arm, at).reachable for target in left]
        self._say(f"{sum(near)} of {len(left)} targets left can be reached")
