"""Arrays on several devices and hosts."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from orbax.checkpoint.multihost import sync_global_processes


HOSTS_WAIT = 24 * 3600  # seconds
_meetings = itertools.count(1)


def mesh_of_arms() -> Mesh:
    """Return the mesh of all devices, among which the arms of a sweep are shared out."""
    return Mesh(np.array(jax.devices()), ("arms",))


def mesh_of_windows(windows: int) -> Mesh | None:
    """Return the devices that share the windows of a step evenly; None where that is one device.

    Raises:
      ValueError: several hosts have devices that would get no window.
    """
    devices = jax.devices()
    count = math.gcd(windows, len(devices))
    if jax.process_count() > 1 and windows > 1 and count < len(devices):
        raise ValueError(
            f"--windows={windows} leaves devices of some hosts without work: choose a multiple of "
            f"their {len(devices)} devices"
        )
    return Mesh(np.array(devices[:count]), ("windows",)) if count > 1 else None


def meet() -> None:
    """Wait until all hosts are here: one may be minutes behind, and collectives wait 30 seconds."""
    if jax.process_count() > 1:
        sync_global_processes(
            f"arms {next(_meetings)}", processes=set(range(jax.process_count())), timeout=HOSTS_WAIT
        )


def place(sharding: NamedSharding, tree: Any) -> Any:
    """Put arrays that every host has whole on the devices, each host its part."""
    if jax.process_count() == 1:
        return jax.device_put(tree, sharding)

    def place_leaf(leaf: Any) -> jax.Array:
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, sharding, leaf.__getitem__)

    return _map_keys_as_numbers(place_leaf, tree)


def one_copy(tree: Any) -> Any:
    """Return this host's first copy of arrays that every device has whole."""
    return _map_keys_as_numbers(lambda leaf: leaf.addressable_data(0), tree)


def gather_hosts(tree: Any) -> Any:
    """Return arrays that are spread over several hosts whole on each."""
    if jax.process_count() == 1:
        return tree

    def gather_leaf(leaf: Any) -> jax.Array:
        return jnp.asarray(multihost_utils.process_allgather(leaf, tiled=True))

    return _map_keys_as_numbers(gather_leaf, tree)


def _map_keys_as_numbers(change: Callable[[Any], Any], tree: Any) -> Any:
    def change_leaf(leaf: Any) -> Any:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(change(jax.random.key_data(leaf)))
        return change(leaf)

    return jax.tree.map(change_leaf, tree)
