"""What becomes of freed memory, in a process of its own: the setting is the whole process's."""

import os
import platform
import subprocess
import sys

import pytest


PROGRAM = """
import resource
import numpy as np
from jaxcloseup.memory import give_back_memory, reuse_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(2**23)  # 64 MiB, freed at once
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before  # pages found anew

found = [faults()]
reuse_freed_memory()
faults()
found.append(faults())
give_back_memory()
print(*found, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_memory_is_used_again_until_it_is_given_back():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "NUMPY_MADVISE_HUGEPAGE": "0"},
        capture_output=True,
        text=True,
        check=True,
    )
    usual, kept, given_back = map(int, done.stdout.split())
    assert kept < usual / 10 and given_back > usual / 2
