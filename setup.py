"""Build of a wheel that contains the compiled inner loops: see `make wheel`.

`SEXTANT_COMPILE` in the environment is an interpreter that has what the extra `all` needs. Without it nothing is compiled.
"""

import os
import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class CompiledBuild(build_py):
    """Compiles in the folder that becomes the wheel."""

    def run(self) -> None:
        """Build, then compile if asked to."""
        super().run()
        python = os.environ.get("SEXTANT_COMPILE")
        if python and not self.editable_mode:
            around = os.environ | {"PYTHONPATH": str(Path(self.build_lib).resolve()), "PYTHONDONTWRITEBYTECODE": "1"}
            around.pop("NUMBA_CACHE_DIR", None)  # the code belongs next to its source
            subprocess.run([python, "-m", "sextant.deploy.launch.warm_up"], cwd=self.build_lib, env=around, check=True)


setup(cmdclass={"build_py": CompiledBuild})
