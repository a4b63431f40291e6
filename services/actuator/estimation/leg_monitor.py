"""Which leg lies: monitors of a walk whose findings name a servo or a leg, and decide whether to walk slower or to stop.

    registers   goal, position and load of one reading contradict each other, see `GoalCheck`. The robot stops while they do.
                The second time it stops until torque is off.
    weakness    a servo shows its full torque and stays behind its goal. The robot walks slower, and stops at the second time.
    slips       standing feet move against each other as if a horn had slipped, see `stance_fit`. The robot walks slower, and
                stops if two stances of the same legs show a large slip: a foot that slid shows it once.
    deviations  standing feet have always moved against each other as if a horn were off. The robot says so.

A horn that slips and an encoder that jumps or drifts are the same to the robot: link and encoder differ. Three standing feet
have only three distances, so several joints explain them about as well; a servo or a leg is named only if it is the only one.
"""

import math
from collections.abc import Sequence

from sextant.services.actuator.estimation.goal_check import GoalCheck
from sextant.services.actuator.estimation.stance_fit import JointOffsets, Slip, Stance, largest_change, measure_stance
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.servo.servo_model import Feedback

_SETTLE_CYCLES = 3  # after lift-off, in which the other legs take up the load
_STANCE_CYCLES = 10  # shortest stance that is evaluated
_LOOK_CYCLES = 5  # between two evaluations of a stance
_LOOK_M = 0.008  # [m] change of a distance from which a stance is evaluated before its end
# Squared Mahalanobis distance per pair of feet. At the end of a stance, robots that match their profile had 1.2 at most, those
# with `usual` deviations 2 and with `harsh` ones 5, but for feet that slid by 2 to 12 cm: 66.
_UNUSUAL = 4.0  # nothing is learned from such a stance
_SURE = 9.0  # in two stances of the same legs in a row
_SURE_AT_ONCE = 12.0  # in one stance
_LEFT = 4.0  # most that a slip may leave unexplained
_LEFT_AT_ONCE = 0.1  # [1] the same as a share, in one stance
# Twice the logarithm of the likelihood ratio that rules out an explanation, a leg, or a joint of the leg
_EXCLUDED, _OTHER_LEG, _OTHER_JOINT = 7.0, 10.0, 6.0
_SLIP_RAD = math.radians(10.0)  # a smaller slip never stops the robot
_LARGEST_RAD = math.radians(40.0)  # from which the feet slide
# A deviation from the profile that lasts: limits above what robots that match their profile show.
_LASTING_PAIRS = 18  # from which a deviation is named
_LASTING_OTHER = 20.0  # twice the logarithm of the likelihood ratio that rules out another leg, or another joint of the leg
_LASTING_RAD, _LASTING_EXPLAINS = math.radians(2.0), 36.0  # of one joint, from which it is named
_RESTATED_RAD = math.radians(1.0)  # change of its size from which it is stated again
_ONE_LEAVES = 2.0  # most for a pair that one joint may leave unexplained
_UNMATCHED = 3.0  # for a pair, from which several joints are off; robots that match had 2.3 at most, on a slope of 10 deg
_PREDICTED = 0.6  # [1] largest unpredicted share: what earlier stances do not predict are feet that slide, not horns
_FIRST_PAIRS = 90  # of usual stances, half a minute, in which a servo with a wrong sign or id may go unnoticed
_SLOWER = 0.6  # [1] share of the nominal speed
_REMEMBERED_STANCES = 6  # for which a lie, a slip or a weakness is remembered; a weak leg hangs, so these stances prove nothing
_MISTAKEN = "or a servo of any leg turns the wrong way or has another one's id: run `sextant servos test`"
_CALIBRATE = "run `sextant camera calibrate`, which measures all horns"
_MEASURE = "compare the lengths in [links] with the robot"


class LegMonitor:
    """Findings about lying legs. Reasons to stop last until torque is off (`forget`), warnings for some stances."""

    def __init__(self, profile: RobotProfile):
        """Begin without findings."""
        self._profile = profile
        self.offsets = JointOffsets()  # what the stances show
        self.deviation = ""  # how the legs differ from the profile, which does not make the robot slower
        self._deviates_rad = 0.0  # size that it states
        self.goals = GoalCheck(profile)
        self.forget()

    def forget(self) -> None:
        """Discard all findings; what was learned stays, so a slip that was not mended is found again."""
        self._lie = self._fault = ""  # why the robot must not walk: at present, and until torque is off
        self._slip = self._weak = ""  # why it walks slower
        self._liar, self._liar_for = -1, 0  # servo that has lied, and stances for which that is remembered
        self._slip_for = self._weak_for = 0  # the same for a slip and for a weak servo
        self._slip_leg = -1
        self._stances = 0
        self._unusual: dict[
            tuple[int, ...], tuple[int, Stance]
        ] = {}  # by legs, their last stance if it was unusual, and its number
        self.goals.forget()
        self.pause()

    @property
    def stop(self) -> str:
        """Why the robot must not walk, or an empty string."""
        return self._fault or self._lie

    @property
    def warning(self) -> str:
        """Why the robot walks slower, or an empty string."""
        return self._weak or self._slip

    @property
    def pace(self) -> float:
        """Share of the nominal speed that the findings allow."""
        return _SLOWER if self.warning else 1.0

    @property
    def sure_offsets(self) -> Array | None:
        """Offsets (18,) [rad] by which links are ahead of their encoders; None if unconfirmed, or while anything is odd."""
        doubted = self.stop or self.warning or self._unusual or not self._legs_differ
        return None if doubted else self.offsets.mean

    @property
    def _legs_differ(self) -> bool:
        """Whether the legs differ from the profile, as earlier stances predict."""
        offsets = self.offsets
        differ = offsets.pairs >= _LASTING_PAIRS and offsets.moved >= _UNMATCHED * offsets.pairs
        return differ and offsets.unpredicted <= _PREDICTED * offsets.moved

    def pause(self) -> None:
        """End the stance: the robot does not walk."""
        self._swing: tuple[int, list[bool]] | None = None
        self._cycles = 0
        self._first: Array | None = None  # (6, 3) [rad] joint angles at its begin; None once it has been evaluated

    def check_goals(self) -> None:
        """Stop while a servo's registers contradict each other; walk slower if a servo is weak, and stop at the second time."""
        found = self.goals.found
        if found is None:
            self._lie = ""
        elif not self._lie:
            self._lie = f"{self._servo(found[0])} {found[1]}"
            if found[0] == self._liar and self._liar_for:
                self._fault = self._fault or self._lie
            self._liar, self._liar_for = found[0], _REMEMBERED_STANCES
        for index in self.goals.take_weak():
            if self._unusual and not self._weak_for:  # another leg may hold it
                continue
            measures = Feedback.LOAD in self._profile.servo_model.feedback
            shows = "shows its full torque and" if measures else "has no torque, or not enough: it"
            words = f"{self._servo(index)} {shows} stays behind its goal: it is weak, or something holds it"
            if not self._weak:
                self._weak = f"{words}; walking slower"
            elif self._weak.startswith(words) and self._weak_for < _REMEMBERED_STANCES - 1:  # not while it is held once
                self._fault = self._fault or words
            self._weak_for = _REMEMBERED_STANCES

    def watch(self, step: int, swing: list[bool], flying: list[bool], lands: bool, q: Array) -> None:
        """Take in one cycle of a walk.

        Args:
            step: Number of the running step.
            swing: (6,) legs that it swings.
            flying: (6,) those of them in the air.
            lands: Whether one of them takes up load.
            q: (6, 3) [rad] measured joint angles.
        """
        if True not in flying:
            self._swing = None
            return
        if self._swing != (step, swing):
            self.pause()
            self._swing = step, swing
        self._cycles += 1
        first, standing = self._first, [leg for leg, swings in enumerate(swing) if not swings]
        if self._cycles <= _SETTLE_CYCLES:
            self._first = self._last = q
        elif first is None or len(standing) < 3:
            return
        elif flying != swing or lands:  # a foot lands, and changes how the body moves
            self._first = None
            if self._cycles > _STANCE_CYCLES:
                self._add(measure_stance(self._profile, first, self._last, standing))
        else:
            self._last = q
            looks = self._cycles > _STANCE_CYCLES and self._cycles % _LOOK_CYCLES == 0
            if looks and largest_change(self._profile, first, q, standing) >= _LOOK_M:
                self._judge(measure_stance(self._profile, first, q, standing))

    def _add(self, stance: Stance) -> None:
        """Learn from a stance, or look for the joint whose slip explains it."""
        self._stances += 1
        self._unusual = {k: v for k, v in self._unusual.items() if self._stances - v[0] <= _REMEMBERED_STANCES}
        self._liar_for = max(self._liar_for - 1, 0)
        self._slip_for = max(self._slip_for - 1, 0)
        self._slip = self._slip if self._slip_for else ""
        if self._weak_for:
            self._weak_for -= 1
            self._weak = self._weak if self._weak_for else ""
        elif self._judge(stance):
            self._unusual[stance.legs] = self._stances, stance
        else:
            self.offsets.learn(stance)
            self._judge_deviation()
            self._unusual.pop(stance.legs, None)

    def _judge(self, stance: Stance) -> bool:
        """Stop or walk slower if a slip explains a stance, or it and the one before; return whether it is unusual."""
        offsets, pairs, (_, before) = self.offsets, len(stance.moved), self._unusual.get(stance.legs, (0, None))
        alone = offsets.surprise([stance])
        if alone < _UNUSUAL * pairs:
            return False
        if self.stop or self._weak_for:
            return True
        if alone >= _SURE_AT_ONCE * pairs:
            self._find(offsets.explain([stance]), min(_LEFT * pairs, _LEFT_AT_ONCE * alone), at_once=True)
        if before is not None and offsets.surprise([before, stance]) >= _SURE * pairs:
            self._find(offsets.explain([before, stance]), _LEFT * pairs, at_once=False)
        return True

    def _find(self, slips: Sequence[Slip], most_left: float, at_once: bool) -> None:
        """Walk slower for a slip, and stop for a large one that two stances show: feet that slide once show it in one."""
        best, likely = slips[0], [slip for slip in slips if slip.cost < slips[0].cost + _EXCLUDED]
        if self.stop or best.left > most_left or abs(best.size) >= _LARGEST_RAD:
            return
        size = min(abs(slip.size) for slip in likely) if at_once else abs(best.size)
        if size >= _SLIP_RAD and not at_once:
            self._fault = self._slipped(slips)
        elif size >= _SLIP_RAD or not at_once:
            if not (at_once and self._slip and self._slip_leg == best.joint // 3):
                self._slip, self._slip_leg = f"{self._slipped(slips)}; walking slower", best.joint // 3
            self._slip_for = _REMEMBERED_STANCES

    def _judge_deviation(self) -> None:
        """State how the legs differ from the profile."""
        offsets, slips = self.offsets, self.offsets.lasting()
        best, pairs = slips[0], offsets.pairs
        if pairs < _LASTING_PAIRS:
            return
        noise = max(1.0, offsets.unpredicted / pairs)
        if best.left > min(noise, _ONE_LEAVES) * pairs:
            self.deviation = (
                f"horns or links of several legs differ from the profile: {_MEASURE}; {_CALIBRATE}" if self._legs_differ else ""
            )
            return
        if offsets.moved - best.left < _LASTING_EXPLAINS * noise or abs(best.size) < _LASTING_RAD:
            self.deviation = ""
            return
        where, other = self.deviation.partition(" is off by ")[0], _LASTING_OTHER * noise
        named = self._named(slips, f"is off by about {abs(math.degrees(best.size)):.0f} deg", other, other)
        if named.partition(" is off by ")[0] != where or abs(best.size - self._deviates_rad) > _RESTATED_RAD:
            self.deviation, self._deviates_rad = f"{named}: {_CALIBRATE}", best.size

    def _slipped(self, slips: Sequence[Slip]) -> str:
        """Return which horn has slipped; in a robot's first steps, servos may also be assembled or named wrongly."""
        size = abs(slips[0].size)
        words = self._named(slips, f"has slipped by about {math.degrees(size):.0f} deg, an encoder is off, or the foot slides")
        is_new = size >= _SLIP_RAD and self.offsets.pairs < _FIRST_PAIRS
        return f"{words}, {_MISTAKEN}" if is_new else words

    def _named(
        self, slips: Sequence[Slip], words: str, other_leg: float = _OTHER_LEG, other_joint: float = _OTHER_JOINT
    ) -> str:
        """Return which horn does what `words` say, as precisely as several slips that explain the same allow."""
        best = slips[0]
        legs = list(dict.fromkeys(slip.joint // 3 for slip in slips if slip.cost < best.cost + other_leg))
        joints = {slip.joint for slip in slips if slip.joint // 3 == legs[0] and slip.cost < best.cost + other_joint}
        if len(legs) == len(joints) == 1:
            return f"{self._servo(best.joint)}: its horn {words}"
        return f"{' or '.join(LEGS[leg] for leg in legs)} leg: a horn {words}"

    def _servo(self, index: int) -> str:
        leg, joint = divmod(index, 3)
        return f"the {JOINTS[joint]} servo of the {LEGS[leg]} leg (id {self._profile.servo_ids[leg, joint]})"
