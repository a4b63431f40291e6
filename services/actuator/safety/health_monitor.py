"""Health limits of servos, battery and computer. Pure: time is an input."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.robot.servo import WARM_K
from sextant.shared.servo.servo_model import Recovery, ServoError, error_words

SILENT = 4  # consecutive unanswered requests from which a servo counts as silent
_QUIET_S = 0.1  # [s] without any reading from which the bus, not one servo, is silent
_MAX_LOSS_SHARE = 0.30  # [1] recent share of requests without a usable answer from which the robot's state is unknown
LATE, LATE_CYCLES = 1.5, 5  # largest cycle time in periods, and number of consecutive cycles that may exceed it
GAP_S = 0.2  # [s] between two cycles from which the robot counts as uncontrolled
_HOT_K = 5.0  # [K] below the servo's own limit, from where the robot lies down
_MAX_WARMING_K_S = 3.0  # [K/s] limit of a rising reading; a stalled motor warms by 1 K/s
_OVERHEATED_S = 0.5  # [s] for which a servo must report an overheating shutdown
_LOW_S, _SETTLED_S = 1.0, 0.3  # [s] for which the voltage must be low, and its time constant
_SLOWER_FROM_LOAD, _SLOWEST_FROM_LOAD = 0.36, 0.50  # [1] recent rms torque, of the stall torque: walk slower; slowest
_LOAD_TIME_CONSTANT_S = 30.0  # [s] of that rms
_MIN_PACE = 0.4  # [1] slowest share of the nominal speed
_RESETS, _WITHIN_S = 3, 300.0  # overload resets per servo, and [s] in which they count
_REST_S = 1.0  # [s] between an overload and its reset
SHUT_DOWN = ServoError.OVERLOAD | ServoError.OVERHEATING
_MINOR = ServoError.INPUT_VOLTAGE  # checked by the voltage itself


@dataclass(frozen=True, slots=True, eq=False)
class Vitals:
    """State of the servos in one cycle."""

    missed: NDArray[np.int64]  # (18,) consecutive unanswered requests
    newest: float  # [s] age of the newest reading of all servos, infinite before the first
    load: Array  # (18,) [N m]
    voltage: Array  # (18,) [V], NaN where never read
    temperature: Array  # (18,) [deg C], NaN where never read
    errors: NDArray[np.uint8]  # (18,) error bits of the newest status packets
    torque_disabled: NDArray[np.bool_]  # (18,) servos without torque
    behind: NDArray[np.bool_]  # (18,) servos that have missed goals and have not caught up yet
    strength: Array  # (18,) torque limit, as a share of its maximum
    loss: float  # share of the requests of the last 200 ms without a usable answer
    trouble: str  # problem of the link to the servos, or an empty string


@dataclass(frozen=True, slots=True)
class Verdict:
    """Reactions to the state of the servos."""

    broken: str = ""  # why no step may be taken now
    sit: str = ""  # why the robot must lie down and turn torque off
    pace: float = 1.0  # share of the nominal speed that is sustainable
    restore_torque: tuple[int, ...] = ()  # servos whose shutdown may end now, at their present position
    warnings: tuple[str, ...] = ()


_WELL = Verdict()


@dataclass(slots=True)
class _Shutdown:
    """Shutdowns of one servo."""

    since: float | None = None  # [s] start of the present one
    hot_since: float | None = None  # [s] when the servo began to report overheating; None if it does not
    counted: list[float] = field(default_factory=list)  # [s] of earlier ones


class Health:
    """Monitors the servos from cycle to cycle."""

    def __init__(self, profile: RobotProfile, period_s: float):
        """Begin with cool, unloaded servos.

        Args:
            profile: The robot.
            period_s: [s] of the control cycle.
        """
        self._profile = profile
        self._period = period_s
        self._voltage = np.nan  # [V] smoothed
        self._low_since: float | None = None
        # [deg C] The filter starts at the warm limit at most, because the first readings may be wrong, too.
        self._stall_torque = profile.servos.stall_torque.ravel()  # [N m]
        self._limit = profile.servos.temperature_limit.ravel()  # [deg C]
        self._temperature: Array = self._limit - WARM_K
        self._effort: Array = np.zeros(18)  # mean square share of the stall torque
        self._late = 0  # consecutive late cycles
        self._reboots = [model.recovery is Recovery.REBOOT for model in profile.servos.models]
        self._shutdowns = [_Shutdown() for _ in range(18)]
        self._shut_down = False  # whether a shutdown of any servo has begun and has not ended

    def follow_rate(self, period_s: float) -> None:
        """Expect cycles of another period [s] from now on."""
        self._period, self._late = period_s, 0

    def update(self, now: float, dt: float, vitals: Vitals, torque: bool) -> Verdict:
        """Evaluate one cycle.

        Args:
            now: [s] monotonic time.
            dt: [s] duration of the last cycle.
            vitals: State of the servos.
            torque: Whether torque should be on.
        """
        self._late = self._late + 1 if dt > LATE * self._period else 0
        # Readings from before a servo, or all of them, fell silent are outdated.
        silent = (vitals.missed >= SILENT) | (vitals.newest > _QUIET_S)
        overloaded = self._overloads(now, vitals.errors, silent, torque)
        share = vitals.load / self._stall_torque
        self._effort += (1.0 - math.exp(-dt / _LOAD_TIME_CONSTANT_S)) * (share * share - self._effort)
        some_silent = bool(np.count_nonzero(silent))
        voltage = np.where(silent, np.nan, vitals.voltage) if some_silent else vitals.voltage
        heat, empty = self._heat(dt, vitals.temperature), self._empty(now, dt, voltage)
        broken: tuple[str, ...] = (vitals.trouble, self._loss(vitals.loss), self._delay(dt))
        weak = ""
        odd = vitals.behind | vitals.torque_disabled | (vitals.strength < 1.0)
        if some_silent or np.count_nonzero(odd) or np.count_nonzero(vitals.errors):
            torque_disabled, weak = self._check_torque(vitals.torque_disabled) if torque else "", self._weak(vitals.strength)
            unknown = (self._silence(vitals), self._loss(vitals.loss), self._behind(vitals.behind), self._delay(dt))
            broken = (*unknown, self._error(vitals.errors), torque_disabled, overloaded.broken, weak if torque else "")
        sit = next((words for words in (overloaded.sit, heat.sit, empty.sit) if words), "")
        return Verdict(
            broken=next((words for words in broken if words), ""),
            sit=sit,
            pace=min(heat.pace, self._fresh()),
            restore_torque=overloaded.restore_torque,
            warnings=(*heat.warnings, *empty.warnings, *filter(None, (weak,))),
        )

    def _silence(self, vitals: Vitals) -> str:
        """Return why the servos cannot be read or commanded, or an empty string."""
        if vitals.trouble:
            return vitals.trouble
        silent = np.flatnonzero(vitals.missed >= SILENT)
        if len(silent) and vitals.newest > _QUIET_S:
            return "no servo answers; check the power of the bus, its cable and the adapter"
        if len(silent):
            return f"{_named(self._profile, silent)} does not answer; check its cable and the cables before it"
        return ""

    def _loss(self, loss: float) -> str:
        """Return that too many answers are lost, or an empty string."""
        if loss <= _MAX_LOSS_SHARE:
            return ""
        share = f"more than {_MAX_LOSS_SHARE:.0%} of the servos' answers"
        return f"{share} are lost or broken; check cables, plugs and the bus voltage"

    def _behind(self, servos: NDArray[np.bool_]) -> str:
        """Return which servos (18,) have missed goals and have not caught up, or an empty string."""
        behind = np.flatnonzero(servos)
        return f"{_named(self._profile, behind)} is catching up with its goal, slowly" if len(behind) else ""

    def _delay(self, dt: float) -> str:
        """Return why the computer cannot control the servos in time, or an empty string."""
        if dt > GAP_S:
            return f"the actuator process did not run for {dt:.1f} s"
        if self._late >= LATE_CYCLES:
            return f"the computer is too slow: {self._late} cycles in a row took more than {LATE * self._period * 1e3:.0f} ms"
        return ""

    def _check_torque(self, torque_disabled: NDArray[np.bool_]) -> str:
        """Return which servos have lost their torque, or an empty string."""
        lost = np.flatnonzero(torque_disabled)
        return f"{_named(self._profile, lost)} has lost its torque; order `ready` to turn it on again" if len(lost) else ""

    def _weak(self, strength: Array) -> str:
        """Return which servos have a reduced torque limit, or an empty string."""
        weak = np.flatnonzero(strength < 1.0)
        if not len(weak):
            return ""
        left = f"{_named(self._profile, weak)} has only {strength[weak].min():.0%} of its torque"
        return f"{left}; order `ready` to restore it"

    def _error(self, errors: NDArray[np.uint8]) -> str:
        """Return which servo reports another error, or an empty string.

        Overload, heat and voltage are evaluated separately.
        """
        for index in np.flatnonzero(errors & ~np.uint8(SHUT_DOWN | _MINOR)).tolist():
            return f"{_named(self._profile, [index])} reports: {error_words(int(errors[index]) & ~int(_MINOR))}"
        return ""

    def _overloads(self, now: float, errors: NDArray[np.uint8], silent: NDArray[np.bool_], torque: bool) -> Verdict:
        """Evaluate servo shutdowns; overload shutdowns are reset a few times."""
        if not (self._shut_down or np.count_nonzero(errors & np.uint8(SHUT_DOWN))):
            return _WELL
        broken, sit, restore_torque = "", "", list[int]()
        for index, shutdown in enumerate(self._shutdowns):
            if silent[index]:
                continue
            error = ServoError(int(errors[index])) & SHUT_DOWN
            if ServoError.OVERHEATING not in error:
                shutdown.hot_since = None
            if not error:
                shutdown.since = None
                continue
            name = _named(self._profile, [index])
            if ServoError.OVERHEATING in error:
                shutdown.hot_since = now if shutdown.hot_since is None else shutdown.hot_since
                broken = f"{name} has shut down because of overheating"
                sit = broken if now - shutdown.hot_since >= _OVERHEATED_S else sit
                continue
            if not torque:
                shutdown.since = None  # evaluated again once torque is ordered on
                continue
            if self._reboots[index]:  # this ends the shutdown, and only an operator's order does it
                broken = broken or f"{name} has shut down because of overload; order `ready` to reboot it"
                continue
            shutdown.since = now if shutdown.since is None else shutdown.since
            # Time at the end of the rest: the decision about a shutdown stays the same while it lasts.
            rested = shutdown.since + _REST_S
            shutdown.counted = [then for then in shutdown.counted if rested - then < _WITHIN_S]
            broken = broken or f"{name} has shut down because of overload"
            if now - shutdown.since < _REST_S:
                continue
            if len(shutdown.counted) >= _RESETS:
                often = f"{_RESETS + 1} times in {_WITHIN_S / 60:.0f} minutes"
                sit = sit or f"{name} has shut down because of overload {often}"
            else:
                shutdown.since = None
                shutdown.counted.append(now)
                restore_torque.append(index)
        self._shut_down = any(one.since is not None or one.hot_since is not None for one in self._shutdowns)
        return Verdict(broken=broken, sit=sit, restore_torque=tuple(restore_torque))

    def _heat(self, dt: float, temperature: Array) -> Verdict:
        """Compare the hottest servo with its limit; the rise of a reading is limited.

        Thus a wrong reading that lasts a second has no effect, and real heat is detected without delay.
        """
        known = ~np.isnan(temperature)
        np.minimum(temperature, self._temperature + _MAX_WARMING_K_S * dt, out=self._temperature, where=known)
        below = float((self._limit - self._temperature).min(where=known, initial=np.inf))
        if below >= WARM_K:
            return _WELL
        hottest = int(np.argmin(np.where(known, self._limit - self._temperature, np.inf)))
        words = f"{_named(self._profile, [hottest])} is {self._temperature[hottest]:.0f} deg C hot"
        pace = max(_MIN_PACE, 1.0 - (1.0 - _MIN_PACE) * (WARM_K - below) / (WARM_K - _HOT_K))
        return Verdict(sit=words if below <= _HOT_K else "", pace=pace, warnings=(f"{words}; walking slower",))

    def _empty(self, now: float, dt: float, voltage: Array) -> Verdict:
        """Evaluate the battery voltage; a short sag does not count."""
        lowest = float(np.fmin.reduce(voltage))
        if math.isnan(lowest):
            self._low_since = None
            return _WELL
        rate = 1.0 - math.exp(-dt / _SETTLED_S)
        self._voltage = lowest if np.isnan(self._voltage) else self._voltage + rate * (lowest - self._voltage)
        battery = self._profile.battery
        if self._voltage >= battery.empty_voltage:
            self._low_since = None
        elif self._low_since is None:
            self._low_since = now
        lasts = self._low_since is not None and now - self._low_since >= _LOW_S
        empty = lasts and lowest < battery.empty_voltage  # and the sag is not over
        if not empty and self._voltage >= battery.warn_voltage:
            return _WELL
        words = f"the battery is low: {self._voltage:.1f} V"
        return Verdict(sit=words if empty else "", warnings=(words,) if self._voltage < battery.warn_voltage else ())

    def _fresh(self) -> float:
        """Return the share of the nominal speed that the recent load allows."""
        worst = math.sqrt(self._effort.max())
        return min(
            1.0,
            max(_MIN_PACE, 1.0 - (1.0 - _MIN_PACE) * (worst - _SLOWER_FROM_LOAD) / (_SLOWEST_FROM_LOAD - _SLOWER_FROM_LOAD)),
        )


def _named(profile: RobotProfile, indices: NDArray[np.int64] | list[int]) -> str:
    """Return servos by leg, joint and id, as the subject of a sentence."""
    first = int(indices[0])
    leg, joint = divmod(first, 3)
    words = f"the {JOINTS[joint]} servo of the {LEGS[leg]} leg (id {profile.servo_ids[leg, joint]})"
    return words if len(indices) == 1 else f"{words}, with {len(indices) - 1} more,"
