"""A whole run from start to report, in lockstep or live, with who attends it."""
