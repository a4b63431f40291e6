"""PCA9685: the examples of its data sheet, and laws of its transfers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.servo import pca9685
from sextant.shared.servo.pca9685 import FrameParser, Transfer


def test_pre_scale_is_that_of_the_data_sheet() -> None:
    assert pca9685.pre_scale(200.0, 25e6) == 0x1E  # equation (2)
    assert pca9685.pre_scale(50.0, 25e6) == 0x79
    for rate in (10.0, 2000.0):
        with pytest.raises(ValueError, match="a rate of pulses"):
            pca9685.pre_scale(rate, 25e6)


def test_a_period_is_that_of_the_rate() -> None:
    scale = pca9685.pre_scale(50.0, 25e6)
    assert pca9685.COUNTS * pca9685.count_us(scale, 25e6) == pytest.approx(20_000.0, rel=1e-3)


def test_registers_of_a_channel_are_those_of_the_data_sheet() -> None:
    # Section 7.3.3: LEDn_OFF_H bit 4 turns the output off. A pulse of 1500 us at 50 Hz has 307 counts, 0x133.
    assert pca9685.channel_registers(0).hex(" ") == "00 00 00 10"
    assert pca9685.channel_registers(307).hex(" ") == "00 00 33 01"
    assert pca9685.pulse_count(bytes.fromhex("99 01 cc 04")) == 0x4CC - 0x199  # figure 7: on at 0x199, off at 0x4cc
    with pytest.raises(ValueError, match="a pulse of 0 to 4095 counts expected, found 4096"):
        pca9685.channel_registers(4096)


@given(st.integers(0, pca9685.COUNTS - 1))
def test_counts_survive_registers(count: int) -> None:
    assert pca9685.pulse_count(pca9685.channel_registers(count)) == count


_TRANSFERS = st.builds(Transfer, st.integers(0x40, 0x7E), st.binary(max_size=70), st.integers(0, 70))


@given(st.lists(_TRANSFERS, max_size=5), st.data())
def test_transfers_survive_a_port_in_any_pieces(transfers: list[Transfer], data: st.DataObject) -> None:
    stream = b"".join(map(pca9685.frame, transfers))
    cut = data.draw(st.integers(0, len(stream)))
    parser = FrameParser()
    assert parser.feed(stream[:cut]) + parser.feed(stream[cut:]) == transfers


def test_an_answer_tells_whether_a_board_has_acknowledged() -> None:
    assert pca9685.answer(None) == b"\x00"
    assert pca9685.answer(b"\x11") == b"\x01\x11"
