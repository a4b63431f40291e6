"""What guard, stop path and permit know of orders alike: when one is of now, and which one the robot walks by. Pure."""

from typing import NamedTuple

from shared.messages import ModeCommand, StopOrder

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
