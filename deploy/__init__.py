"""The process table, the command line and what that does: launch, meet, run, judge, draw, repeat, measure."""
