"""Bundled troubles, one TOML file each: faults and deviations that can be added to any course."""
