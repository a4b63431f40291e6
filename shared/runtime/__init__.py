"""Run services: live over Zenoh or in lockstep, with clocks, watchdog and shutdown."""
