"""Benchmarks, fault injection, fuzzing and the network testbed; they run in a checkout and are not installed."""
