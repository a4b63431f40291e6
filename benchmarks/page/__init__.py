"""The operator page in a real browser: stop latency and cost."""
