"""Observers of a run, live or in lockstep: scripted operator and monitor."""
