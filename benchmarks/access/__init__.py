"""Access control under attack: unauthorized, replayed, malformed and extreme messages."""
