"""Checks of an order's age, validity and sequence. Pure.

Actuator, guard, stop path and walk authorization share them.
"""

from collections.abc import Sequence
from typing import NamedTuple

from sextant.shared.wire.messages import ModeCommand, StopOrder

ORDER_AGE_NS = 2_000_000_000  # [ns] largest difference between an order's stamp and now; beyond it, the order is a replay
AHEAD_NS = 500_000_000  # [ns] by which an order's time may be ahead of now, because of clock reading errors


class WalkOrder(NamedTuple):
    """Holder and time of the walk order in force."""

    holder: str
    sequence: int  # [ns] when it was given, by the robot's clock


def is_of_now(order: ModeCommand | StopOrder, now_ns: int) -> bool:
    """Return whether the stamp of an order is current, so that it is no replay."""
    return abs(now_ns - order.stamp_ns) <= ORDER_AGE_NS


def is_no_time(order: ModeCommand | StopOrder, now_ns: int) -> bool:
    """Return whether an order's sequence is ahead of the robot's clock.

    Such a sequence must not block later orders.
    """
    return order.sequence > now_ns + AHEAD_NS


def in_turn(orders: Sequence[ModeCommand], stops: Sequence[StopOrder]) -> list[ModeCommand | StopOrder]:
    """Sort the orders of one cycle for execution: torque-off orders come first.

    Thus no earlier order turns torque on. All orders before the last `off` are dropped, except stops. Their clocks do not
    matter.
    """
    last_off = max((i for i, order in enumerate(orders) if order.mode == "off"), default=-1)
    heard = [order for i, order in enumerate(orders) if i > last_off or order.mode in ("off", "stop")]
    return sorted([*heard, *stops], key=lambda order: (order.mode != "off", isinstance(order, StopOrder)))
