"""Run services live or in lockstep, with clocks, watchdog and shutdown."""
