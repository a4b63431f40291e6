"""Commands of `sextant`, one file per group.

`sextant.deploy.cli` declares their arguments.
"""
