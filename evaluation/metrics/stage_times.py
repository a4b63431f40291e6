"""Stage durations of services, in the format of reports."""

from typing import Any

from sextant.shared.runtime.service import Service


def stages_ms(*services: Service) -> dict[str, dict[str, float]]:
    """Return stage -> 50th and 99th percentile [ms], named as in report.json."""
    found: dict[str, Any] = {}
    for service in services:
        for stage, (p50, p99) in service.stages.percentiles().items():
            if not stage.startswith("latency "):
                name = stage if stage == service.name else f"{service.name}.{stage}"
                found[name] = {"p50": rounded(p50), "p99": rounded(p99)}
    return dict(sorted(found.items()))


def rounded(value: float) -> float:
    """Round to six digits."""
    return round(float(value), 6)
