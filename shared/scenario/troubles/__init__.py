"""Troubles that come with Sextant, one TOML file each: what goes wrong on whatever course."""
