"""Other compilers than the one that built the native library take its sources too."""

import shutil

import pytest
from compilers import FLAGS, PROCESSORS, SOURCES, of_processor, run


X86 = ["--target=x86_64-linux-gnu"]
ARM = ["--target=aarch64-linux-gnu"]
COMPILERS = {
    "clang": ["clang++", *X86],
    "clang for AVX2": ["clang++", *X86, *PROCESSORS["avx2"]],
    "clang for AVX-512": ["clang++", *X86, *PROCESSORS["avx512"]],
    "clang for arm64": ["clang++", *ARM],
    "GCC for arm64": ["aarch64-linux-gnu-g++"],
}


@pytest.mark.parametrize("name", COMPILERS)
def test_sources_compile(name, tmp_path):
    compiler, *flags = COMPILERS[name]
    if not shutil.which(compiler):
        pytest.skip(f"needs {compiler}")
    empty = tmp_path / "empty.cc"
    empty.write_text("#include <vector>\n")
    try:
        run(compiler, *flags, "-fsyntax-only", empty)
    except AssertionError:
        pytest.skip(f"{compiler} has no standard library for {flags}")
    for source in SOURCES:
        # The others have nothing that depends on the processor.
        many = of_processor(source)
        what = ("-O1", "-c", "-o", tmp_path / "object.o") if many else ("-fsyntax-only",)
        if many or flags in ([], X86, ARM):
            run(compiler, *FLAGS, *flags, *what, source)
