"""Robot profiles that come with Sextant, one TOML file each."""
