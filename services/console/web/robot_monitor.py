"""Monitor of the robot's services, camera and computer."""

from collections.abc import Mapping
from typing import Any

from sextant.services.console.web import view
from sextant.shared.recording.event_log import EventLog
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.lateness import SlowComputer
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import CameraState, Health, PassagePlan

_PERIOD_NS = 240_000_000  # [ns] period of camera state, calibration, passage plans and service health
_CALIBRATION_S = 60.0  # [s] after which a calibration that says nothing has ended; it computes for some ten seconds


class RobotMonitor:
    """Reads messages that arrive rarely, and writes their changes to the event log."""

    def __init__(self, event_log: EventLog):
        """Start without messages."""
        self._event_log = event_log
        self._health = HealthTable()
        self._computer = SlowComputer(computer="the robot's computer")
        self._due_ns = 0
        self.camera: CameraState | None = None
        self.calibration: dict[str, Any] | None = None  # the newest, as pages receive it
        self.too_slow = ""  # warning that the robot's computer is too slow, "" if it is not

    @property
    def services(self) -> Mapping[str, tuple[Health, int]]:
        """Return service name -> newest health and its arrival time [ns]."""
        return self._health.named()

    def roles(self, now_ns: int) -> frozenset[str]:
        """Return the roles whose services are running."""
        return self._health.roles(now_ns)

    def update(self, now_ns: int, inbox: Inbox) -> list[PassagePlan]:
        """Process new messages if the period is over; return the new passage plans."""
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + _PERIOD_NS
        self._health.drain(inbox, now_ns)
        services = self.services
        self._event_log.services(now_ns, services)
        self._computer.linked = any(health.robot_clock_offset_s for health, _ in services.values())
        self._computer.update(services)
        self.too_slow = self._computer.words(now_ns)
        self._event_log.computer(now_ns, self.too_slow)
        self.camera = inbox.latest(topics.CAMERA_STATE)
        self._event_log.camera(now_ns, self.camera)
        if (newest := inbox.latest(topics.CALIBRATION)) is not None:
            self.calibration = view.calibration(newest, inbox.fresh(topics.CALIBRATION, _CALIBRATION_S) is None)
            self._event_log.calibration(now_ns, self.calibration["running"], self.calibration["refusal"])
        plans = inbox.drain(topics.PASSAGE_PLAN)
        for plan in plans:
            self._event_log.passage(now_ns, plan)
        return plans
