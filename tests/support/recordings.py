"""The real recordings: in the folder that SEXTANT_DATA names, or beside the checkout; a test without them is skipped aloud."""

import os
from pathlib import Path

import pytest


def recording(name: str, holds: str = "camera.toml") -> Path:
    """Folder of one of the recordings, known by a file that it holds."""
    root = Path(os.environ.get("SEXTANT_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
    if not (root / name / holds).is_file():
        pytest.skip(f"recording {name} not found under {root}; set SEXTANT_DATA to the folder that holds it")
    return root / name
