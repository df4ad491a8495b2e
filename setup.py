"""Builds the native library, if there is a compiler; everything else is in pyproject.toml."""

import importlib.util
import pathlib
import platform

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError


FOLDER = pathlib.Path("jaxcloseup/native")
FLAGS = ["-std=c++17", "-O3", "-g0", "-ffp-contract=off", "-fvisibility=hidden", "-Wno-psabi"]
# The files that are compiled for several processors, of which one is chosen when it is loaded.
OF_PROCESSOR = [
    str(FOLDER / f"{name}.cc")
    for name in (
        *("gather_block", "splat_project", "splat_reach", "splat_tiles"),
        *("ssim_rows", "stereo_rows"),
    )
]
PROCESSORS = {"baseline": []}
if platform.machine() in ("x86_64", "AMD64"):
    PROCESSORS |= {
        "avx2": ["-mavx2", "-mfma"],
        "avx512": ["-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma"],
    }


class BuildNative(build_ext):
    """Compiles a library that XLA calls, not Python: no header of Python is needed."""

    def build_extension(self, extension):
        """Compile the library's files, some several times, and link them."""
        jaxlib = importlib.util.find_spec("jaxlib")
        if jaxlib is None:
            raise CompileError("the headers of jaxlib are missing")
        self.compiler.include_dirs = []
        common = [*FLAGS, "-isystem", str(pathlib.Path(jaxlib.origin).parent / "include")]
        options = {"output_dir": self.build_temp, "depends": extension.depends}
        once = [source for source in extension.sources if source not in OF_PROCESSOR]
        objects = self.compiler.compile(once, extra_postargs=common, **options)
        for name, flags in PROCESSORS.items():
            options["output_dir"] = str(pathlib.Path(self.build_temp, name))
            extra = [*common, *flags, f"-DISA={name}"]
            objects += self.compiler.compile(OF_PROCESSOR, extra_postargs=extra, **options)
        target = pathlib.Path(self.get_ext_fullpath(extension.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        self.compiler.link_shared_object(objects, str(target), target_lang="c++")

    def get_ext_filename(self, fullname):
        """Return the library's file; by its dot nothing takes it for a module of Python."""
        return str(pathlib.Path(*fullname.split("."))) + ".lib.so"


class AnyPython(bdist_wheel):
    """Makes wheels for one platform and any Python."""

    def get_tag(self):
        """Return the wheel's tags."""
        *_, machine = super().get_tag()
        return "py3", "none", machine


setup(
    ext_modules=[
        Extension(
            "jaxcloseup.native._native",
            sources=sorted(str(path) for path in FOLDER.glob("*.cc")),
            depends=sorted(str(path) for path in FOLDER.glob("*.h")),
            language="c++",
            optional=True,  # without a compiler everything runs in loops of `jax.lax`
        )
    ],
    cmdclass={"build_ext": BuildNative, "bdist_wheel": AnyPython},
)
