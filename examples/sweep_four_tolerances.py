"""Fine-tune four copies of a field at once, each with another tolerance of the labels' mask.

The arms differ in traced settings alone, so one vmapped program trains all of them. The field is
that of `own_field.py`.

Output:

    tolerance 0.02: labels on 0% of a close-up
    tolerance 0.05: labels on 0% of a close-up
    tolerance 0.10: labels on 0% of a close-up
    tolerance 0.20: labels on 0% of a close-up
"""

import functools

import jax
import jax.numpy as jnp
from own_field import BOUND, FIELD, photograph

from jaxcloseup import LabelConfig, init_state, pseudo_settings, pseudo_step


TOLERANCES = 0.002, 0.005, 0.01, 0.02


def main():
    """Train the arms for three steps, and compare how much of a close-up has labels."""
    views, depths = jax.vmap(photograph, (0, None))(jnp.linspace(-0.6, 0.6, 5), 2.0)
    state = init_state(jax.random.key(0), None, None, field=FIELD, optimizer=BOUND["optimizer"])
    arms = [pseudo_settings(LabelConfig(rgb_tolerance=tolerance)) for tolerance in TOLERANCES]
    settings = jax.tree.map(lambda *leaves: jnp.stack(leaves), *arms)
    # All arms begin with the same state, and draw the same cameras and photographs.
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(arms)), state)
    step = functools.partial(pseudo_step, **BOUND)
    step_all = jax.jit(jax.vmap(step, in_axes=(0, None, None, 0)))
    for _ in range(3):
        states, metrics = step_all(states, views, depths, settings)
    for tolerance, share in zip(TOLERANCES, metrics["label_coverage"], strict=True):
        print(f"tolerance {tolerance:.3f}: labels on {share:.0%} of a close-up")


if __name__ == "__main__":
    main()
