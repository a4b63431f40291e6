"""Fleet proxy: one web address for the consoles of several robots."""
