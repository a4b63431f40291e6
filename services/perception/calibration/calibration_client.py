"""Client of a robot that leads its calibration, computes the result, and publishes both for the operator's page."""

from collections.abc import Iterator

from sextant.services.perception.calibration.calibrated_robot import CalibratedRobot, CalibrationError, calibrate
from sextant.services.perception.calibration.survey import Survey
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import CalibrationState, Message, Tick

_STATE_NS = 500_000_000  # [ns] period of the state
_LAST = 15  # steps in which the result is repeated, because a message may be lost


class CalibrationClient:
    """Leads a robot through a survey and computes its calibration."""

    name = "calibration"
    subscribes = Survey.subscribes
    publishes = (*Survey.publishes, topics.CALIBRATION)

    def __init__(self, profile: RobotProfile, holder: str):
        """Prepare the motion.

        Args:
            profile: The robot.
            holder: Name under which this client leads.
        """
        self._profile, self._survey = profile, Survey(profile, holder)
        self.trigger, self.stages = self._survey.trigger, self._survey.stages
        self.finished = False
        self._failure = ""  # why nothing was computed
        self._robot: CalibratedRobot | None = None  # the result
        self._clock = RobotClockEstimate()
        self._computing = False
        self._state_due_ns, self._left = 0, _LAST

    def status(self) -> str:
        """Return the progress as text."""
        words = self._survey.status()
        return f"{words}; computing" if self._computing and self._survey.is_complete else words

    def result(self) -> CalibratedRobot:
        """Return the calibrated robot, once this client is finished.

        Raises:
            CalibrationError: The motion ended before all postures, or too few images are useful.
        """
        if self._robot is None:
            raise CalibrationError(self._failure)
        return self._robot

    def withdraw(self) -> tuple[Message, ...]:
        """Return the messages that end the motion before its end."""
        stopped = CalibrationState(self._clock(), False, "", *self._survey.progress, (), "stopped by the operator")
        return (*self._survey.withdraw(), stopped)

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Lead the robot; after the motion compute the result, and publish it."""
        now, legs = tick.stamp_ns, inbox.latest(topics.ACTUATOR_STATE)
        self._clock.see(now, None if legs is None else legs.stamp_ns)
        if self._robot is not None or self._failure:
            yield self._state()
            self._left -= 1
            self.finished = self._left <= 0
        elif self._computing:  # the state that says so is published
            self._compute()
        else:
            yield from self._survey.step(tick, inbox)
            self._computing = self._survey.finished
            if self._computing or now >= self._state_due_ns:
                self._state_due_ns = now + _STATE_NS
                yield self._state()

    def _compute(self) -> None:
        try:
            self._robot = calibrate(self._profile, self._survey)
        except CalibrationError as error:
            self._failure = str(error)
        self._computing = False

    def _state(self) -> CalibrationState:
        result: tuple[str, ...] = ()
        refusal = self._failure
        if self._robot is not None:
            result, refusal = tuple(self._robot.lines(self._profile)), "; ".join(self._robot.refusals)
        ended = bool(result or refusal)
        status = "measured" if ended else self.status()
        return CalibrationState(self._clock(), not ended, status, *self._survey.progress, result, refusal)
