"""Largest numbers of blocks and steps of one part of a terrain."""

from sextant.shared.files import config

MAX_BLOCKS = 500  # randomly placed blocks of one primitive; each is tested against all others, which takes time
BLOCK_COUNT = config.each("count", lambda count: 1 <= count <= MAX_BLOCKS, f"a count from 1 to {MAX_BLOCKS}")
STEP_COUNT = config.each("count", lambda count: 1 <= count <= 1000, "a count from 1 to 1000")
