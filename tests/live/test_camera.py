"""The robot's own services, with emulated servos and a recorded folder as camera."""

import time
from pathlib import Path

import numpy as np
import pytest

from sextant.services.perception import tum
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.motors import AX_12A_MOTOR
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.servo.models import AX_12A
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import CameraState, DepthImage, ExternalDepth, Health
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink
from tests.support.commands import Command

pytestmark = pytest.mark.live
PROFILE = load_profile("phantomx_mk2")


def record(folder: Path) -> None:
    """Record a few pictures of level ground, with noise."""
    camera, rng = PROFILE.camera, np.random.default_rng(0)
    rows = np.linspace(2000.0, 600.0, camera.intrinsics.height)[:, None]
    with tum.RecordingWriter(folder, tum.Camera(camera.intrinsics, 1000.0, 30.0, None)) as writer:
        for k in range(4):
            noise = rng.normal(0, 3, (camera.intrinsics.height, camera.intrinsics.width))
            writer.add(1_000_000_000 + 33_333_000 * k, np.rint(rows + noise).astype(np.uint16))


def test_frames_of_another_program_become_the_images_of_the_robot(tmp_path: Path) -> None:
    endpoint, i = f"tcp/127.0.0.1:{free_port()}", PROFILE.camera.intrinsics
    ids = PROFILE.servo_ids.ravel().tolist()
    heard: list[bytes] = []
    rng, rows = np.random.default_rng(0), np.linspace(2000.0, 600.0, i.height)[:, None]
    with TcpBusServer(ServoBusEmulator(ServoBank(ids, AX_12A, AX_12A_MOTOR))) as servos:
        words = ("--camera", "external", "--set", f"actuator.port={servos.url}", "--listen", endpoint)
        with Command("up", "onboard", *words, cwd=tmp_path) as up:
            up.wait_for(lambda: "starting" in up.text(), "the router")
            with ZenohLink(Endpoints((endpoint,))) as link:
                link.subscribe(topics.DEPTH, lambda _topic, frame: heard.append(frame))

                def published() -> bool:
                    depth = np.rint(rows + rng.normal(0, 3, (i.height, i.width))).astype(np.uint16)
                    frame = ExternalDepth(time.monotonic_ns(), depth, 1000.0, i.fx, i.fy, i.cx, i.cy)
                    link.send(topics.EXTERNAL_DEPTH, codec.encode(frame))
                    return len(heard) > 5

                up.wait_for(published, "images")
            up.interrupt()
            assert up.status() == 130
    image = codec.decode(heard[-1], DepthImage)[0]
    assert abs(float(image.depth.mean()) - 1300.0) < 5.0


def test_onboard_services_publish_images_and_report_missing_camera(tmp_path: Path) -> None:
    folder, endpoint = tmp_path / "ground", f"tcp/127.0.0.1:{free_port()}"
    record(folder)
    ids = PROFILE.servo_ids.ravel().tolist()
    heard: dict[str, list[bytes]] = {"depth": [], "state": [], "health": []}

    def states() -> list[CameraState]:
        return [codec.decode(frame, CameraState)[0] for frame in heard["state"]]

    def doing() -> set[str]:
        health = (codec.decode(frame, Health)[0] for frame in heard["health"])
        return {m.status for m in health if m.service == "camera"}

    with TcpBusServer(ServoBusEmulator(ServoBank(ids, AX_12A, AX_12A_MOTOR))) as servos:
        words = ("--camera", str(folder), "--set", f"actuator.port={servos.url}", "--listen", endpoint)
        with Command("up", "onboard", *words, cwd=tmp_path) as up:
            up.wait_for(lambda: "starting" in up.text(), "the router")
            assert "starting actuator, stop, camera, perception" in up.text()
            with ZenohLink(Endpoints((endpoint,))) as link:

                def hear(kind: str, topic: AnyTopic) -> None:
                    link.subscribe(topic, lambda _topic, frame: heard[kind].append(frame))

                for kind, topic in (("depth", topics.DEPTH), ("state", topics.CAMERA_STATE), ("health", topics.HEALTH)):
                    hear(kind, topic)
                up.wait_for(lambda: len(heard["depth"]) > 10, "pictures")
                image = codec.decode(heard["depth"][-1], DepthImage)[0]
                assert image.depth.shape == (480, 640)
                up.wait_for(lambda: any(state.ok for state in states()), "a good state")
                folder.rename(tmp_path / "elsewhere")
                up.wait_for(lambda: states()[-1].reason, "its absence being said")
                up.wait_for(lambda: any("no images" in words and "ground" in words for words in doing()), "health")
                assert up.running(), "a camera that is absent ends nothing"
            up.interrupt()
            assert up.status() == 130
            up.gone()
