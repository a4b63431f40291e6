"""Lockstep runs, trials, metrics, figures, videos and replays; no live processes."""
