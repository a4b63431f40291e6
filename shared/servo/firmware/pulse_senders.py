"""Senders of the pulses of hobby servos: PCA9685 on an I2C bus, or a Pololu Maestro on a UART.

A sender encodes requests to its chips and understands their answers. A request is its bytes and the number of bytes of its
answer. Pulses are counts, 0 for none. `sextant.shared.servo.pca9685` and `maestro` state the sources of registers and commands.
"""

NAME = "PWM"  # setting SERVO for hobby servos
PCA9685, MAESTRO = "PCA9685", "Maestro"  # first entries of the setting PULSES
MAESTRO_RATES = 57_600, 200_000  # [bit/s] lowest at which a cycle has time for torque off and a reading, and highest

_MODE1, _LED0, _ALL_LED, _PRE_SCALE, _MODE2 = 0x00, 0x06, 0xFA, 0xFE, 0x01
_SLEEP, _AUTO_INCREMENT, _FULL, _TOTEM_POLE = 0x10, 0x20, 0x10, 0x04
_COUNTS = 4096  # of a PCA9685 in a period
_BIT_PER_BYTE = 10
_ANSWER_US = 5000  # [us] delay of an answer of a Maestro at most
_POLOLU, _COMMAND_BIT = 0xAA, 0x80
_SET_SPEED, _SET_ACCELERATION, _GET_POSITION, _SET_TARGETS, _GET_ERRORS = 0x87, 0x89, 0x90, 0x9F, 0xA1
_KNOWN_ERRORS = (1 << 9) - 1
_SCRIPT_ERRORS, _SCRIPT_ERROR = 0x1C0, 0x40  # those of its script, and the bit that stands for them in a state
_LEAST_CHANNELS = 18  # of a Maestro that has channels for a robot


class Chip:
    """Known state of one chip."""

    def __init__(self, number: int):
        self.number = number
        self.sleeps: bool | None = None  # whether it sleeps, without pulses; None if unknown
        self.is_ready = False  # whether it takes pulses, at their rate


class PulseSender:
    """Pulses of one kind of servos, in whole numbers."""

    limit_size = 0
    state_size = 4
    chips = 1
    channels = 0  # of a chip; ids are channels, and those of the second chip follow those of the first
    answer_start = b""  # with which every answer begins
    acknowledges = True  # whether orders have an answer, too
    same = 0  # [counts] largest difference of equal pulses
    settles_us = 0  # [us] in which the pulses that are read back may be those before the newest ones

    def __init__(self, bits: int, per_unit: int, centre: int, low: int, high: int):
        """Store the pulses: bits of a fraction, counts in 0.1 mrad and at the centre with this fraction, and their range."""
        self._bits, self._per_unit, self._centre, self._low, self._high = bits, per_unit, centre, low, high

    def count(self, angle: int) -> int:
        """Return the counts of the pulses of an angle [0.1 mrad], within their range."""
        count: int = (self._centre + angle * self._per_unit + (1 << self._bits - 1)) >> self._bits
        return min(max(count, self._low), self._high)

    def angle(self, count: int) -> int:
        """Return the angle [0.1 mrad] of pulses, within their range."""
        count = min(max(count, self._low), self._high)
        angle: int = ((count << self._bits) - self._centre + self._per_unit // 2) // self._per_unit
        return angle


class Pca9685(PulseSender):
    """Two PCA9685. A request is address, numbers of written and read bytes, and written bytes; its answer begins with 1."""

    chips = 2
    channels = 16
    answer_start = b"\1"

    def __init__(self, pulses: tuple, baud_rate: int):
        """Compute the counts of pulses.

        Args:
            pulses: Change of the width [ns/rad], width at the centre and its largest change [us], rate [Hz], oscillator [kHz],
                and address of the first chip.
            baud_rate: Not used.
        """
        per_rad, centre, most, rate, oscillator, self.address = pulses
        self.name = "%s %d %d %d us %d Hz" % (NAME, per_rad, centre, most, rate)  # noqa: UP031  (short on a board)
        self.scale = (2000 * oscillator + _COUNTS * rate) // (2 * _COUNTS * rate) - 1
        period = 1000 * (self.scale + 1)  # of a count, in periods of 1000 oscillations per us
        low, high = [(centre + way) * oscillator // period for way in (-most, most)]
        per_unit = ((per_rad * oscillator << 18) // 10_000 + period * 500) // (period * 1000)
        super().__init__(18, per_unit, (centre * oscillator << 18) // period, low, high)

    def wait_us(self, data: bytes, size: int) -> int:
        """Return the longest time [us] of a request."""
        return 20_000

    def rest_us(self, size: int, is_answered: bool) -> int:
        """Return 0: no bytes follow a transfer."""
        return 0

    def status(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the requests for the state of a chip, each with its number for `note_status`."""
        return [(register,) + self._request(chip, register, b"", 1) for register in (_MODE1, _PRE_SCALE)]

    def note_status(self, chip: Chip, register: int, data: bytes) -> bool:
        """Store an answer to `status`, and return whether it is possible."""
        if register == _MODE1:
            chip.sleeps = bool(data[0] & _SLEEP)
        else:
            chip.is_ready = chip.sleeps is False and data[0] == self.scale
        return True

    def wake(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the requests that prepare a chip, without pulses."""
        settings = (
            (_MODE1, bytes((_AUTO_INCREMENT | _SLEEP,))),
            (_ALL_LED, bytes((0, 0, 0, _FULL))),
            (_PRE_SCALE, bytes((self.scale,))),
            (_MODE2, bytes((_TOTEM_POLE,))),
            (_MODE1, bytes((_AUTO_INCREMENT,))),
        )
        return [self._request(chip, register, data, 0) for register, data in settings]

    def off(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the requests that end the pulses of all channels of a chip."""
        return [self._request(chip, _ALL_LED, bytes((0, 0, 0, _FULL)), 0)]

    def write(self, chip: Chip, first: int, counts: list[int]) -> tuple:
        """Return the request for pulses of channels from `first` on."""
        data = b"".join([bytes((0, 0, count & 0xFF, count >> 8)) for count in counts])
        return self._request(chip, _LED0 + 4 * first, data, 0)

    def read_back(self, chip: Chip, channel: int) -> tuple:
        """Return the request for the pulses of a channel."""
        return self._request(chip, _LED0 + 4 * channel, b"", 4)

    def found(self, data: bytes) -> tuple:
        """Return the counts and the errors in an answer to `read_back`; -1 counts if it is impossible."""
        if data[3] & _FULL:
            return 0, 0
        return ((data[2] | (data[3] & 0x0F) << 8) - (data[0] | (data[1] & 0x0F) << 8)) % _COUNTS, 0

    def _request(self, chip: Chip, register: int, data: bytes, size: int) -> tuple:
        return bytes((self.address + chip.number, 1 + len(data), size, register)) + data, 1 + size


class Maestro(PulseSender):
    """A Mini Maestro. With a device number it takes the Pololu protocol, else the compact one. Counts are quarters of a us."""

    channels = 24
    acknowledges = False
    same = 20  # the Control Center has coarse limits of channels

    def __init__(self, pulses: tuple, baud_rate: int):
        """Compute the counts of pulses.

        Args:
            pulses: Change of the width [ns/rad], width at the centre and its largest change [us], rate [Hz], and device
                number, 0 for the compact protocol.
            baud_rate: [bit/s] of its UART.

        Raises:
            ValueError: The rate is too low or too high.
        """
        per_rad, centre, most, rate, device = pulses
        least, most_rate = MAESTRO_RATES
        if not least <= baud_rate <= most_rate:
            raise ValueError("BAUD_RATE of %d to %d expected for a Maestro, found %d" % (least, most_rate, baud_rate))  # noqa: UP031
        self.name = "%s %d %d %d us %s" % (NAME, per_rad, centre, most, MAESTRO)  # noqa: UP031
        self.settles_us = 1_000_000 // rate + _ANSWER_US
        self._device, self._baud_rate = device, baud_rate
        per_unit = ((4 * per_rad << 17) + 5_000_000) // 10_000_000
        super().__init__(17, per_unit, 4 * centre << 17, 4 * (centre - most), 4 * (centre + most))

    def wait_us(self, data: bytes, size: int) -> int:
        """Return the longest time [us] of a request; without an answer, its time on the line."""
        return self._line_us(len(data) + size) + (_ANSWER_US if size else 0)

    def rest_us(self, size: int, is_answered: bool) -> int:
        """Return the time [us] after a request in which bytes are dropped, because they cannot be of the next answer.

        They are the rest of an answer that began with a disturbance, or one that is late.
        """
        return self._line_us(size) if is_answered else _ANSWER_US

    def _line_us(self, count: int) -> int:
        """Return the time [us] of bytes on the line."""
        return (count * _BIT_PER_BYTE * 1_000_000 + self._baud_rate - 1) // self._baud_rate

    def status(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the request that clears old errors, and those that remove limits, each with its number for `note_status`."""
        requests = [(self._command(_GET_ERRORS), 2)] + self.wake(chip, channels)
        return [(len(requests) - 1 - k,) + request for k, request in enumerate(requests)]

    def note_status(self, chip: Chip, left: int, data: bytes) -> bool:
        """Store an answer to `status`, and return whether it is possible."""
        chip.is_ready = not left
        return not data or data[0] | data[1] << 8 <= _KNOWN_ERRORS

    def wake(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the requests that remove limits of speed and acceleration."""
        commands = (_SET_SPEED, _SET_ACCELERATION)
        return [(b"".join([self._command(one, bytes((channel, 0, 0))) for one in commands]), 0) for channel in channels]

    def off(self, chip: Chip, channels: list[int]) -> list[tuple]:
        """Return the requests that end the pulses of these channels; without any, those of all channels of any Mini Maestro."""
        runs: list[list] = []  # first channel and number of channels
        for channel in channels:
            if not runs or runs[-1][0] + runs[-1][1] != channel:
                runs.append([channel, 0])
            runs[-1][1] += 1
        runs = runs or [[0, _LEAST_CHANNELS], [_LEAST_CHANNELS, self.channels - _LEAST_CHANNELS]]
        return [self.write(chip, first, [0] * count) for first, count in runs]

    def write(self, chip: Chip, first: int, counts: list[int]) -> tuple:
        """Return the request for pulses of channels from `first` on."""
        data = b"".join([bytes((count & 0x7F, count >> 7)) for count in counts])
        return self._command(_SET_TARGETS, bytes((len(counts), first)) + data), 0

    def read_back(self, chip: Chip, channel: int) -> tuple:
        """Return the request for the errors and for the pulses of a channel."""
        return self._command(_GET_ERRORS) + self._command(_GET_POSITION, bytes((channel,))), 4

    def found(self, data: bytes) -> tuple:
        """Return the counts and the errors in an answer to `read_back`; -1 counts if it is impossible."""
        errors, count = data[0] | data[1] << 8, data[2] | data[3] << 8
        if errors > _KNOWN_ERRORS:
            return -1, 0
        return count, errors & ~_SCRIPT_ERRORS | (_SCRIPT_ERROR if errors & _SCRIPT_ERRORS else 0)

    def _command(self, command: int, data: bytes = b"") -> bytes:
        if not self._device:
            return bytes((command,)) + data
        return bytes((_POLOLU, self._device, command & ~_COMMAND_BIT)) + data


def sender_for(pulses: tuple, baud_rate: int) -> Pca9685 | Maestro:
    """Return the sender of the setting PULSES, whose first entry is its kind, at a rate [bit/s] of a Maestro's UART.

    Raises:
        ValueError: There is no such kind, or the rate is too low or too high.
    """
    if pulses[0] not in (PCA9685, MAESTRO):
        raise ValueError("PCA9685 or Maestro expected in PULSES, found %s" % str(pulses[0]))  # noqa: UP031
    return (Maestro if pulses[0] == MAESTRO else Pca9685)(pulses[1:], baud_rate)
