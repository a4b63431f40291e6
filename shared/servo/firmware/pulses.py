"""The bridge for hobby servos, which take pulses and report nothing; `pulse_senders` has the devices that send the pulses.

The pulses are read back. A servo without pulses has no torque, and the first pulse makes it jump to its goal, so the legs get
theirs one after another.
"""

from . import wire
from .bridge import FAR, Firmware, _Servo
from .pulse_senders import Chip, Maestro, Pca9685, sender_for

LEG_US = 500_000  # [us] between the first pulses of two legs
PER_LEG = 3  # servos that get their first pulses together
READ_BACK = 3  # channels that are read back in a cycle
LONGEST_US = 100_000  # [us] between two goals for which a speed limit is integrated
UNIT_US = 100_000  # [us] in which 1 mrad/s moves by 0.1 mrad

_OFF, _WRITE, _WAKE, _STATUS, _CHANNEL = 0, 1, 2, 3, 4  # kinds of a request


class RequestMaster:
    """Master of the line to a sender, one request at a time, with the interface of `BusMaster`."""

    def __init__(self, sender: Pca9685 | Maestro) -> None:
        """Start with an idle line."""
        self.silent = self.garbled = 0
        self._sender = sender
        self._about: object = None
        self._is_forgotten = False
        self._size = self._began_us = self._until_us = 0
        self._received = b""

    @property
    def broken(self) -> int:
        """Number of impossible answers, and of channels with other pulses than written."""
        return self.garbled

    @property
    def due_us(self) -> int:
        """Latest time [us] at which the line is free again."""
        return self._until_us

    @property
    def waits(self) -> bool:
        """Whether a request is pending."""
        return self._about is not None

    def reading_us(self, size: int) -> int:
        """Return 0: a request takes part of a millisecond."""
        return 0

    def ask(self, request: bytes, size: int, about: object, now_us: int) -> bytes:
        """Start a request with an answer of `size` bytes, and return its bytes."""
        self._about, self._size, self._is_forgotten = about, size, False
        self._began_us, self._until_us, self._received = now_us, now_us + self._sender.wait_us(request, size), b""
        return request

    def hear(self, data: bytes, now_us: int) -> list[tuple]:
        """Process bytes from the port, and return the completed request, with its answer; None if that is missing.

        A request without an answer is completed when it has been sent. Bytes between two requests are dropped.
        """
        if not self.waits:
            return []
        self._received += data
        if now_us < self._until_us and not 0 < self._size <= len(self._received):
            return []
        start, found = self._sender.answer_start, None
        if len(self._received) >= self._size and self._received.startswith(start):
            found = self._received[len(start) : self._size]
        self.silent += found is None
        about, self._about, self._received = self._about, None, b""
        self._until_us = now_us + self._sender.rest_us(self._size, found is not None)
        return [] if self._is_forgotten else [(about, self._began_us, found)]

    def forget(self) -> None:
        """Ignore the result of the pending request."""
        self._is_forgotten = True


class _PulseServo(_Servo):
    """Known pulses of one servo."""

    def __init__(self, servo_id: int):
        super().__init__(servo_id)
        self.count = 0  # [counts] of the written pulses, 0 for none
        self.count_before = 0  # the same before the newest write, at ...
        self.written_us = 0
        self.found = -1  # the same by the newest reading
        self.is_known = False  # whether two readings in mode ADOPTING have agreed
        self.waits = False  # whether torque is ordered on, and the first pulses of its leg are still to come

    def write(self, count: int, now_us: int) -> None:
        """Note that the servo has pulses."""
        self.count_before, self.written_us = self.count, now_us
        self.count = self.found = count
        self.torque, self.waits = True, False

    def lose(self) -> None:
        """Note that the servo has no pulses; it gets some again only by an order."""
        self.count, self.torque, self.waits, self.goal, self.asked_us = 0, False, False, None, None


class PulseFirmware(Firmware):
    """Firmware between a host link and the device that sends pulses."""

    _SERVO = _PulseServo
    _ADOPTED_BY = ()

    def __init__(self, *settings: object):
        """Start without a session; the settings are those of `Firmware`, with pulses in place of the servo's name."""
        super().__init__(*settings)  # type: ignore[arg-type]
        self._servos: list[_PulseServo] = []  # type: ignore[assignment]
        self._chips = [Chip(number) for number in range(self._sender.chips)]
        self._jobs: list[tuple] = []  # kind, chip, bytes, size of the answer and subject of each request
        self._leg = -1  # leg that gets its first pulses
        self._next_leg_us = 0  # [us] time of the first pulses of the next leg, or at which the last leg is there
        self._sent_us = 0  # [us] time of the newest goals on their way
        self._next = 0  # index of the servo that is read back next
        self._has_seen = False  # whether the newest reading has shown pulses

    def _open(self, servo: object, baud_rate: int, now_us: int) -> None:
        self._sender = sender_for(servo, baud_rate)  # type: ignore[arg-type]
        self._model, self._bus = self._sender, RequestMaster(self._sender)  # type: ignore[assignment]

    # ------------------------------------------------------------------------------------------------- commands

    def _greet(self, session: int, stamp_us: int, ids: bytes) -> None:
        is_new = session != self._session
        super()._greet(session, stamp_us, ids)
        if not is_new:
            return
        self._next = 0
        self._chips = [Chip(number) for number in range(self._sender.chips)]
        self._jobs = []
        for chip in self._chips:
            if channels := self._channels(chip):
                status = self._sender.status(chip, channels)
                self._jobs += [(_STATUS, chip, data, size, subject) for subject, data, size in status]
        self._jobs += [self._read_back(servo) for _ in range(2) for servo in self._servos]  # they must agree

    def _objection(self, question: list) -> int:
        return wire.QUESTION

    def _chip(self, servo: _PulseServo) -> Chip:
        return self._chips[min(servo.servo_id // self._sender.channels, self._sender.chips - 1)]

    def _channels(self, chip: Chip) -> list[int]:
        """Return the used channels of a chip, in rising order."""
        return sorted([servo.servo_id % self._sender.channels for servo in self._servos if self._chip(servo) is chip])

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
                requests = self._sender.wake(chip, self._channels(chip))
                self._jobs += [(_WAKE, chip) + request + (request is requests[-1],) for request in requests]
        self._keep_turning()

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
                self._jobs.append(self._read_back(self._turn()))

    def _state(self) -> bytes:
        found = super()._state()
        for servo in self._servos:
            servo.error = 0  # stated once
        return found

    def _has_work(self) -> bool:
        goals = self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP)
        return bool(self._torque_off_due or goals or self._jobs)

    # -------------------------------------------------------------------------------------------------- the bus

    def _turn(self) -> _PulseServo:
        """Return the servo that is read back next."""
        self._next = (self._next + 1) % len(self._servos)
        return self._servos[self._next]

    def _read_back(self, servo: _PulseServo) -> tuple:
        chip = self._chip(servo)
        data, size = self._sender.read_back(chip, servo.servo_id % self._sender.channels)
        return _CHANNEL, chip, data, size, servo

    def _next_packet(self) -> bytes:
        """Return the next request: torque off, preparation of chips, the newest goals, then readings."""
        if self._torque_off_due:
            self._torque_off_due = False
            self._jobs = [
                (_OFF, chip, data, size, None)
                for chip in self._chips
                for data, size in self._sender.off(chip, self._channels(chip))
            ]
            if not self._sender.acknowledges:
                self._jobs += [self._read_back(servo) for servo in self._servos if servo.torque is not False]
        elif self._goals_due and self.mode in (wire.ON, wire.CATCHING_UP):
            self._goals_due = False
            first = [job for job in self._jobs if job[0] == _WAKE]
            others = [job for job in self._jobs if job[0] not in (_WAKE, _WRITE)]
            self._jobs = first + self._goal_jobs() + others
        while self._jobs:
            job = self._jobs.pop(0)
            kind, chip, data, size, subject = job
            if (kind != _WAKE or not chip.is_ready) and (kind != _WRITE or self._may_write(chip, subject)):
                return self._bus.ask(data, size, job, self._now_us)  # type: ignore[call-arg]
            # Otherwise it is out of date.
        return b""

    def _may_write(self, chip: Chip, run: list[tuple]) -> bool:
        """Return whether a chip takes these pulses.

        One that has restarted would give torque. Without acknowledgement it has to show before that it still sends pulses,
        unless they are the first ones of all these servos.
        """
        is_sure = self._sender.acknowledges or self._has_seen
        return chip.is_ready and (is_sure or not any(servo.count for servo, _ in run))

    def _goal_jobs(self) -> list[tuple]:
        """Return the requests for the goals of all servos with torque, one for channels that follow each other."""
        assert self._goals is not None
        elapsed_us = min(self._now_us - self._sent_us, LONGEST_US)
        self._sent_us = self._now_us
        waiting = [index // PER_LEG for index, servo in enumerate(self._servos) if servo.waits]
        if waiting and self._now_us >= self._next_leg_us:
            self._leg, self._next_leg_us = waiting[0], self._now_us + LEG_US
        runs: list[list] = []  # servos and counts of each
        goals, per_chip = self._next_goals(), self._sender.channels
        for index in sorted(range(len(goals)), key=lambda k: self._servos[k].servo_id):
            servo, goal, speed = self._servos[index], goals[index], self._goals[2][index]
            if not servo.count and not (servo.waits and index // PER_LEG == self._leg):
                continue
            if servo.count and servo.goal is not None and speed:
                most = max(speed * elapsed_us // UNIT_US, 1)
                goal = servo.goal + min(max(goal - servo.goal, -most), most)
            servo.goal = goal
            if not runs or runs[-1][-1][0].servo_id + 1 != servo.servo_id or servo.servo_id % per_chip == 0:
                runs.append([])
            runs[-1].append((servo, self._sender.count(goal)))
        self._keep_turning()
        jobs = []
        if not self._sender.acknowledges and any(servo.count for servo in self._servos):
            while not (servo := self._turn()).count:
                pass
            jobs.append(self._read_back(servo))
        for run in runs:
            first = run[0][0]
            request = self._sender.write(self._chip(first), first.servo_id % per_chip, [count for _, count in run])
            jobs.append((_WRITE, self._chip(first)) + request + (run,))
        return jobs

    def _learn(self, about: tuple, began_us: int, data: bytes | None) -> None:  # type: ignore[override]
        """Process the result of a request, None without an answer."""
        kind, chip, _, _, subject = about
        if kind == _CHANNEL:
            self._has_seen = False
        if data is not None:
            if kind == _CHANNEL:
                self._note_pulses(subject, began_us, data)
            elif kind == _STATUS:
                self._bus.garbled += not self._sender.note_status(chip, subject, data)
            elif kind == _WRITE:
                for servo, count in subject:
                    servo.write(count, self._now_us)
            elif kind == _WAKE:
                chip.is_ready = subject  # by its last request
            elif kind == _OFF:
                for servo in self._servos:
                    if self._chip(servo) is chip:
                        self._note_off(servo)
        if self.mode == wire.ADOPTING and not self._jobs:
            self._end_adopting()

    def _note_off(self, servo: _PulseServo) -> None:
        """Note that the pulses of a servo have ended; without acknowledgement, that this has to be read back."""
        if self._sender.acknowledges:
            servo.lose()
        elif servo.torque:
            servo.torque = None

    def _end_adopting(self) -> None:
        """Leave mode ADOPTING when the pulses of all channels are known, or of none, or when torque off is confirmed."""
        unknown = [servo for servo in self._servos if not servo.is_known]
        if self._off_ordered:
            if all(servo.torque is not None for servo in self._servos):
                self._take_over()
        elif unknown and len(unknown) < len(self._servos):
            self._jobs = [self._read_back(servo) for servo in unknown]
        else:
            self._take_over()

    def _note_pulses(self, servo: _PulseServo, began_us: int, data: bytes) -> None:
        """Compare the pulses of a channel with those written; in mode ADOPTING, adopt them if two readings agree."""
        count, errors = self._sender.found(data)
        servo.error |= errors
        if count < 0:
            self._bus.garbled += 1
            return
        self._has_seen = bool(count)
        is_written, settles = self._are_same(count, servo.count), began_us - servo.written_us < self._sender.settles_us
        if self.mode != wire.OFF and settles and not is_written and self._are_same(count, servo.count_before):
            return
        chip, before, servo.found = self._chip(servo), servo.found, count
        if self.mode == wire.ADOPTING:
            servo.is_known = servo.is_known or count == before
            if chip.sleeps or count == before == 0:
                servo.lose()
            elif count == before and chip.is_ready:
                servo.torque, servo.count, servo.goal = True, count, self._sender.angle(count)
        elif not count and (servo.count or servo.torque is None):
            if before:
                self._jobs.insert(0, self._read_back(servo))
            else:  # twice; before the next goals, which would turn torque on again
                servo.lose()
                self.mode = wire.OFF
                self._jobs = [job for job in self._jobs if job[0] != _WRITE]
        elif not is_written:
            self._bus.garbled += 1
        if count and self._are_same(count, servo.count):
            servo.asked_us, servo.state = began_us, (self._sender.angle(count), 0, 0, 0, 0)

    def _are_same(self, count: int, other: int) -> bool:
        """Return whether two pulses are the same; none are the same as none only."""
        return bool(count) == bool(other) and abs(count - other) <= self._sender.same
