"""Commands of `sextant`: typed functions, with their options, arguments and help.

`options` has what several of them share. Each imports what takes long when it runs.
"""
