"""The random keys of a run."""

import jax
from flax import struct


@struct.dataclass
class RunKeys:
    """A key for each use of random numbers, all from the seed of a run."""

    init: jax.Array  # draws the initial parameters, and from there the steps of all stages
    points: jax.Array  # draws initial points
    closeups: jax.Array  # draws the cameras of close-ups that are labeled before the first step
    audit: jax.Array  # draws the close-ups of the audit of labels
    pictures: jax.Array  # draws the close-ups that the report shows
    ceilings: jax.Array  # draws the close-ups of a sweep's upper bounds


def run_keys(seed: int) -> RunKeys:
    """Return the keys of a seed."""
    root = jax.random.key(seed)
    init, audit, pictures = jax.random.split(root, 3)
    return RunKeys(
        init=init,
        points=jax.random.fold_in(init, 2),
        closeups=jax.random.fold_in(root, 3),
        audit=audit,
        pictures=pictures,
        ceilings=root,
    )
