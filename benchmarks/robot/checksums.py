"""Odds of the checksum of each servo family, and wrong values that the driver accepts.

Emulated servos move at random while a share of their answers is spoilt. The driver reads them in cycles of 20 ms, in memory, in
simulated time, and all values that it accepts are compared with the state of its servo. A checksum of one byte accepts one of
256 random errors, a CRC of two bytes one of 65 536 and no error of two bits. Boards of hobby servos have none.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from random import Random

from benchmarks.peers import kept
from benchmarks.robot.checksum_rigs import ONE_SENDER, RIGS
from benchmarks.robot.spoilt_answers import OF_ANOTHER, WAYS, Found
from sextant.shared.servo.models import MODELS

_FAMILIES = {id(model.table): model.name for model in reversed(MODELS)}  # one model for each control table
KINDS = (*reversed(_FAMILIES.values()), *(name for name in RIGS if name not in {model.name for model in MODELS}))


def measure(answers: int, seed: int, kinds: tuple[str, ...] = (), say: Callable[[str], None] = lambda _: None) -> list[Found]:
    """Read servos of each kind while their answers are spoilt in each way.

    Args:
        answers: Minimum number of answers of each kind in each way.
        seed: Random seed.
        kinds: Servo models or other names of `RIGS`; empty for one model of each family, and all others.
        say: Called with the progress.
    """
    found = []
    for kind in kinds or KINDS:
        say(f"{kind}: {answers} answers in each of {len(WAYS)} ways")
        found += [run(kind, way, answers, Random(f"{seed} {kind} {way}")) for way in WAYS if has_way(kind, way)]
    return found


def has_way(kind: str, way: str) -> bool:
    """Return whether answers of servos can be spoilt in a way: some have one sender only."""
    return way != OF_ANOTHER or kind not in ONE_SENDER


def run(kind: str, name: str, answers: int, rng: Random) -> Found:
    """Spoil answers of one kind of servos in one way, until there are at least `answers` of them."""
    found = Found(kind, name, expected=0.0, most_wrong=0.0)
    rig = RIGS[kind](WAYS[name], rng, found)
    while found.answers < answers:
        rig.exchange()
    return found


def in_words(found: Sequence[Found]) -> str:
    """Return a table in Markdown, a row for each kind of servos, and what exceeds the odds."""
    ways = list(dict.fromkeys(one.way for one in found))
    lines = [f"| servo | {' | '.join(ways)} |", "|---" * (1 + len(ways)) + "|"]
    for model in dict.fromkeys(one.model for one in found):
        cells = {one.way: _cell(one) for one in found if one.model == model}
        lines.append(f"| {model} | {' | '.join(cells.get(way, '') for way in ways)} |")
    believed = [one for one in found if one.most_wrong is not None]
    kinds = Counter[str]()
    for one in believed:
        kinds.update(one.wrong)
    listed = ", ".join(f"{number} of {kind}" for kind, number in kinds.most_common()) or "none"
    lines += [
        "",
        f"Intact by their checksum, of the spoilt answers; in parentheses readings and registers with a wrong value that were "
        f"believed. Wrong values besides those of old answers: {listed}; positions at most "
        f"{max((one.position_off_deg for one in believed), default=0.0):.1f} deg off. "
        f"At least {min(one.answers for one in found)} answers of each kind each way, with "
        f"{min(one.readings + one.registers for one in found)} values and more that were believed.",
    ]
    for one in found:
        if not one.passed:
            lines.append(
                f"More than the odds allow: {one.model}, {one.way}, {one.intact} intact of {one.expected} expected at most, "
                f"{one.wrong_readings} wrong of {one.most_wrong}."
            )
    return "\n".join(lines)


def _cell(one: Found) -> str:
    return f"{one.intact} of {one.spoilt}" + (f" ({one.wrong_readings})" if one.wrong_readings else "")


def to_json(found: Sequence[Found]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Found]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Found)
