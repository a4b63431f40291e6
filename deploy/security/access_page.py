"""Tables of docs/access.md, generated from the access rules."""

from collections.abc import Iterator

from sextant.shared.wire.access import ROLES, most_hz
from sextant.shared.wire.topics import TOPICS


def roles() -> Iterator[str]:
    """Yield the table of roles and certificates."""
    yield "| role | holder | may command | may stop |"
    yield "|---|---|---|---|"
    for role in ROLES:
        keys = {topic.key for topic in role.publishes}
        may = ("yes" if key in keys else "no" for key in ("operator/mode", "operator/stop"))
        yield f"| `{role.name}` | {role.what} | {' | '.join(may)} |"


def keys() -> Iterator[str]:
    """Yield the table of keys: permissions of each role, and rate and size limits."""
    yield f"| key | {' | '.join(f'`{role.name}`' for role in ROLES)} | at most, Hz | at most, KiB |"
    yield f"|---|{'---|' * len(ROLES)}---|---|"
    for topic in TOPICS:
        may = (
            ", ".join(
                word
                for word, allowed in (("publishes", role.publishes), ("relays", role.relays), ("subscribes", role.subscribes))
                if topic in allowed
            )
            or "–"
            for role in ROLES
        )
        yield f"| `{topic.key}` | {' | '.join(may)} | {most_hz(topic):g} | {topic.max_bytes / 1024:g} |"
