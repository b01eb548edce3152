"""Build the loops so that every mistake in them is found: ``make sanitize`` runs their tests on it.

Each index is checked by Cython, each access to memory by AddressSanitizer, and arithmetic that C
leaves undefined by UndefinedBehaviorSanitizer; gcc on Linux.
"""

from __future__ import annotations

import glob
import os
import sys
from pathlib import Path

from setuptools import Distribution, Extension

from motionstereo_cli.building.backend import DIRECTIVES, LOOPS, SHARED

CHECKED = {
    **DIRECTIVES,
    "boundscheck": True,
    "initializedcheck": True,
    "nonecheck": True,
}
CHECKS = "address,undefined,float-cast-overflow,float-divide-by-zero"
#: Whatever is found ends the process, so that no test passes over it.
OPTIONS = ["-O1", "-g1", "-ffp-contract=off", f"-fsanitize={CHECKS}", "-fno-sanitize-recover=all"]


def build(folder: str) -> Path:
    """Build all loops, and return the folder that ``MOTIONSTEREO_LOOPS`` has to name."""
    from Cython.Build import cythonize

    os.environ["CC"] = "gcc"
    loops = [path for path in glob.glob(f"{LOOPS}/*.py") if Path(path).stem != "__init__"]
    package = LOOPS.replace("/", ".")
    sources = {f"{package}.{Path(path).stem}": path for path in loops}
    extensions = cythonize(
        [
            Extension(
                name,
                [path],
                include_dirs=[LOOPS],
                extra_compile_args=OPTIONS,
                extra_link_args=[f"-fsanitize={CHECKS}"],
            )
            for name, path in {SHARED: f"{folder}/c/shared.c", **sources}.items()
        ],
        build_dir=f"{folder}/c",
        shared_utility_qualified_name=SHARED,
        compiler_directives=CHECKED,
        nthreads=os.cpu_count(),
        quiet=True,
    )
    where = ["--build-lib", folder, "--build-temp", f"{folder}/objects"]
    command = ["build_ext", *where, "--parallel", str(os.cpu_count())]
    made = Distribution({"ext_modules": extensions, "script_args": command})
    made.parse_command_line()
    made.run_commands()
    return Path(folder, LOOPS).resolve()


if __name__ == "__main__":
    print(build(sys.argv[1]))
