"""Bundled troubles, one TOML file each: faults that can be added to any course."""
