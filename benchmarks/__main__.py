"""Run `python -m benchmarks`."""

import os
import sys
from pathlib import Path

from benchmarks.cli import main

if __name__ == "__main__":
    root = str(Path(__file__).parents[1])  # the processes that a benchmark starts import this package, too
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", ""))))
    sys.exit(main())
