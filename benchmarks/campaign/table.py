"""The campaign as a table: each claim, its evidence, and whether the present code made it."""

from collections.abc import Mapping

from benchmarks.campaign.evidence import Evidence, Standing, ordered
from benchmarks.campaign.part import Part

_HEADINGS = ("part", "claim", "made", "core-hours", "by this code")


def standings(parts: Mapping[str, Part], found: Mapping[str, Evidence]) -> dict[str, Standing]:
    """Return whether each claim holds by the present code, in the order in which the campaign would run the parts."""
    return {name: Standing.of(parts[name], found.get(name)) for name in ordered(parts, found)}


def in_words(parts: Mapping[str, Part], found: Mapping[str, Evidence], standing: Mapping[str, Standing]) -> str:
    """Return the table in Markdown, and how many claims hold."""
    lines = [f"| {' | '.join(_HEADINGS)} |", "|" + "---|" * len(_HEADINGS)]
    for name, state in standing.items():
        evidence = found.get(name)
        made = evidence.made.words if evidence else "never kept"
        lines.append(f"| `{name}` | {parts[name].claim} | {made} | {_hours(parts[name], evidence)} | {state.words} |")
    holding = sum(state.holds for state in standing.values())
    left = sum(parts[name].core_hours for name, state in standing.items() if not state.holds)
    return "\n".join([*lines, "", f"{holding} of {len(standing)} hold by this code; the others take {left:.0f} core-hours."])


def page(parts: Mapping[str, Part], found: Mapping[str, Evidence]) -> str:
    """Return the table of the documentation: each claim, where it stands, its command, its data and their origin."""
    headings = ("claim", "command", "data", "made", "core-hours")
    lines = [f"| {' | '.join(headings)} |", "|" + "---|" * len(headings)]
    for name, part in parts.items():
        evidence = found.get(name)
        made = ", ".join(filter(None, (evidence.made.words, evidence.machine))) if evidence else "not yet"
        kept = f"`docs/{part.kept}`" if evidence else "none"
        claim = f"[{part.claim}]({part.page}.md)"
        lines.append(f"| {claim} | {part.told} | {kept} | {made} | {_hours(part, evidence)} |")
    return "\n".join(lines)


def _hours(part: Part, evidence: Evidence | None) -> str:
    measured = evidence.core_hours if evidence else 0.0
    return f"{measured:.1f}" if measured else f"about {part.core_hours:g}"
