"""Recordings through the real services: what comes of them now, beside what came of them then."""
