"""What actuator, guard, stop path and permit know of orders: which are of now, which come first, by which one walks. Pure."""

from collections.abc import Sequence
from typing import NamedTuple

from sextant.shared.wire.messages import ModeCommand, StopOrder

ORDER_AGE_NS = 2_000_000_000  # [ns] by which an order may be older than now, or stamped ahead: else it was put anew
AHEAD_NS = 500_000_000  # [ns] by which the time at which an order was given may be ahead of now, as clocks are read


class WalkOrder(NamedTuple):
    """Who has the robot walk, by which order."""

    holder: str
    sequence: int  # when it was given [ns], by the robot's clock


def is_of_now(order: ModeCommand | StopOrder, now_ns: int) -> bool:
    """Whether an order was said just now, by its stamp, and is none that was recorded and is put again."""
    return abs(now_ns - order.stamp_ns) <= ORDER_AGE_NS


def is_no_time(order: ModeCommand | StopOrder, now_ns: int) -> bool:
    """Whether an order's number is no time of the robot's clock up to now: it bars no later one's way."""
    return order.sequence > now_ns + AHEAD_NS


def in_turn(orders: Sequence[ModeCommand], stops: Sequence[StopOrder]) -> list[ModeCommand | StopOrder]:
    """What came in one cycle, in the order in which it counts: who has torque turned off is heard first.

    So torque rises for no order of before; what else was ordered before that arrived is over, whatever clock it was given by.
    """
    last_off = max((i for i, order in enumerate(orders) if order.mode == "off"), default=-1)
    heard = [order for i, order in enumerate(orders) if i > last_off or order.mode in ("off", "stop")]
    return sorted([*heard, *stops], key=lambda order: (order.mode != "off", isinstance(order, StopOrder)))
