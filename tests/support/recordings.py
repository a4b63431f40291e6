"""The real recordings, in the folder SEXTANT_DATA or next to the checkout.

A test whose recording is missing is skipped with a message.
"""

import os
from pathlib import Path

import pytest


def recording(name: str, holds: str = "camera.toml") -> Path:
    """Return the folder of a recording, recognized by a file in it."""
    root = Path(os.environ.get("SEXTANT_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
    if not (root / name / holds).is_file():
        pytest.skip(f"recording {name} not found under {root}; set SEXTANT_DATA to the folder that holds it")
    return root / name
