"""Generators of the reference pages in docs/: `python -m docs.reference` writes them."""
