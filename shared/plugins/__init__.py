"""Plug-ins: algorithms of other packages in place of Sextant's own.

A plug-in replaces the score of footholds, the planner of steps, or the registration of depth frames. Its interface is in the
module of that name; `loading` finds it. Everything else of the walk stays, so results are comparable.
"""
