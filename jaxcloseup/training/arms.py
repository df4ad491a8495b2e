"""Arms: several states that train together in one program, each with settings of its own.

A sweep of four tolerances on one device, where `start` is a trained state and `depths` its depths
of the photographs `views`:

    step = functools.partial(closeup_step, field=field, optimizer=optimizer, config=config)
    settings = [pseudo_settings(LabelConfig(rgb_tolerance=t)) for t in (0.02, 0.05, 0.1, 0.2)]
    states, metrics = run_arms(
        step, stack_states([start] * 4), views, label_sources(views, depths), stack_arms(settings),
        count=100,
    )
    third = arm_state(states, 2)
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from jaxcloseup.labels.make import LabelSources, PseudoSettings
from jaxcloseup.photos.views import Views
from jaxcloseup.photos.windows import Windows
from jaxcloseup.training.state import Metrics, TrainState
from jaxcloseup.training.steps import run_steps


Tree = TypeVar("Tree")


def stack_arms(trees: Sequence[Tree]) -> Tree:
    """Stack equal trees of arrays, such as the settings of A arms, along a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def stack_states(states: Sequence[TrainState]) -> TrainState:
    """Stack the states of A arms; they share the count of steps, which must be the same."""
    stacked: Any = stack_arms(states)
    return stacked.replace(step=states[0].step)


def arm_state(states: Any, arm: int) -> TrainState:
    """Return the state of one arm of stacked states."""
    alone = jax.tree.map(lambda leaf: leaf[arm], states.replace(step=None))
    return alone.replace(step=states.step)


def run_arms(
    step: Callable[..., tuple[TrainState, Metrics]],
    states: TrainState,
    views: Views | Windows,
    sources: LabelSources | jax.Array,
    settings: PseudoSettings,
    *,
    count: jax.Array | int,
    mesh: Mesh | None = None,
) -> tuple[TrainState, Metrics]:
    """Take `count` steps of A arms in one program. Bind `step` and `mesh` before `jax.jit`.

    An arm whose loss is not finite skips its step and changes no other arm.

    Args:
      step: `(state, views, sources, settings) -> (state, metrics)` of one arm, such as
        `closeup_step` with its static arguments bound, or `pseudo_step`, whose `sources` are the
        photographs' depths.
      states: `[A, ...]` from `stack_states`. All arms make scheduled changes, such as of the number
        of splats, at the same steps, because they share the count of steps.
      views: training photographs, which all arms share.
      sources: what labels read, shared by all arms, or stacked: depths `[A, V, H, W]`, or
        `LabelSources` whose depths and blocks, but not photographs, have the axis of arms.
      settings: `[A]` from `stack_arms`.
      count: how many steps; may be traced.
      mesh: devices along one axis, whose number divides A: each trains arms of its own and
        exchanges nothing with the others. None trains all arms on one device.

    Returns:
      The next states `[A, ...]`, and the means of each arm's metrics, `[A]`.
    """
    of_states, of_views, of_sources, of_settings = arm_axes(states, sources)
    in_axes = of_states, of_views, of_sources, of_settings
    step_all = jax.vmap(step, in_axes=in_axes, out_axes=(of_states, 0))

    def run(
        states: TrainState,
        views: Views | Windows,
        sources: LabelSources | jax.Array,
        settings: PseudoSettings,
        count: jax.Array | int,
    ) -> tuple[TrainState, Metrics]:
        return run_steps(
            lambda states: step_all(states, views, sources, settings), states, count=count
        )

    if mesh is None:
        return run(states, views, sources, settings, count)
    specs = arm_specs(states, sources, mesh)
    sharded = jax.shard_map(
        run,
        mesh=mesh,
        in_specs=(*specs, PartitionSpec()),
        out_specs=(specs[0], specs[3]),
        check_vma=False,
    )
    return sharded(states, views, sources, settings, count)


def arm_axes(states: TrainState, sources: LabelSources | jax.Array) -> tuple[Any, Any, Any, Any]:
    """Return the axes of arms for `jax.vmap`: of states, views, sources and settings.

    None stands for arrays that all arms share.
    """
    depths = sources.depths if isinstance(sources, LabelSources) else sources
    of_states = jax.tree.map(lambda leaf: 0, states).replace(step=None)
    if depths.ndim == 3:
        return of_states, None, None, 0
    of_sources = jax.tree.map(lambda leaf: 0, sources)
    if isinstance(sources, LabelSources):
        of_sources = of_sources.replace(views=None)
    return of_states, None, of_sources, 0


def arm_specs(
    states: TrainState, sources: LabelSources | jax.Array, mesh: Mesh
) -> tuple[Any, Any, Any, Any]:
    """Return how states, views, sources and settings lie on a mesh of one axis."""
    (axis,) = mesh.axis_names
    return jax.tree.map(
        lambda arms: PartitionSpec() if arms is None else PartitionSpec(axis),
        arm_axes(states, sources),
        is_leaf=lambda leaf: leaf is None,
    )
