"""Bundled families of terrain, each with one parameter from easy to impossible."""
