"""Scenarios that come with Sextant, one TOML file each."""
