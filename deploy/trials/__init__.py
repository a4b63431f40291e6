"""Many runs: trials of a scenario, campaigns over all of them, the runs that were kept, and the tables of both."""
