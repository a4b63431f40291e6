"""Command line, process table, launch, runs, evaluation, pictures and benchmarks."""
