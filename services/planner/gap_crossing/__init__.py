"""Crossing a passage step by step: a roadmap over body motions and footholds (Masri 2016, chapter 5)."""
