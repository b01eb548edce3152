"""The build backend: setuptools, and Cython for the loops in ``motionstereo_cli/compiled``.

What is published is made here too: a README whose links lead to the project's address, and a source
distribution with all that ``make`` needs.

Without a C compiler the build requires and uses that of the package ``ziglang``.
"""

from __future__ import annotations

import copy
import glob
import os
import platform
import re
import shlex
import shutil
import sys
import sysconfig
import zlib
from pathlib import Path
from typing import Any

from setuptools import Extension
from setuptools.build_meta import *  # noqa: F403  # the unchanged hooks
from setuptools.build_meta import (
    get_requires_for_build_editable as _setuptools_for_editable,
)
from setuptools.build_meta import get_requires_for_build_wheel as _setuptools_for_wheel
from setuptools.command.build_ext import build_ext
from setuptools.command.egg_info import egg_info
from setuptools.command.sdist import sdist

LOOPS = "motionstereo_cli/compiled"

#: Shared code of the loops, compiled once.
SHARED = "motionstereo_cli.compiled.shared"

#: A loop file that needs vector types, which the compiler of Windows does not have.
VECTORS = "vectors"

#: Cython directives: no bounds checks, C division.
DIRECTIVES = {
    "language_level": "3",
    "boundscheck": False,
    "wraparound": False,
    "cdivision": True,
    "initializedcheck": False,
}


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return the requirements of a build: also ziglang where there is no C compiler."""
    return [*_setuptools_for_wheel(config_settings), *_zig()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """Return the same for an editable install."""
    return [*_setuptools_for_editable(config_settings), *_zig()]


def _zig() -> list[str]:
    return ["ziglang>=0.13"] if _compiler() is None else []


def _compiler() -> str | None:
    """Return the installed C compiler, "" for that of Windows; None without one."""
    if sys.platform == "win32":
        return ""  # setuptools looks for it, and says where to get it
    configured = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    for command in (configured, "cc", "gcc", "clang"):
        if shutil.which(shlex.split(command)[0]):
            return command
    return None


def _variants(*, zig: bool) -> dict[str, list[str]]:
    """Return the compiler options of each build of the loops, by its folder.

    Products and sums are never fused, so that results are equal on every machine. Loops over many
    arrays become vectors, after GCC has made sure that none overlaps another.
    """
    if sys.platform == "win32":
        return {"baseline": ["/O2", "/fp:precise"]}
    common = ["-O3", "-g0", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
    common += ["--param", "vect-max-version-for-alias-checks=60"]
    variants = {"baseline": [*common, *["-mcpu=baseline"] * zig]}
    if sys.platform == "linux" and platform.machine() == "x86_64":
        variants["v3"] = [*common, "-mcpu=x86_64_v3" if zig else "-march=x86-64-v3"]
    return variants


def _name(module: str) -> str:
    return f"{LOOPS.replace('/', '.')}.{module}"


class BuildLoops(build_ext):
    """Compiles each loop file for every kind of machine; ``build_ext`` of setuptools."""

    def finalize_options(self) -> None:
        """Find and translate the loop files."""
        from Cython.Build import cythonize

        compiler = _compiler()
        if compiler:
            os.environ["CC"] = compiler
        names = {Path(path).stem for path in glob.glob(f"{LOOPS}/*.py")} - {"__init__"}
        if sys.platform == "win32":
            names.discard(VECTORS)
        translated = cythonize(
            [
                Extension(SHARED, ["build/cython/shared.c"]),
                *(Extension(_name(n), [f"{LOOPS}/{n}.py"]) for n in sorted(names)),
            ],
            build_dir="build/cython",
            shared_utility_qualified_name=SHARED,
            compiler_directives=DIRECTIVES,
            quiet=True,
        )
        # Cython copies headers, and does not renew the copies of those that headers include.
        for copied in glob.glob(f"build/cython/{LOOPS}/*.h"):
            os.remove(copied)
        self.distribution.ext_modules = [
            Extension(
                _name(f"{variant}.{extension.name.rsplit('.', 1)[1]}"),
                extension.sources,
                include_dirs=[LOOPS],
                depends=glob.glob(f"{LOOPS}/*.h"),
                extra_compile_args=options,
            )
            for variant, options in _variants(zig=compiler is None).items()
            for extension in translated
            if variant == "baseline" or extension.name != SHARED
        ]
        super().finalize_options()

    def run(self) -> None:
        """Compile, and record the hash of the sources."""
        for variant in _variants(zig=False):
            os.makedirs(f"{LOOPS}/{variant}", exist_ok=True)
        super().run()
        paths = sorted(path for end in ("py", "pxd", "h") for path in glob.glob(f"{LOOPS}/*.{end}"))
        sources = b"".join(Path(path).read_bytes() for path in paths)
        first = Path(self.get_ext_fullpath(_name("baseline.shared")))
        (first.parent / "checksum").write_text(str(zlib.crc32(sources)), encoding="ascii")

    def build_extension(self, ext: Extension) -> None:
        """Compile into a folder for the kind of machine: objects are named by their source."""
        apart = copy.copy(self)  # several are compiled at the same time
        apart.build_temp = os.path.join(self.build_temp, ext.name.split(".")[-2])
        super(BuildLoops, apart).build_extension(ext)

    def build_extensions(self) -> None:
        """Compile with zig if there is no other compiler."""
        if _compiler() is None:
            os.environ.setdefault("ZIG_GLOBAL_CACHE_DIR", os.path.abspath("build/zig"))
            zig = [sys.executable, "-m", "ziglang", "cc"]
            shared = ["-shared"]
            if sys.platform == "darwin":
                shared = ["-bundle", "-undefined", "dynamic_lookup"]
            self.compiler.set_executables(
                compiler_so=[*zig, "-fPIC", "-DNDEBUG", "-w"], linker_so=[*zig, *shared]
            )
        super().build_extensions()


def with_full_links(page: str, address: str, version: str) -> str:
    """Return a Markdown page of the checkout with full addresses, as other sites need them.

    Args:
        page: links and pictures are paths from the checkout's root.
        address: of the repository, on a site with the addresses of GitHub.
        version: the release that links lead to.
    """

    def full(link: re.Match[str]) -> str:
        kind = "raw" if link[1] else "blob"
        return f"{link[1]}[{link[2]}]({address}/{kind}/v{version}/{link[3]})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)\s]+)\)", full, page)


class Metadata(egg_info):
    """Writes the metadata, with the README as the package index shows it."""

    def run(self) -> None:
        """Put full addresses into the README."""
        about = self.distribution.metadata
        address = self.distribution.metadata.project_urls["Source"]
        about.long_description = with_full_links(
            about.long_description, address, about.get_version()
        )
        super().run()


class WholeCheckout(sdist):
    """Makes the source distribution: ``make demo`` and ``make test`` run in it."""

    def make_distribution(self) -> None:
        """Add what is no part of the package."""
        files = {*self.filelist.files, "Makefile", "CHANGELOG.md", ".gitignore"}
        files.update(path for end in ("pxd", "h") for path in glob.glob(f"{LOOPS}/*.{end}"))
        for folder in (".ci", ".github", "tests", "sample_data", "motionstereo_cli/building"):
            for place, _, names in os.walk(folder):
                files.update(os.path.join(place, name) for name in names)
        self.filelist.files = sorted(path for path in files if "__pycache__" not in path)
        super().make_distribution()
