"""Freed memory is kept or given back by calls of the C library, where it is glibc."""

import subprocess
import sys
import types

import jax
import numpy as np
import pytest

from jaxcloseup.io import buffers, memory


def test_glibc_keeps_freed_memory_until_it_is_given_back(monkeypatch):
    calls = []
    library = types.SimpleNamespace(
        mallopt=lambda parameter, value: calls.append((parameter, value)),
        malloc_trim=lambda pad: calls.append(pad),
    )
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: library)
    memory.reuse_freed_memory()
    # Parameters in glibc's malloc.h: M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_MMAP_MAX.
    assert dict(calls) == {-8: 1, -3: 2**25, -1: 2**31 - 1}
    with pytest.raises(KeyError), memory.reusing_large_buffers():
        assert calls[-1] == (-4, 0)
        raise KeyError
    assert calls[-1] == (-4, 65536)
    memory.give_back_memory()
    assert calls[-1] == 0


@pytest.mark.parametrize("library", [object(), None])
def test_other_c_libraries_change_nothing(monkeypatch, library):
    def load(name):
        if library is None:
            raise OSError("no library")
        return library

    monkeypatch.setattr(memory.ctypes, "CDLL", load)
    memory.reuse_freed_memory()
    with memory.reusing_large_buffers():
        memory.give_back_memory()


def test_jax_on_a_cpu_takes_arrays_without_a_copy():
    array = buffers.empty_for_jax((3, 5, 4), np.int8)
    assert (array.shape, array.dtype) == ((3, 5, 4), np.int8)
    taken = jax.device_put(array, jax.devices("cpu")[0])
    assert taken.unsafe_buffer_pointer() == array.ctypes.data


def test_installed_memory_is_known():
    assert memory.installed_memory() > 2**26


@pytest.mark.skipif(sys.platform != "linux", reason="VmHWM is Linux's")
def test_peak_memory_is_of_this_process_alone():
    held = np.ones(2**25)  # 256 MiB here must not count in a program that is started from here
    before = memory.peak_memory()
    assert held.nbytes < before
    code = """
import sys
from jaxcloseup.io import memory
before = memory.peak_memory()
taken = bytearray(b"1" * 2**27)
del taken
print(before, memory.peak_memory())
"""
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    first, last = map(int, shown.split())
    assert first < held.nbytes < before
    assert 2**27 < last - first < 2**29
