"""Latency timer of the USB adapter: set by flag or file, or the command is named."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from sextant.services.actuator.servo_bus import usb_adapter


class Port:
    """A pyserial port whose driver accepts the low latency flag or refuses it."""

    def __init__(self, timer: Path, error: Exception | None = None) -> None:
        self.timer, self.error = timer, error

    def set_low_latency_mode(self, wanted: bool) -> None:
        if self.error:
            raise self.error
        self.timer.write_text("1\n" if wanted else "16\n")


@pytest.fixture
def timer(tmp_path: Path) -> Path:
    file = tmp_path / "sys" / "ttyUSB0" / "latency_timer"
    file.parent.mkdir(parents=True)
    file.write_text("16\n")
    return file


@pytest.fixture
def link(tmp_path: Path) -> str:
    """Return a link to the device as in /dev/serial/by-id."""
    device, link = tmp_path / "ttyUSB0", tmp_path / "usb-FTDI_USB_Serial-if00-port0"
    device.touch()
    link.symlink_to(device)
    return str(link)


def test_low_latency_flag_is_set_without_root(timer: Path, link: str) -> None:
    assert usb_adapter.latency_ms(link, timer.parents[1]) == 16
    assert usb_adapter.lower_latency(link, Port(timer), timer.parents[1]) == ""
    assert timer.read_text() == "1\n"


@pytest.mark.parametrize("error", [OSError("no ioctl"), ValueError("Failed to update ASYNC_LOW_LATENCY flag")])
def test_latency_timer_file_is_written_if_flag_is_refused(error: Exception, timer: Path, link: str) -> None:
    assert usb_adapter.lower_latency(link, Port(timer, error), timer.parents[1]) == ""
    assert timer.read_text() == "1\n"


def test_missing_permission_names_command_and_udev_rule(timer: Path, link: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "write_text", refuse)
    words = usb_adapter.lower_latency(link, Port(timer, OSError("refused")), timer.parents[1])
    assert "is 16 ms, 1 expected" in words
    assert f"`echo 1 | sudo tee {timer}`" in words
    assert 'DRIVER=="ftdi_sio", ATTR{latency_timer}="1"' in words
    assert timer.read_text() == "16\n"


def test_adapter_is_named_by_product_and_ids_also_behind_a_link(link: str, tmp_path: Path) -> None:
    device = str(tmp_path / "ttyUSB0")
    ftdi = SimpleNamespace(device=device, vid=0x0403, pid=0x6001, product="FT232R USB UART")
    onboard = SimpleNamespace(device=device, vid=None, pid=None, product=None)
    other = SimpleNamespace(device="/dev/ttyACM0", vid=0x2341, pid=0x0043, product=None)
    for url in (link, device):
        assert usb_adapter.name_of(url, lambda: [other, ftdi]) == "FT232R USB UART (0403:6001)"
        assert usb_adapter.name_of(url, lambda: [other, onboard]) == ""
    assert usb_adapter.name_of("/dev/ttyACM0", lambda: [other]) == "USB device (2341:0043)"
    assert usb_adapter.name_of("socket://127.0.0.1:5000", lambda: [other]) == ""


def test_low_latency_adapter_and_ports_without_timer_are_unchanged(timer: Path, link: str) -> None:
    timer.write_text("1\n")
    touched = Port(timer, AssertionError("not to be touched"))
    assert usb_adapter.lower_latency(link, touched, timer.parents[1]) == ""
    assert usb_adapter.lower_latency("socket://127.0.0.1:5000", touched, timer.parents[1]) == ""
    assert usb_adapter.latency_ms("/dev/ttyACM0", timer.parents[1]) is None
