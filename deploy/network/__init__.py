"""Who meets whom at which router, and who is let in."""
