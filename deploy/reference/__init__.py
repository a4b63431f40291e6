"""Generators of the reference pages in docs/: `sextant topics docs PAGE` prints one."""
