"""Programs that compute for longer than it takes to optimize them a little.

Tests compile others without optimizing them, as `conftest.py` says.
"""

import jax

from jaxcloseup.detail import add, learn
from jaxcloseup.drawn_scenes import drawn, lighting, raycast


def optimized(function, *static):
    """Compile a function, with the names of its static arguments."""
    options = {"xla_backend_optimization_level": 1}
    return jax.jit(function, static_argnames=static, compiler_options=options)


for module, name, *static in (
    (add, "_add"),
    (add, "_fill"),
    (learn, "_descend", "loss", "steps", "rate"),
    (drawn, "_render_rgb", "samples"),
    (lighting, "_look_up"),
    (raycast, "_cast"),
):
    setattr(module, name, optimized(getattr(module, name).__wrapped__, *static))
