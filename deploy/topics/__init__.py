"""Topics: listen, print, measure, and document them."""
