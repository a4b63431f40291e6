"""Discovery of the servos' port by name, and again when its adapter returns.

The adapter may return under another name.
"""

import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus import servo_interface, usb_adapter
from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError


class Adapter:
    """A port as listed by pyserial."""

    def __init__(self, device: str, vid: int | None = 0x0403, pid: int | None = 0x6014, serial: str | None = "FT1") -> None:
        self.device, self.vid, self.pid, self.serial_number = device, vid, pid, serial


def test_adapter_is_found_by_identity_under_a_new_device_name() -> None:
    before = [Adapter("/dev/ttyS0", None, None, None), Adapter("/dev/ttyUSB0"), Adapter("/dev/ttyUSB1", serial="FT2")]
    who = usb_adapter.identity("/dev/ttyUSB0", lambda: before)
    assert who == (0x0403, 0x6014, "FT1")
    after = [Adapter("/dev/ttyUSB1", serial="FT2"), Adapter("/dev/ttyUSB2")]
    assert usb_adapter.renamed_devices(who, lambda: after) == ["/dev/ttyUSB2"]
    assert usb_adapter.renamed_devices(who, list) == []


@pytest.mark.parametrize("url", ["/dev/ttyS0", "/dev/ttyUSB9", "socket://127.0.0.1:5000"])
def test_port_without_usb_adapter_has_no_identity(url: str) -> None:
    ports = [Adapter("/dev/ttyS0", None, None, None), Adapter("/dev/ttyUSB9", serial=None)]
    assert usb_adapter.identity(url, lambda: ports) is None
    assert usb_adapter.renamed_devices(None, lambda: [Adapter("/dev/ttyUSB0"), *ports]) == []


class ListedPorts:
    """Ports that exist by name, and a list of those that were tried."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *adapters: Adapter, others: tuple[str, ...] = ()) -> None:
        self.adapters, self.others, self.tried = list(adapters), others, list[str]()
        monkeypatch.setattr(servo_interface, "open_port", self.open)
        monkeypatch.setattr(usb_adapter.identity, "__defaults__", (lambda: self.adapters,))
        monkeypatch.setattr(usb_adapter.renamed_devices, "__defaults__", (lambda: self.adapters,))

    def open(self, url: str, rate: int, timeout_ns: int) -> str:
        assert rate == 1_000_000
        assert timeout_ns == servo_interface.read_timeout_ns(Settings())
        self.tried.append(url)
        if url not in (*self.others, *(adapter.device for adapter in self.adapters)):
            raise BusDisconnectedError(f"no {url}")
        return url


def test_port_finder_opens_first_existing_port_and_follows_renamed_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = ListedPorts(monkeypatch, Adapter("/dev/ttyUSB0"))
    finder = servo_interface.PortFinder(Settings(port="/dev/ttyACM0, /dev/ttyUSB0"))
    assert finder.open() == "/dev/ttyUSB0"
    assert ports.tried == ["/dev/ttyACM0", "/dev/ttyUSB0"]
    ports.adapters = [Adapter("/dev/ttyUSB3", serial="FT2"), Adapter("/dev/ttyUSB4")]
    assert finder.open() == "/dev/ttyUSB4", "the same adapter, and no other"
    ports.adapters = []
    with pytest.raises(BusDisconnectedError, match=r"^no /dev/ttyACM0; no /dev/ttyUSB0$"):
        finder.open()
    ports.adapters = [Adapter("/dev/ttyUSB7")]
    assert finder.open() == "/dev/ttyUSB7", "it is remembered"


def test_port_finder_keeps_adapter_identity_after_opening_a_socket_port(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = ListedPorts(monkeypatch, Adapter("/dev/ttyUSB0"), others=("socket://here:1",))
    finder = servo_interface.PortFinder(Settings(port="/dev/ttyUSB0,socket://here:1"))
    assert finder.open() == finder.open() == "/dev/ttyUSB0"
    assert ports.tried == ["/dev/ttyUSB0"] * 2
    ports.adapters = []
    assert finder.open() == "socket://here:1"
    ports.adapters, ports.others = [Adapter("/dev/ttyUSB5")], ()
    assert finder.open() == "/dev/ttyUSB5"
