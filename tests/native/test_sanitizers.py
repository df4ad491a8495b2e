"""The native library stays in bounds and does nothing undefined, whatever it is given."""

import pathlib
import shutil
import subprocess

import pytest
from compilers import FLAGS, PROCESSORS, SOURCES, of_processor, run


HERE = pathlib.Path(__file__).parent
COMPILER = shutil.which("g++") or shutil.which("clang++")
SANITIZE = (
    *("-O0", "-g1", "-pthread", "-fno-sanitize-recover=all"),
    "-fsanitize=address,undefined,float-cast-overflow",
)
# Of the functions for several processors only those of one are in a program.
ONE = "-D__builtin_cpu_supports(name)=false"
CASES = 200


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with everything compiled that is the same on all processors."""
    folder = tmp_path_factory.mktemp("objects")
    (folder / "empty.cc").write_text("int main() {}")
    probe = [COMPILER, *SANITIZE, str(folder / "empty.cc"), "-o", str(folder / "empty")]
    if not COMPILER or subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("needs g++ or clang++ with its sanitizers")
    # What draws input is compiled at once, as its headers take longest.
    fuzz = folder / "fuzz.cc"
    fuzz.write_text("".join(f'#include "{path}"\n' for path in sorted(HERE.glob("*.cc"))))
    for source in [fuzz, *SOURCES]:
        if not of_processor(source):
            build(source, folder / f"{source.stem}.o", ONE)
    return folder


def build(source, target, *flags):
    run(COMPILER, *FLAGS, *SANITIZE, "-w", *flags, "-c", source, "-o", target)


@pytest.mark.parametrize("processor", ["baseline", "avx2"])
def test_drawn_input_breaks_nothing(processor, folder):
    """All functions, on one thread and on four, whose results must be the same to the last bit."""
    about = pathlib.Path("/proc/cpuinfo")
    if PROCESSORS[processor] and not (about.exists() and f" {processor} " in about.read_text()):
        pytest.skip(f"needs a processor with {processor}")
    own = folder / processor
    own.mkdir()
    for source in filter(of_processor, SOURCES):
        build(source, own / f"{source.stem}.o", *PROCESSORS[processor])
    objects = [*folder.glob("*.o"), *own.glob("*.o")]
    run(COMPILER, *SANITIZE, *objects, "-o", own / "fuzz")
    assert run(own / "fuzz", CASES) == f"{CASES} cases\n"
