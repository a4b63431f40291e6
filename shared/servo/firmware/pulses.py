"""The bridge for hobby servos, which take pulses and report nothing: PCA9685 on an I2C bus send the pulses.

The registers of the pulses are read back. A servo without pulses has no torque, and the first pulse makes it jump to its goal,
so the legs get theirs one after another. Registers are those of the data sheet, see `sextant.shared.servo.pca9685`.
"""

from . import wire
from .bridge import FAR, Firmware, _Servo

NAME = "PWM"  # setting SERVO for these servos
CHIPS = 2
CHANNELS = 16  # of a chip; ids are channels, and those of the second chip begin at 16
LEG_US = 500_000  # [us] between the first pulses of two legs
PER_LEG = 3  # servos that get their first pulses together
READ_BACK = 3  # channels that are read back in a cycle
LONGEST_US = 100_000  # [us] between two goals for which a speed limit is integrated
UNIT_US = 100_000  # [us] in which 1 mrad/s moves by 0.1 mrad
TIMEOUT_US = 20_000  # [us] of a transfer

_MODE1, _LED0, _ALL_LED, _PRE_SCALE, _MODE2 = 0x00, 0x06, 0xFA, 0xFE, 0x01
_SLEEP, _AUTO_INCREMENT, _FULL, _TOTEM_POLE = 0x10, 0x20, 0x10, 0x04
_COUNTS = 4096  # in a period
_BITS = 18  # of the fraction of counts
_OFF, _WRITE, _WAKE, _MODE, _SCALE, _CHANNEL = 0, 1, 2, 3, 4, 5  # kinds of a transfer


class PulseModel:
    """Pulses of one kind of servos, in whole numbers."""

    limit_size = 0
    state_size = 4
    known_errors = alert = 0

    def __init__(self, pulses: tuple):
        """Compute the counts of pulses.

        Args:
            pulses: Change of the width [ns/rad], width at the centre and its largest change [us], rate [Hz], oscillator [kHz],
                and address of the first chip.
        """
        per_rad, centre, most, rate, oscillator, self.address = pulses
        self.name = "%s %d %d %d us %d Hz" % (NAME, per_rad, centre, most, rate)  # noqa: UP031  (short on a board)
        self.scale = (2000 * oscillator + _COUNTS * rate) // (2 * _COUNTS * rate) - 1
        period = 1000 * (self.scale + 1)  # of a count, in periods of 1000 oscillations per us
        self._per_unit = ((per_rad * oscillator << _BITS) // 10_000 + period * 500) // (period * 1000)
        self._centre = (centre * oscillator << _BITS) // period
        self._low, self._high = ((centre + way) * oscillator // period for way in (-most, most))

    def count(self, angle: int) -> int:
        """Return the counts of the pulses of an angle [0.1 mrad], within their range."""
        count: int = (self._centre + angle * self._per_unit + (1 << _BITS - 1)) >> _BITS
        low: int = self._low
        high: int = self._high
        return min(max(count, low), high)

    def angle(self, count: int) -> int:
        """Return the angle [0.1 mrad] of pulses."""
        angle: int = ((count << _BITS) - self._centre + self._per_unit // 2) // self._per_unit
        return angle


class I2cMaster:
    """Master of the I2C bus, one transfer at a time, with the interface of `BusMaster`.

    A transfer is sent as address, numbers of written and read bytes, and written bytes. Its answer is 1 and the read bytes, or
    as many zeros if no chip has acknowledged.
    """

    def __init__(self) -> None:
        """Start with an idle bus."""
        self.silent = self.garbled = 0
        self._about: object = None
        self._is_forgotten = False
        self._size = self._began_us = self._until_us = 0
        self._received = b""

    @property
    def broken(self) -> int:
        """Number of channels with other pulses than written."""
        return self.garbled

    @property
    def due_us(self) -> int:
        """Latest time [us] at which the bus is free again."""
        return self._until_us

    @property
    def waits(self) -> bool:
        """Whether a transfer is pending."""
        return self._about is not None

    def reading_us(self, size: int) -> int:
        """Return 0: a transfer takes part of a millisecond."""
        return 0

    def ask(self, transfer: bytes, about: object, now_us: int) -> bytes:
        """Start a transfer, and return its bytes."""
        self._about, self._size, self._is_forgotten = about, 1 + transfer[2], False
        self._began_us, self._until_us, self._received = now_us, now_us + TIMEOUT_US, b""
        return transfer

    def hear(self, data: bytes, now_us: int) -> list[tuple]:
        """Process bytes from the port, and return the completed transfer, with the bytes read; None if it failed."""
        if not self.waits:
            return []
        self._received += data
        found = self._received[1 : self._size] if self._received[:1] == b"\1" else None
        if len(self._received) < self._size:
            if now_us < self._until_us:
                return []
            found = None
        self.silent += found is None
        about, self._about, self._received, self._until_us = self._about, None, b"", now_us
        return [] if self._is_forgotten else [(about, self._began_us, found)]

    def forget(self) -> None:
        """Ignore the result of the pending transfer."""
        self._is_forgotten = True


class _PulseServo(_Servo):
    """Known pulses of one servo."""

    def __init__(self, servo_id: int):
        super().__init__(servo_id)
        self.count = 0  # [counts] of the pulses that its chip has acknowledged, 0 for none
        self.found = -1  # the same by the newest reading
        self.waits = False  # whether torque is ordered on, and the first pulses of its leg are still to come

    def lose(self) -> None:
        """Note that the servo has no pulses; it gets some again only by an order."""
        self.count, self.torque, self.waits, self.goal, self.asked_us = 0, False, False, None, None


class _Chip:
    """Known state of one PCA9685."""

    def __init__(self, number: int):
        self.number = number
        self.mode: int | None = None  # MODE1, None without an answer
        self.is_ready = False  # whether it is awake, with the rate of the pulses


class PulseFirmware(Firmware):
    """Firmware between a host link and the chips that send pulses."""

    _SERVO = _PulseServo
    _ADOPTED_BY = ()

    def __init__(self, *settings: object):
        """Start without a session; the settings are those of `Firmware`, with pulses in place of the servo's name."""
        super().__init__(*settings)  # type: ignore[arg-type]
        self._servos: list[_PulseServo] = []  # type: ignore[assignment]
        self._chips = [_Chip(number) for number in range(CHIPS)]
        self._jobs: list[tuple] = []  # kind, chip, register, written bytes, read bytes and subject of each transfer
        self._leg = -1  # leg that gets its first pulses
        self._next_leg_us = 0  # [us] time of the first pulses of the next leg, or at which the last leg is there
        self._sent_us = 0  # [us] time of the newest goals on their way
        self._next = 0  # index of the servo that is read back next

    def _open(self, servo: object, baud_rate: int, now_us: int) -> None:
        self._model, self._bus = PulseModel(servo), I2cMaster()  # type: ignore[arg-type, assignment]

    # ------------------------------------------------------------------------------------------------- commands

    def _greet(self, session: int, stamp_us: int, ids: bytes) -> None:
        is_new = session != self._session
        super()._greet(session, stamp_us, ids)
        if not is_new:
            return
        self._next = 0
        self._chips = [_Chip(number) for number in range(CHIPS)]
        used = [chip for chip in self._chips if any(self._chip(servo) is chip for servo in self._servos)]
        self._jobs = [(_MODE, chip, _MODE1, b"", 1, None) for chip in used]
        self._jobs += [(_SCALE, chip, _PRE_SCALE, b"", 1, None) for chip in used]
        self._jobs += [self._read_back(servo) for _ in range(2) for servo in self._servos]  # they must agree

    def _objection(self, question: list) -> int:
        return wire.QUESTION

    def _chip(self, servo: _PulseServo) -> _Chip:
        return self._chips[min(servo.servo_id // CHANNELS, CHIPS - 1)]

    def _turn_off(self) -> None:
        super()._turn_off()
        for servo in self._servos:
            servo.waits = False

    def _turn_on(self) -> None:
        """Give the servos without pulses their first ones leg by leg, if the goals are fresh and near the pulses of others."""
        super()._turn_on()
        if not self._torque_on_due:
            return
        self._torque_on_due = False
        again = any(servo.waits for servo in self._servos)
        for servo in self._servos:
            servo.waits = not servo.count
        for chip in self._chips:
            counts = [servo.count for servo in self._servos if self._chip(servo) is chip]
            if not (again or any(counts)):
                chip.is_ready = False  # it may have restarted
            if counts and not chip.is_ready and not any(job[0] == _WAKE and job[1] is chip for job in self._jobs):
                self._jobs += self._wake(chip)
        self._keep_turning()

    def _wake(self, chip: _Chip) -> list[tuple]:
        """Return the transfers that set up a chip, without pulses."""
        settings = (
            (_MODE1, bytes((_AUTO_INCREMENT | _SLEEP,))),
            (_ALL_LED, bytes((0, 0, 0, _FULL))),
            (_PRE_SCALE, bytes((self._model.scale,))),  # type: ignore[attr-defined]
            (_MODE2, bytes((_TOTEM_POLE,))),
            (_MODE1, bytes((_AUTO_INCREMENT,))),
        )
        return [(_WAKE, chip, register, data, 0, register == _MODE1 and not data[0] & _SLEEP) for register, data in settings]

    def _keep_turning(self) -> None:
        """Stay in mode CATCHING_UP until all legs have their pulses."""
        turns = self._now_us < self._next_leg_us or any(servo.waits for servo in self._servos)
        if self.mode == wire.ON and turns:
            self.mode = wire.CATCHING_UP

    def _is_near(self, index: int) -> bool:
        """Return whether a servo has no pulses, or some near its goal; what it does is not known."""
        servo = self._servos[index]
        if self._goals is None or servo.torque is None:
            return False
        return not servo.count or (servo.goal is not None and abs(servo.goal - self._goals[1][index]) <= FAR)

    # ----------------------------------------------------------------------------------------------------- time

    def _tick(self) -> None:
        super()._tick()
        self._round_due = False
        if self.mode not in (wire.WAITING, wire.ADOPTING) and len(self._jobs) < READ_BACK:
            for _ in range(min(READ_BACK, len(self._servos))):
                self._next = (self._next + 1) % len(self._servos)
                self._jobs.append(self._read_back(self._servos[self._next]))

    def _has_work(self) -> bool:
        goals = self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP)
        return bool(self._torque_off_due or goals or self._jobs)

    # -------------------------------------------------------------------------------------------------- the bus

    def _read_back(self, servo: _PulseServo) -> tuple:
        return _CHANNEL, self._chip(servo), _LED0 + 4 * (servo.servo_id % CHANNELS), b"", 4, servo

    def _next_packet(self) -> bytes:
        """Return the next transfer: torque off, then those that wait, with the newest goals behind them."""
        if self._torque_off_due:
            self._torque_off_due = False
            self._jobs = [(_OFF, chip, _ALL_LED, bytes((0, 0, 0, _FULL)), 0, None) for chip in self._chips]
        elif self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP):
            self._goals_due = False
            self._jobs += self._goal_jobs()
        while self._jobs:
            job = self._jobs.pop(0)
            kind, chip, register, data, size, _ = job
            if (kind != _WAKE or not chip.is_ready) and (kind != _WRITE or chip.is_ready):
                break  # otherwise it is out of date
        else:
            return b""
        transfer = bytes((self._model.address + chip.number, 1 + len(data), size, register)) + data  # type: ignore[attr-defined]
        return self._bus.ask(transfer, job, self._now_us)  # type: ignore[call-arg, arg-type]

    def _goal_jobs(self) -> list[tuple]:
        """Return the transfers of the goals of all servos with torque, one for channels that follow each other."""
        assert self._goals is not None
        elapsed_us = min(self._now_us - self._sent_us, LONGEST_US)
        self._sent_us = self._now_us
        waiting = [index // PER_LEG for index, servo in enumerate(self._servos) if servo.waits]
        if waiting and self._now_us >= self._next_leg_us:
            self._leg, self._next_leg_us = waiting[0], self._now_us + LEG_US
        runs: list[list] = []  # servos and counts of each
        goals = self._next_goals()
        for index in sorted(range(len(goals)), key=lambda k: self._servos[k].servo_id):
            servo, goal, speed = self._servos[index], goals[index], self._goals[2][index]
            if not servo.count and not (servo.waits and index // PER_LEG == self._leg):
                continue
            if servo.count and servo.goal is not None and speed:
                most = max(speed * elapsed_us // UNIT_US, 1)
                goal = servo.goal + min(max(goal - servo.goal, -most), most)
            servo.goal = goal
            if not runs or runs[-1][-1][0].servo_id + 1 != servo.servo_id or servo.servo_id % CHANNELS == 0:
                runs.append([])
            runs[-1].append((servo, self._model.count(goal)))  # type: ignore[attr-defined]
        self._keep_turning()
        jobs = []
        for run in runs:
            data = b"".join([bytes((0, 0, count & 0xFF, count >> 8)) for _, count in run])
            first = run[0][0]
            jobs.append((_WRITE, self._chip(first), _LED0 + 4 * (first.servo_id % CHANNELS), data, 0, run))
        return jobs

    def _learn(self, about: tuple, began_us: int, data: bytes | None) -> None:  # type: ignore[override]
        """Process the result of a transfer, None if no chip has acknowledged it."""
        kind, chip, _, _, _, subject = about
        if data is not None:
            if kind == _CHANNEL:
                self._note_pulses(subject, began_us, data)
            elif kind == _MODE:
                chip.mode = data[0]
            elif kind == _SCALE:
                chip.is_ready = chip.mode is not None and not chip.mode & _SLEEP and data[0] == self._model.scale  # type: ignore[attr-defined]
            elif kind == _WRITE:
                for servo, count in subject:
                    servo.count = servo.found = count
                    servo.torque, servo.waits = True, False
            elif kind == _WAKE:
                chip.is_ready = subject  # by its last transfer
            elif kind == _OFF:
                for servo in self._servos:
                    if self._chip(servo) is chip:
                        servo.lose()
        if self.mode == wire.ADOPTING and not self._jobs:
            self._take_over()

    def _note_pulses(self, servo: _PulseServo, began_us: int, data: bytes) -> None:
        """Compare the pulses of a channel with those written; in mode ADOPTING, adopt them if two readings agree."""
        count = 0 if data[3] & _FULL else ((data[2] | (data[3] & 0x0F) << 8) - (data[0] | (data[1] & 0x0F) << 8)) % _COUNTS
        before, servo.found = servo.found, count
        if self.mode == wire.ADOPTING:
            chip = self._chip(servo)
            if (chip.mode is not None and chip.mode & _SLEEP) or count == before == 0:
                servo.torque = False
            elif count == before and chip.is_ready:
                servo.torque, servo.count, servo.goal = True, count, self._model.angle(count)
        elif not count and servo.count:
            if before:
                self._jobs.insert(0, self._read_back(servo))
            else:  # twice; before the next goals, which would turn torque on again
                servo.lose()
                self.mode = wire.OFF
                self._jobs = [job for job in self._jobs if job[0] != _WRITE]
        elif count != servo.count:
            self._bus.garbled += 1
        if count and count == servo.count:
            servo.asked_us, servo.state = began_us, (self._model.angle(count), 0, 0, 0, 0)
