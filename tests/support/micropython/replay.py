"""Replay recorded turns of the firmware, under MicroPython or CPython, and compare every byte.

Each line of the record has a boot (B, boot number, counter, servo, echo, baud rate, and the entries of PULSES) or a turn (T,
counter, and in hex the bytes from the host, from the servos, to the host and to the servos).
"""

import sys

import machine
from firmware import board, config

PERIOD = 1 << 30  # of `time.ticks_us` on boards


def ticks_diff(new, old):  # type: ignore[no-untyped-def]
    return (new - old + PERIOD // 2) % PERIOD - PERIOD // 2


class Settings:
    """Settings of config.py, with a UART to the host."""

    def __init__(self, servo, echo, rate, pulses):  # type: ignore[no-untyped-def]
        for name in dir(config):
            setattr(self, name, getattr(config, name))
        self.SERVO, self.BAUD_RATE, self.ECHO, self.DIRECTION = servo, rate, echo, None if echo else 6
        if pulses:
            self.PULSES = tuple(pulses[:1] + [int(word) for word in pulses[1:]])
        self.HOST_UART, self.HOST_TX, self.HOST_RX = 0, 0, 1


class Held:
    """Port whose answers are read in the recorded turns."""

    def __init__(self, port):  # type: ignore[no-untyped-def]
        self._port, self.has_arrived = port, False

    def read(self):  # type: ignore[no-untyped-def]
        return self._port.read() if self.has_arrived else b""

    def write(self, data):  # type: ignore[no-untyped-def]
        self._port.read()  # an answer that was lost
        self._port.write(data)


def next_answer(rows, at, transfer):  # type: ignore[no-untyped-def]
    """Return the recorded answer to an I2C transfer; one that has been lost is not acknowledged."""
    for words in rows[at + 1 :]:
        if words[0] == "T" and words[3]:
            return bytes.fromhex(words[3])
        if words[0] == "B" or words[5]:
            break
    return bytes(1 + (transfer[2] if transfer else 0))


def replay(path):  # type: ignore[no-untyped-def]
    """Return the numbers of boots, turns and sent bytes; raise AssertionError at the first difference."""
    counter = [0]
    boots = turns = count = 0
    with open(path) as lines:  # noqa: PTH123  (MicroPython has no pathlib)
        rows = [line.strip().split(",") for line in lines]
    for at, words in enumerate(rows):
        if words[0] == "B":
            boots += 1
            counter[0] = int(words[2])
            clock = board.Clock(lambda: counter[0], ticks_diff)
            settings = Settings(words[3], words[4] == "1", int(words[5]), words[6].split())
            bus, host = board.open_bus(machine, settings), board.open_host(machine, settings, None)
            computer = host._uart
            is_i2c = settings.SERVO == "PWM" and settings.PULSES[0] == "PCA9685"
            servos = bus._i2c if is_i2c else bus._uart
            if is_i2c:
                bus = Held(bus)
            else:
                servos.pin = bus._direction
            firmware = board.start(settings, int(words[1]), clock.now_us())
            continue
        turns += 1
        counter[0] = int(words[1])
        from_host, from_bus, to_host, to_bus = [bytes.fromhex(word) for word in words[2:]]
        computer.received += from_host
        if is_i2c:
            servos.answer, bus.has_arrived = next_answer(rows, at, to_bus), bool(from_bus)
        else:
            servos.received += from_bus
        board.turn(firmware, clock, host, bus)
        found = computer.take(), servos.take()
        if settings.ECHO:
            servos.received += found[1]
        assert found == (to_host, to_bus), "turn %d: %s and %s expected, found %s and %s" % (  # noqa: UP031
            turns, words[4], words[5], found[0].hex(), found[1].hex(),
        )  # fmt: skip
        count += len(to_host) + len(to_bus)
    return boots, turns, count


if __name__ == "__main__":
    print(sys.implementation.name, *replay("record.csv"))
