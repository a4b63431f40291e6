"""OAK-D driver against a substitute of depthai 3, which has the calls and the errors of the library."""

import sys
from dataclasses import replace
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.cameras import oak
from sextant.services.perception.cameras.camera import CameraError
from sextant.services.perception.cameras.oak import Oak


class Output:
    """Output or input of a node; it keeps what it is linked to."""

    def __init__(self, lib: "Library", name: str):
        self.lib, self.name = lib, name

    def link(self, to: "Output") -> None:
        self.lib.links.append((self.name, to.name))

    def createOutputQueue(self, maxSize: int, blocking: bool) -> Any:
        assert not blocking
        self.lib.source = self.name
        return SimpleNamespace(tryGet=self.lib.try_get)


class Node:
    """Node of a pipeline; it has each input and output that is asked for."""

    def __init__(self, lib: "Library", kind: str):
        self.lib, self.kind = lib, kind
        self.inputs = {name: Output(lib, f"{kind}.{name}") for name in ("rgb", "depth")}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set"):
            return lambda *values: self.lib.settings.append((name, *values))
        return Output(self.lib, f"{self.kind}.{name}")

    def build(self, socket: str) -> "Node":
        self.kind = socket
        return self

    def requestOutput(self, size: tuple[int, int], kind: str = "", **options: Any) -> Output:
        self.lib.requested[self.kind] = (size, kind, options)
        return Output(self.lib, self.kind)


class Picture:
    """Depth or colour image of the camera."""

    def __init__(self, data: Any, at_ms: float = 0.0, matrix: Any = None):
        self.data, self.at_ms, self.matrix = data, at_ms, matrix

    def getFrame(self) -> Any:
        return self.data

    getCvFrame = getFrame

    def getTimestampDevice(self) -> timedelta:
        return timedelta(milliseconds=self.at_ms)

    def getTransformation(self) -> Any:
        return SimpleNamespace(getIntrinsicMatrix=lambda: self.matrix)


class QueueError(Exception):
    """The library's error is no RuntimeError."""


class Library:
    """The part of depthai that the driver uses."""

    __version__ = "3.12.0"
    node = SimpleNamespace(**{name: name for name in ("Camera", "StereoDepth", "Sync", "ImageAlign")})
    CameraBoardSocket = SimpleNamespace(CAM_A="colour", CAM_B="left", CAM_C="right")
    ImgFrame = SimpleNamespace(Type=SimpleNamespace(RGB888i="RGB888i"))
    Platform = SimpleNamespace(RVC2="RVC2", RVC4="RVC4")
    MessageQueue = SimpleNamespace(QueueException=QueueError)

    def __init__(self, i: Any):
        self.present, self.running, self.platform = True, False, "RVC2"
        self.matrix: Any = [[i.fx, 0.0, i.cx], [0.0, i.fy, i.cy], [0.0, 0.0, 1.0]]
        self.messages: list[Any] = []
        self.links: list[tuple[str, str]] = []
        self.settings: list[tuple[Any, ...]] = []
        self.requested: dict[str, Any] = {}
        self.source, self.acts, self.error = "", [], ""  # type: ignore[var-annotated]

    def try_get(self) -> Any:
        if self.error:
            raise QueueError(self.error)
        return self.messages.pop(0) if self.messages else None

    def depth(self, data: Any, at_ms: float = 0.0) -> Picture:
        return Picture(data, at_ms, self.matrix)

    class _Device:
        lib: "Library"

        def __init__(self) -> None:
            if not self.lib.present:
                raise RuntimeError("No available devices")

        @classmethod
        def getAllAvailableDevices(cls) -> list[Any]:
            return [SimpleNamespace(deviceId="1844")] if cls.lib.present else []

        getDeviceName = staticmethod(lambda: "OAK-D-LITE")
        getDeviceId = staticmethod(lambda: "1844")
        getUsbSpeed = staticmethod(lambda: SimpleNamespace(name="SUPER"))

        def getPlatform(self) -> str:
            return self.lib.platform

        def close(self) -> None:
            self.lib.acts.append("close")

    @property
    def Device(self) -> Any:
        return type("Device", (self._Device,), {"lib": self})

    def Pipeline(self, device: Any) -> Any:
        def start() -> None:
            self.acts.append("start")
            self.running = True

        return SimpleNamespace(
            create=lambda kind: Node(self, kind),
            start=start,
            stop=lambda: self.acts.append("stop"),
            isRunning=lambda: self.running,
        )


@pytest.fixture
def lib(kit, monkeypatch: pytest.MonkeyPatch) -> Library:  # type: ignore[no-untyped-def]
    made = Library(kit.profile.camera.intrinsics)
    monkeypatch.setitem(sys.modules, "depthai", made)
    return made


def test_images_have_host_stamps_and_are_the_newest(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    with Oak(kit.profile.camera, kit.clock) as camera:
        assert camera.description == "OAK-D-LITE, no. 1844, USB super"
        assert lib.links == [("left", "StereoDepth.left"), ("right", "StereoDepth.right")]
        assert lib.requested["left"] == ((64, 48), "", {"fps": 30.0})
        assert lib.source == "StereoDepth.depth"
        assert camera.read(False) is None
        lib.messages = [lib.depth(kit.ground(1), 9000.0)]
        first = camera.read(True)
        kit.clock.pass_s(0.080)
        lib.messages = [lib.depth(kit.ground(2), 9033.0), lib.depth(kit.ground(3), 9066.0)]
        newest = camera.read(False)
        assert first is not None
        assert newest is not None
        assert first.rgb is None, "the profile has no colour"
        assert newest.stamp_ns - first.stamp_ns == 66_000_000
        np.testing.assert_array_equal(newest.depth, kit.ground(3))
    assert lib.acts == ["start", "stop", "close"]
    camera.close()


@pytest.mark.parametrize("platform", ["RVC2", "RVC4"])
def test_depth_is_aligned_to_colour_of_the_same_instant(kit, lib: Library, platform: str) -> None:  # type: ignore[no-untyped-def]
    lib.platform = platform
    camera = Oak(replace(kit.profile.camera, color=True), kit.clock)
    assert lib.requested["colour"] == ((64, 48), "RGB888i", {"fps": 30.0, "enableUndistortion": True})
    aligner = "StereoDepth" if platform == "RVC2" else "ImageAlign"
    assert ("colour", f"{aligner}.inputAlignTo") in lib.links
    assert lib.source == "Sync.out"
    rgb = np.full((48, 64, 3), (1, 2, 3), np.uint8)
    group = {"depth": lib.depth(kit.ground(1)), "rgb": Picture(rgb)}
    lib.messages = [group]
    frame = camera.read(True)
    lib.messages = [group]
    bare = camera.read(False)
    assert frame is not None
    assert bare is not None
    np.testing.assert_array_equal(frame.rgb, rgb)
    assert bare.rgb is None, "none was wanted"


def test_missing_or_old_library_is_reported_with_remedy(kit, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    old = SimpleNamespace(__version__="2.30", node=SimpleNamespace(MonoCamera=None))
    for library, words in ((None, "depthai cannot be imported"), (old, "depthai 3 expected, found 2.30")):
        monkeypatch.setitem(sys.modules, "depthai", library)
        for act in (lambda: Oak(kit.profile.camera, kit.clock), oak.find):
            with pytest.raises(CameraError, match=rf"{words}.*\.\[oak\]"):
                act()


def test_absent_device_is_reported(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    assert oak.find() == ["OAK-D, no. 1844"]
    lib.present = False
    with pytest.raises(CameraError, match=r"No available devices; plug it into a USB 3 port.*udev"):
        Oak(kit.profile.camera, kit.clock)
    assert oak.find() == []


@pytest.mark.parametrize("how", ["closed queue", "stopped pipeline"])
def test_unplugged_device_is_reported_and_closed_without_error(  # type: ignore[no-untyped-def]
    kit, lib: Library, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    camera = Oak(kit.profile.camera, kit.clock)
    lib.error, lib.running = "MessageQueue was closed", how == "closed queue"
    with pytest.raises(CameraError, match=r"OAK-D-LITE.*(MessageQueue was closed|interrupted).*plug it into"):
        camera.read(False)

    def unplugged(_: object) -> None:
        raise RuntimeError("X_LINK_ERROR")

    monkeypatch.setattr(Library._Device, "close", unplugged)
    camera.close()


def test_camera_that_does_not_fit_the_profile_is_refused(kit, lib: Library) -> None:  # type: ignore[no-untyped-def]
    camera = Oak(kit.profile.camera, kit.clock)
    lib.matrix = [[70.0, 0.0, 31.5], [0.0, 58.5, 23.5], [0.0, 0.0, 1.0]]
    lib.messages = [lib.depth(kit.ground(1))]
    with pytest.raises(CameraError, match=r"fx 58\.5.*expected.*fx 70\.0"):
        camera.read(False)
    wrong = replace(kit.profile.camera, sensor=replace(kit.profile.camera.sensor, depth_scale=10000.0))
    with pytest.raises(CameraError, match=r"10000 units per metre expected.*found 1000"):
        Oak(wrong, kit.clock)


@pytest.mark.parametrize(
    ("data", "matrix", "reason"),
    [
        (np.zeros((48, 64), np.uint8), None, r"depth of uint16 \(48, 64\) expected, found uint8"),
        (np.zeros((48, 64, 3), np.uint16), None, r"found uint16 \(48, 64, 3\)"),
        (np.zeros((24, 32), np.uint16), None, r"found uint16 \(24, 32\)"),
        (np.zeros((48, 64), np.uint16), np.zeros((3, 3)), "reports invalid intrinsics"),
        (np.zeros((48, 64), np.uint16), np.full((3, 3), np.nan), "reports invalid intrinsics"),
    ],
)
def test_garbage_of_the_device_is_refused(kit, lib: Library, data: Any, matrix: Any, reason: str) -> None:  # type: ignore[no-untyped-def]
    camera = Oak(kit.profile.camera, kit.clock)
    lib.matrix = lib.matrix if matrix is None else matrix
    lib.messages = [lib.depth(data)]
    with pytest.raises(CameraError, match=reason):
        camera.read(False)
