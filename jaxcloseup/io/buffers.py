"""Arrays that JAX takes over as they are."""

from typing import Any

import numpy as np


_ALIGNED = 64  # bytes, as XLA wants its buffers


def empty_for_jax(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return an array without values that `jax.device_put` does not copy on a CPU.

    Nothing may be written to it from then on.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    whole = np.empty(size + _ALIGNED, np.uint8)
    start = -whole.ctypes.data % _ALIGNED
    return whole[start : start + size].view(dtype).reshape(shape)
