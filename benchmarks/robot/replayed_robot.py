"""Play a recorded robot to a base station.

python -m benchmarks.robot.replayed_robot RECORDING ENDPOINT NAMESPACE AFTER_S

The process hosts the robot's router, and publishes the robot's recorded messages at their original times. It measures when
scans are acknowledged and when plans arrive. All times are on the clock of this process, which acts as the robot's clock; the
base station's clock is not used. Like a robot, it reports the plan that it walks. The base station made that plan for the same
step, so the planner continues as with an obedient robot. The last output is one line of JSON.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sextant.shared.recording.reader import Recording
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Message, ScanReceipt, StepPlan
from sextant.shared.wire.transport import Endpoints, Router, ZenohLink

_SAYS: tuple[AnyTopic, ...] = (  # what a robot sends over the radio, and its operator's requests
    topics.CAMERA_STATE,
    topics.ACTUATOR_STATE,
    topics.ODOMETRY,
    topics.BODY_POSE,
    topics.SCAN,
    topics.HEALTH,
    topics.GOAL,
    topics.VELOCITY,
    topics.MODE,
)
_LAST_S = 0.5  # [s] for messages in transit


@dataclass(frozen=True, slots=True)
class Heard:
    """Messages that one robot received; times [ms]."""

    scans: int  # number sent since the start of the measurement
    taken: int  # number acknowledged
    scan_p50: float  # from a depth frame to the acknowledgement of its scan
    scan_p99: float
    plans: int
    plan_p99: float  # age of a plan at its arrival
    pause_max: float  # longest time without a message of the planner, which publishes ten times a second
    late_p99: float  # delay of this process's own messages

    @classmethod
    def of(cls, line: str) -> "Heard":
        """Parse an output line."""
        return cls(**json.loads(line))


class Player:
    """Publishes and receives on a clock that starts with the recording."""

    def __init__(
        self,
        path: Path,
        clock: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[float], object] = time.sleep,
    ):
        """Read all messages to publish.

        Args:
            path: The recording.
            clock: Returns the time [ns].
            wait: Waits for some time [s].
        """
        self._clock, self._wait = clock, wait
        self._script = [
            (topic, message if topic is topics.ACTUATOR_STATE else _encoded(message, at_ns), message.stamp_ns, at_ns)
            for topic, message, at_ns in Recording(path).messages(_SAYS)
        ]
        self._walked: dict[int, int] = {}  # step -> stamp of its newest received plan
        self._receipts: list[tuple[int, int]] = []  # stamp of a scan, time of its acknowledgement [ns]
        self._plans: list[tuple[int, int]] = []  # stamp of a plan, time of its arrival
        self._words: list[int] = []  # times of the planner's status messages
        self._began_ns = 0

    def now_ns(self) -> int:
        """The robot's time [ns]."""
        return self._clock() - self._began_ns

    def hear(self, topic: AnyTopic, frame: bytes) -> None:
        """Record a received message."""
        at_ns = self.now_ns()
        if topic is topics.SCAN_RECEIPT:
            receipt, _ = codec.decode(frame, ScanReceipt, topic.max_bytes)
            self._receipts.append((receipt.stamp_ns, at_ns))
        elif topic is topics.STEP_PLAN:
            plan, _ = codec.decode(frame, StepPlan, topic.max_bytes)
            self._plans.append((plan.stamp_ns, at_ns))
            self._walked[plan.step] = plan.stamp_ns
        else:
            self._words.append(at_ns)

    def play(self, link: ZenohLink, after_s: float) -> Heard:
        """Publish everything, and return what was received.

        Messages before `after_s` [s] of the recording do not count.
        """
        for answer in (topics.SCAN_RECEIPT, topics.STEP_PLAN, topics.PLANNER_STATUS):
            link.subscribe(answer, self.hear)
        first_ns = self._script[0][3]
        self._began_ns = self._clock() - first_ns
        late, sent = [], []
        for topic, said, stamp_ns, at_ns in self._script:
            if (ahead_ns := at_ns - self.now_ns()) > 0:
                self._wait(ahead_ns * 1e-9)
            late.append(self.now_ns() - at_ns)
            link.send(topic, said if isinstance(said, bytes) else _encoded(self._obeying(said), at_ns))
            if topic is topics.SCAN:
                sent.append(stamp_ns)
        self._wait(_LAST_S)
        return self._heard(first_ns + round(after_s * 1e9), sent, late)

    def _obeying(self, message: Message) -> Message:
        """Return the state as if the base station's plan for that step were walked.

        Without such a plan, the step is over.
        """
        if not isinstance(message, ActuatorState) or not message.step:
            return message
        if message.step not in self._walked:
            return replace(message, phase=1.0, swing=np.zeros_like(message.swing))
        return replace(message, plan_ns=self._walked[message.step])

    def _heard(self, from_ns: int, sent: Sequence[int], late: Sequence[int]) -> Heard:
        scans = {stamp for stamp in sent if stamp >= from_ns}
        taken = {stamp: at for stamp, at in self._receipts if stamp in scans}
        ways = [at - stamp for stamp, at in taken.items()]
        plans = [(stamp, at) for stamp, at in self._plans if at >= from_ns]
        pauses = np.diff([from_ns, *(at for at in self._words if at >= from_ns)])
        return Heard(
            scans=len(scans),
            taken=len(taken),
            scan_p50=_ms(ways, 50),
            scan_p99=_ms(ways, 99),
            plans=len(plans),
            plan_p99=_ms([at - stamp for stamp, at in plans], 99),
            pause_max=_ms(pauses, 100),
            late_p99=_ms(late, 99),
        )


def _encoded(message: Message, at_ns: int) -> bytes:
    return codec.encode(message, codec.Timing(at_ns, at_ns))


def _ms(values: Sequence[int] | np.ndarray, percent: float) -> float:
    return round(float(np.percentile(values, percent)) * 1e-6, 1) if len(values) else float("inf")


def main() -> int:
    """Play the recording once the base station is connected."""
    path, endpoint, namespace, after_s = sys.argv[1:5]
    player = Player(Path(path))
    with Router((endpoint,)) as router, ZenohLink(Endpoints((endpoint,), namespace=namespace)) as link:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()  # wait for the start signal
        if not router.chained:
            sys.stderr.write("no base station has connected\n")
            return 1
        sys.stdout.write(json.dumps(asdict(player.play(link, float(after_s)))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
