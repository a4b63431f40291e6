"""Many runs: trials of a scenario, campaigns, stored results and tables."""
