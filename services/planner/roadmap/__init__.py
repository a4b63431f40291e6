"""Roadmap planner over body motions and footholds (Masri 2016, chapter 5)."""
