"""One run from start to report, in lockstep or live, with its observers."""
