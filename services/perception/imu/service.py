"""IMU service: publish the readings of a sensor that is not part of the camera."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Protocol, Self

from sextant.services.perception.imu.bno import MODELS, Bno
from sextant.services.perception.imu.config import Settings
from sextant.services.perception.imu.reading import BodyImu, ImuError, ImuReading
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, Tick

RATE_HZ = 100.0
_FIRST_RETRY_S, _LAST_RETRY_S = 1.0, 16.0  # [s] shortest and longest interval between two attempts to open the sensor
_RELIABLE_NS = 10_000_000_000  # [ns] of readings after which the retry interval is reset
_LOST_NS = 500_000_000  # [ns] of failed readings after which the sensor is opened again
_HUNG_NS = 30_000_000_000  # [ns] in one call, after which the library is considered hung: opening may take 25 s
_MAX_READINGS = 100  # readings that wait to be published: one second


class Sensor(Protocol):
    """Open IMU."""

    description: str

    def read(self) -> tuple[Array, Array]:
        """Return angular rate (3,) [rad/s] and specific force (3,) [m/s^2]; raise ImuError if it does not answer."""
        ...

    def close(self) -> None:
        """Release the device; safe to call twice."""
        ...


class ImuService:
    """IMU service that reads the sensor in a separate thread.

    Without `with`, no thread is started and the service reads in its own steps, for simulated time.
    """

    name = "imu"
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.IMU,)

    def __init__(
        self, profile: RobotProfile, settings: Settings, opener: Callable[[], Sensor] | None, clock: Callable[[], int]
    ):
        """Create the service without an open sensor; a missing one is only reported.

        Args:
            profile: Profile of the robot with its IMU.
            settings: Settings of this service.
            opener: Opens a sensor instead of that of the profile.
            clock: [ns] clock that stamps the readings.

        Raises:
            ValueError: The profile names no IMU that this service reads.
        """
        imu = profile.imu
        if imu.device not in MODELS:
            raise ValueError(
                f"[imu] device = {' or '.join(MODELS)} expected in the profile {profile.name}, found {imu.device!r}"
            )
        self.trigger = Every.hz(RATE_HZ)
        self.stages = Stages()
        self._opener: Callable[[], Sensor] = opener or (lambda: Bno(imu, settings.port))
        self._clock = clock
        self._name = f"{imu.device} on {settings.port or imu.port}"
        self._imu = BodyImu(imu.R_body_imu)
        self._sensor: Sensor | None = None
        self._openings = 0
        self._trouble = f"{self._name} has sent no reading yet"
        self._retry_s, self._retry_ns = _FIRST_RETRY_S, clock()
        self._good_since_ns = self._good_ns = -1  # first and last reading without a failure
        self._readings: deque[ImuReading] = deque(maxlen=_MAX_READINGS)
        self._called_ns = -1  # start of the thread's current call, or -1
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        """Start reading in a thread, because opening takes seconds."""
        self._thread = threading.Thread(target=self._read_on, name="imu", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)  # a hung library is not waited for

    def status(self) -> str:
        """Return the status: the sensor and the message count, or why there are no messages."""
        called_ns = self._called_ns
        if called_ns >= 0 and self._clock() - called_ns > _HUNG_NS:
            hung_s = (self._clock() - called_ns) * 1e-9
            return f"no readings: {self._name} has not answered for {hung_s:.0f} s; check its cable, and restart this process"
        trouble = self._trouble or self._imu.problem
        if trouble:
            return f"no readings: {trouble}; opened {self._openings} times so far"
        return f"{self._name}, {self._imu.messages} IMU messages"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Publish the new readings."""
        if self._error is not None:
            raise self._error
        if self._thread is None:
            self._read()
        yield from self._imu.update([self._readings.popleft() for _ in range(len(self._readings))])

    def _read(self) -> None:
        """Take one reading, or open the sensor if that is due."""
        if self._sensor is None:
            self._open()
            return
        try:
            rate, force = self._sensor.read()
        except ImuError as error:
            if self._clock() - self._good_ns > _LOST_NS:  # single failures occur on an I2C bus
                self._lose(str(error))
            return
        now_ns = self._clock()
        self._trouble, self._good_ns = "", now_ns
        if now_ns - self._good_since_ns > _RELIABLE_NS:
            self._retry_s = _FIRST_RETRY_S
        self._readings.append(ImuReading(now_ns, rate, force))

    def _open(self) -> None:
        if self._clock() < self._retry_ns:
            return
        self._openings += 1
        try:
            self._sensor = self._opener()
        except ImuError as error:
            self._lose(str(error))
            return
        self._good_since_ns = self._good_ns = self._clock()

    def _lose(self, trouble: str) -> None:
        """Close the sensor, report the fault, and retry later."""
        self._trouble = trouble
        if self._sensor is not None:
            self._sensor.close()
            self._sensor = None
        self._retry_ns = self._clock() + round(self._retry_s * 1e9)
        self._retry_s = min(2 * self._retry_s, _LAST_RETRY_S)

    def _read_on(self) -> None:
        """Read the sensor until stopped; runs in the thread."""
        try:
            while not self._stop.is_set():
                self._called_ns = self._clock()
                self._read()
                spent_s = (self._clock() - self._called_ns) * 1e-9
                self._called_ns = -1
                self._stop.wait(max(0.001, 1.0 / RATE_HZ - spent_s))
            if self._sensor is not None:
                self._sensor.close()
        except Exception as error:  # noqa: BLE001 - it is raised again by step, where it ends the process
            self._error = error
