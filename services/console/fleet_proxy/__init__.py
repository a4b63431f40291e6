"""The lobby: one address in front of the consoles of several robots."""
