"""Whether the processes of a machine are ready, from their health messages. Pure: time is an input."""

from collections.abc import Collection, Iterator, Mapping

NO_IMAGES = "no images"  # beginning of the status of a camera process without images
_SLOW_S = 10.0  # [s] after which the missing services are named
_COMPILE_S = 120.0  # [s] that a first start may take
_BLIND_S, _REMINDER_S = 5.0, 60.0  # [s] without images until the first report, and from there to the second one
_COMPILING = "the first start compiles the inner loops, which takes half a minute"
_FAILING = "their output above says why; `sextant doctor` checks what they need"


class Readiness:
    """Waits until each started service has reported its health; announces that once, or which services are missing."""

    def __init__(self, names: Collection[str], role: str, next_steps: str):
        """Wait for services.

        Args:
            names: Of the started services.
            role: Under which they report their health.
            next_steps: What the operator can do once they are ready.
        """
        self._keys = {name if role == "robot" else f"{name} ({role})": name for name in names}
        self._next_steps = next_steps
        self._begun_s = -1.0
        self._due_s = 0.0  # when the missing services are named
        self._is_ready = False

    def lines(self, reported: Collection[str], now_s: float) -> Iterator[str]:
        """Yield the lines that are due.

        Args:
            reported: Names of all services that have reported their health, with the role if it is not the robot's.
            now_s: [s] current time.
        """
        if self._is_ready:
            return
        if self._begun_s < 0.0:
            self._begun_s, self._due_s = now_s, now_s + _SLOW_S
        waited_s = now_s - self._begun_s
        missing = [name for key, name in self._keys.items() if key not in reported]
        if not missing:
            self._is_ready = True
            yield f"ready after {waited_s:.0f} s: {self._next_steps}"
        elif now_s >= self._due_s:
            self._due_s = now_s + 2.0 * waited_s  # less and less often
            hint = _COMPILING if waited_s < _COMPILE_S else _FAILING
            yield f"not ready after {waited_s:.0f} s: no health message of {', '.join(missing)} yet; {hint}"


class CameraReport:
    """Reports a camera that sends no images: soon, then less and less often; and once when images arrive."""

    def __init__(self) -> None:
        """Wait for the first health message of a camera process."""
        self._since_s = -1.0  # beginning of the time without images, negative with images
        self._due_s = 0.0
        self._is_told = False

    def lines(self, status: Mapping[str, str], now_s: float) -> Iterator[str]:
        """Yield the lines that are due.

        Args:
            status: Status text of each service.
            now_s: [s] current time.
        """
        why = status.get("camera", "")
        if not why.startswith(NO_IMAGES):
            if why and self._is_told:
                yield f"camera: images arrive after {now_s - self._since_s:.0f} s"
            self._since_s, self._is_told = -1.0, False
            return
        if self._since_s < 0.0:
            self._since_s, self._due_s = now_s, now_s + _BLIND_S
        if now_s >= self._due_s:
            self._due_s = now_s + max(_REMINDER_S, 2.0 * (now_s - self._since_s))
            hint = "" if self._is_told else "; the robot does not walk without images; `--camera none` starts without a camera"
            self._is_told = True
            yield f"camera: {why}{hint}"


def next_steps(names: Collection[str], simulated: bool, page: str, endpoint: str, namespace: str, options: str) -> str:
    """Return as text what an operator can do with a machine whose services are ready.

    Args:
        names: The started services.
        simulated: Whether the robot is simulated.
        page: Address of the operator's page; empty without one.
        endpoint: For other programs of this machine.
        namespace: Prefix of the keys.
        options: Options of `sextant` that connect to it; empty if they are the defaults.
    """
    if "actuator" not in names:
        served = f"; the operator's page is {page}" if page else ""
        return f"{', '.join(names)} run{served}"
    named = "" if namespace == "sextant" else f', namespace="{namespace}"'
    robot = "the simulated robot" if simulated else "the robot"
    ways = [
        *([f"hold the pad or click a goal on {page}"] if page else []),
        f"`sextant order stand{f' {options}' if options else ''}`",
        f'sextant.Client("{endpoint}"{named}) in Python (docs/api.md)',
    ]
    return f"{robot} takes commands: {', or '.join(ways)}"
