"""Fine-tune four copies of a field at once, each with another tolerance of the labels' mask.

The arms differ in traced settings alone, so one vmapped program trains all of them. The field is
that of `own_field.py`.

Output:

    tolerance 0.002: labels on 1% of a close-up
    tolerance 0.005: labels on 8% of a close-up
    tolerance 0.010: labels on 17% of a close-up
    tolerance 0.020: labels on 21% of a close-up
"""

import functools

import jax
import jax.numpy as jnp
from own_field import BOUND, FIELD, photograph

from jaxcloseup import (
    LabelConfig,
    init_state,
    pseudo_settings,
    pseudo_step,
    run_arms,
    stack_arms,
    stack_states,
)


TOLERANCES = 0.002, 0.005, 0.01, 0.02


def main():
    """Train the arms for five steps, and compare how much of a close-up has labels."""
    views, depths = jax.vmap(photograph, (0, None))(jnp.linspace(-0.6, 0.6, 5), 2.0)
    state = init_state(jax.random.key(0), None, None, field=FIELD, optimizer=BOUND["optimizer"])
    arms = [pseudo_settings(LabelConfig(rgb_tolerance=tolerance)) for tolerance in TOLERANCES]
    step = functools.partial(pseudo_step, **BOUND)
    # All arms begin with the same state, and draw the same cameras and photographs.
    _, metrics = jax.jit(functools.partial(run_arms, step))(
        stack_states([state] * len(arms)), views, depths, stack_arms(arms), count=5
    )
    for tolerance, share in zip(TOLERANCES, metrics["label_coverage"], strict=True):
        print(f"tolerance {tolerance:.3f}: labels on {share:.0%} of a close-up")


if __name__ == "__main__":
    main()
