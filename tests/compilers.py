"""Compile the native library's sources, file by file."""

import importlib.util
import pathlib
import subprocess

import jaxcloseup


FOLDER = pathlib.Path(jaxcloseup.__file__).parent / "native"
SOURCES = sorted(FOLDER.glob("*.cc"))
HEADERS = pathlib.Path(importlib.util.find_spec("jaxlib").origin).parent / "include"
FLAGS = ("-std=c++17", "-ffp-contract=off", "-Wno-psabi", f"-I{FOLDER}", "-isystem", str(HEADERS))
PROCESSORS = {
    "baseline": (),
    "avx2": ("-mavx2", "-mfma"),
    "avx512": ("-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma"),
}


def of_processor(source):
    """Return whether a file is compiled for several processors."""
    return "#ifndef ISA" in source.read_text(encoding="utf-8")


def run(*command):
    """Run a command that must end well; what it says is the failure's text."""
    command = [str(word) for word in command]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr[-4000:]}"
    return done.stdout
