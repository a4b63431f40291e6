"""Build of a wheel that contains the compiled inner loops: see `make wheel`.

`SEXTANT_COMPILE` in the environment is an interpreter that has what the extra `all` needs. The wheel then has the name of its
platform, since each kind of machine has another one. Without it nothing is compiled, and the wheel is for any platform.
"""

import os
import subprocess
import sysconfig
import tempfile
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

# Folders of packages, and of `math`.
PLACES = "import sysconfig as s; print(s.get_path('purelib'), s.get_config_var('DESTSHARED'), sep='\\n')"


class CompiledBuild(build_py):
    """Compiles in the folder that becomes the wheel."""

    def run(self) -> None:
        """Build, then compile if asked to."""
        super().run()
        python = os.environ.get("SEXTANT_COMPILE")
        if python and not self.editable_mode:
            found = subprocess.run([python, "-c", PLACES], capture_output=True, text=True, check=True).stdout.splitlines()
            with tempfile.TemporaryDirectory(prefix="sextant-") as folder:
                # Compiled code holds the names of its files, of NumPy and of `math`: none of the builder's own folders.
                links = [Path(folder, name) for name in ("lib", "packages", "dynload")]
                for link, place in zip(links, (str(Path(self.build_lib).resolve()), *found), strict=True):
                    link.symlink_to(place)
                around = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, links)), "PYTHONDONTWRITEBYTECODE": "1"}
                around.pop("NUMBA_CACHE_DIR", None)  # the code belongs next to its source
                subprocess.run([python, "-m", "sextant.deploy.launch.warm_up"], cwd=folder, env=around, check=True)


compiled = {"bdist_wheel": {"plat_name": sysconfig.get_platform()}} if os.environ.get("SEXTANT_COMPILE") else {}
setup(cmdclass={"build_py": CompiledBuild}, options=compiled)
