"""Arbitration between clients that give orders. Pure: time is an input.

One holder of the lease at a time may move the legs; any client may order `stop` or `off`. The rules are:

* A repeated order only keeps the lease.
* Any client may stop. A stop with `take_over` also transfers the lease to its sender.
* An order needs a current stamp. A replayed recording neither moves the legs nor keeps a lease, even after this process has
  restarted and remembers no orders.
* A stop without a current stamp is obeyed unless a newer order of its holder is known. A stop with a current stamp is obeyed
  unless a newer stop of its holder is known.
* A stop with invalid or outdated numbers has no other effect than to stop.
* An order first received long after its sequence, as after a link outage, only lets a standing robot resume its walk.
* A walk order from before the start of this process is resumed only if it was in force when the previous process ended.
"""

from typing import NamedTuple

from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS, WalkOrder, is_no_time, is_of_now
from sextant.shared.wire.messages import ModeCommand, StopOrder

LEASE_NS = 3_000_000_000  # [ns] that a lease lasts without an order; repeated orders extend it
AWAY_NS = 30_000_000_000  # [ns] of silence after which the lease holder needs a new order to walk
_HOLDERS = 16  # number of clients whose orders are remembered; orders of further clients are refused, except stops
_STOPS = ("off", "stop")  # orders that any client may give


class Ruling(NamedTuple):
    """Decision about an order."""

    is_obeyed: bool
    objection: str | None = None  # why it is not obeyed, or an empty string; None: the last objection stays


class CommandArbiter:
    """Decides which orders are obeyed; keeps the lease and the walk order in force."""

    def __init__(self, begun_ns: int, off_ns: int = -1, walk: WalkOrder | None = None):
        """Begin without a lease.

        Args:
            begun_ns: [ns] time of the start.
            off_ns: [ns] time of the torque-off order that is still in force; -1 without one.
            walk: The walk order that was in force when the previous process ended.
        """
        self.holder = ""  # of the lease, which may have expired
        self.off_ns = off_ns  # when torque last went off, by an order or automatically; older orders do not turn it on
        self.given_ns = -1  # when the newest valid and permitted order was given
        self.may_walk = False  # whether a walk is ordered
        self._walk = walk  # the walk order in force; after a start its holder may not have repeated it yet
        self._begun_ns = begun_ns
        self._heard_ns = 0  # when the last order of the holder arrived
        self._woke_ns = -1  # when the computer last resumed from suspend
        self._sequences: dict[str, int] = {}  # newest order of each holder
        self._stops: dict[str, int] = {}  # newest stop of each client, which need not hold the lease

    # ------------------------------------------------------------------------------------------------------------ state

    def lease(self, now_ns: int) -> str:
        """Return the holder of the lease, or an empty string."""
        return self.holder if now_ns - self._heard_ns <= LEASE_NS else ""

    def walk_order(self, now_ns: int) -> WalkOrder | None:
        """Return the walk order that a restarted actuator may resume, or None.

        There is none once the order has ended for any reason.
        """
        heard_ns = self._heard_ns if self.may_walk else self._begun_ns
        return self._walk if now_ns - heard_ns <= AWAY_NS else None

    def begin_walk(self) -> None:
        """Put the newest order in force as a walk order of the lease holder."""
        self.may_walk, self._walk = True, WalkOrder(self.holder, self.given_ns)

    def end_walk(self) -> None:
        """End the walk order, also for a restarted process."""
        self.may_walk, self._walk = False, None

    def turn_off(self, now_ns: int) -> None:
        """Note that torque goes off now: older orders do not turn it on."""
        self.off_ns = max(self.off_ns, now_ns)

    def resume_from_suspend(self, now_ns: int) -> None:
        """End the lease; orders from before `now_ns` do not count."""
        self.holder, self._woke_ns = "", now_ns

    # ----------------------------------------------------------------------------------------------------------- orders

    def rule(self, order: ModeCommand, now_ns: int, torque_is_off: bool) -> Ruling:
        """Decide about an order."""
        if order.sequence == self._sequences.get(order.holder):
            return Ruling(False, self._handle_repeated(order, now_ns))
        invalid, stops = self._invalid_reason(order, now_ns), order.mode in _STOPS
        if invalid:
            return self._rule_invalid_stop(order, now_ns) if stops else Ruling(False, invalid)
        stranger = order.holder not in self._sequences and not self._has_room(now_ns)
        if not stranger:
            self._sequences[order.holder] = order.sequence
        refused = "" if stops else self._late_order(order, now_ns, torque_is_off)
        if not refused and (order.take_over or not stops):
            refused = self._claim(order, now_ns, stranger)
        if refused and not stops:
            return Ruling(False, refused)
        if order.holder == self.holder:
            self._heard_ns = now_ns
        if order.mode == "off":  # robust to wrong clocks
            self.off_ns = max(self.off_ns, min(max(order.sequence, self.given_ns + 1), now_ns))
        if stops:
            self._is_new(order)
        self.given_ns = order.sequence
        return Ruling(True, "")

    def rule_stop(self, order: StopOrder, now_ns: int) -> bool:
        """Return whether a stop or torque-off order of any client is obeyed.

        It takes no lease, and it does not extend how long its sender is remembered.
        """
        if not self._is_new(order):
            return False
        if order.mode == "off":
            self.turn_off(now_ns)
        return True

    def _is_new(self, stop: ModeCommand | StopOrder) -> bool:
        """Return whether a stop differs from its holder's last one, and remember it.

        The holder that was silent longest is forgotten.
        """
        known = self._stops.pop(stop.holder, None)
        self._stops[stop.holder] = stop.sequence
        if len(self._stops) > _HOLDERS:
            del self._stops[next(iter(self._stops))]
        return stop.sequence != known

    def _invalid_reason(self, order: ModeCommand, now_ns: int) -> str:
        """Return why the times of an order are not current, or an empty string."""
        if not is_of_now(order, now_ns):
            return _untimely(order, now_ns)
        if order.sequence < self._sequences.get(order.holder, order.sequence):
            return _older(order)
        if is_no_time(order, now_ns):
            return (
                f"`{order.mode}` of {order.holder} refused: its sequence number, the time of the order [ns], lies in the future"
            )
        return ""

    def _rule_invalid_stop(self, order: ModeCommand, now_ns: int) -> Ruling:
        """Obey a stop with invalid times, unless it is known or may be a replay."""
        older = order.sequence < self._sequences.get(order.holder, order.sequence)
        if older and (not is_of_now(order, now_ns) or order.sequence <= self._stops.get(order.holder, -1)):
            return Ruling(False, _older(order))
        mode = order.mode
        assert mode == "off" or mode == "stop"
        return Ruling(self.rule_stop(StopOrder(order.stamp_ns, mode, order.sequence, order.holder), now_ns))

    def _has_room(self, now_ns: int) -> bool:
        """Return whether one more holder can be remembered.

        If necessary, forget a holder with an expired order.
        """
        if len(self._sequences) < _HOLDERS:
            return True
        oldest = min((holder for holder in self._sequences if holder != self.holder), key=self._sequences.__getitem__)
        if now_ns - self._sequences[oldest] <= AWAY_NS:
            return False
        del self._sequences[oldest]
        return True

    def _handle_repeated(self, order: ModeCommand, now_ns: int) -> str | None:
        """Keep the lease by a repeated order of its holder; return an objection, or None.

        After a long silence it restores the lease, but not the walk.
        """
        if not is_of_now(order, now_ns):
            return None if order.mode in _STOPS else _untimely(order, now_ns)
        if order.holder != self.holder:
            return None
        silent_ns, self._heard_ns = now_ns - self._heard_ns, now_ns
        if not self.may_walk or silent_ns <= AWAY_NS:
            return None
        self.end_walk()
        return f"`walk` of {self.holder} refused: no order was received for {silent_ns * 1e-9:.0f} s; order it again"

    def _late_order(self, order: ModeCommand, now_ns: int, torque_is_off: bool) -> str:
        """Return why a newly received motion order is too old, or an empty string."""
        age_ns = now_ns - order.sequence
        gone = f"`{order.mode}` of {order.holder} refused: by its sequence number, the robot's time [ns], it was given"
        if torque_is_off and order.sequence < self.off_ns:
            return f"{gone} before torque went off; order it again"
        if order.mode == "walk" and order.sequence < self._begun_ns:
            resumes = self.walk_order(now_ns) == WalkOrder(order.holder, order.sequence)
            return "" if resumes else f"{gone} before this actuator started, and was not in force at that time; order it again"
        if order.sequence <= self._woke_ns:
            return f"{gone} before the computer was suspended; order it again"
        lasting = AWAY_NS if order.mode == "walk" else ORDER_AGE_NS
        return f"{gone} {age_ns * 1e-9:.1f} s ago; order it again" if age_ns > lasting else ""

    def _claim(self, order: ModeCommand, now_ns: int, stranger: bool) -> str:
        """Give the lease to the sender of an order; return why not, or an empty string."""
        holder, refused = self.lease(now_ns), f"`{order.mode}` of {order.holder} refused"
        if stranger:
            return f"{refused}: {_HOLDERS} other clients gave orders within {AWAY_NS * 1e-9:.0f} s"
        if holder and holder != order.holder and not order.take_over:
            return f"{refused}: {holder} holds the lease; take it over, or wait until it expires"
        if order.holder != self.holder:
            self.end_walk()
        self.holder, self._heard_ns = order.holder, now_ns
        return ""


def _older(order: ModeCommand) -> str:
    return f"`{order.mode}` of {order.holder} refused: a newer order was given under this name; each client needs its own name"


def _untimely(order: ModeCommand, now_ns: int) -> str:
    """Return the message that an order is not current."""
    age_ns = now_ns - order.stamp_ns
    when = f"{age_ns * 1e-9:.1f} s old" if age_ns > 0 else f"stamped {-age_ns * 1e-9:.1f} s in the future"
    allowed = f"at most {ORDER_AGE_NS * 1e-9:.0f} s allowed; stamp orders by the robot's clock"
    return f"`{order.mode}` of {order.holder} refused: it is {when}, {allowed}"
