"""Topics: listen, print and measure."""
