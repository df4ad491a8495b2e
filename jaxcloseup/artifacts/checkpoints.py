"""Checkpoints of a run: training states of its stages, and what run they are of.

Orbax writes beside and renames, so a checkpoint that a crash cut short is never seen. Where several
hosts train together the first one writes and all read; states are then whole on each of them.
"""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from jaxcloseup.files import write_file


class CheckpointError(Exception):
    """A run that cannot be resumed. The message is one sentence that says what to do."""


class Checkpoints:
    """The checkpoints of one run.

    Args:
      folder: where they are kept, one folder for each stage.
      identity: what makes the run this run, as JSON can hold it: scene, method, configuration ...

    Raises:
      CheckpointError: the folder belongs to another run; names the first thing that differs.
    """

    def __init__(self, folder: str | pathlib.Path, identity: Mapping[str, Any]) -> None:
        """Claim the folder for this run, or go on with it."""
        self.folder = pathlib.Path(folder).resolve()
        self._managers: dict[str, ocp.CheckpointManager] = {}
        identity = json.loads(json.dumps(identity))
        path = self.folder / "run.json"
        if not path.exists():
            if jax.process_index() > 0:
                return
            write_file(path, json.dumps(identity, indent=1).encode())
            return
        try:
            kept = json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise CheckpointError(
                f"{path} cannot be read ({error}): start anew in another output folder."
            ) from error
        for name in sorted(kept.keys() | identity.keys()):
            if kept.get(name) != identity.get(name):
                raise CheckpointError(
                    f"{self.folder} is of another run, {_difference(name, kept, identity)}: resume "
                    "it as it was begun, or name a new output folder."
                )

    def save(self, stage: str, step: int, state: Any, progress: Mapping[str, Any]) -> None:
        """Keep a stage's state after `step` of its steps; `progress` is JSON. Two are kept.

        `state` is a pytree of arrays; random keys are kept too.

        Raises:
          CheckpointError: it cannot be written; those before it stay.
        """
        if jax.process_index() > 0:
            return
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(_plain(state)), progress=ocp.args.JsonSave(dict(progress))
        )
        try:
            self._manager(stage).save(step, args=items, force=True)
        except (ValueError, OSError) as error:  # of a full disk, a ValueError
            reason = str(error).partition("\n")[0].rsplit(": ", 1)[-1].split(" [os_error")[0]
            raise CheckpointError(
                f"{self.folder / stage / str(step)} cannot be written ({reason}): make room for it "
                "and resume the run from the checkpoint before."
            ) from error

    def load(self, stage: str, like: Any) -> tuple[int, Any, dict[str, Any]] | None:
        """A stage's newest step, state and progress, or None; `like` gives the state's form."""
        manager = self._manager(stage)
        step = manager.latest_step()
        if step is None:
            return None
        items = ocp.args.Composite(
            state=ocp.args.StandardRestore(_plain(like)), progress=ocp.args.JsonRestore()
        )
        try:
            found = manager.restore(step, args=items)
        except (ValueError, KeyError, OSError) as error:
            raise CheckpointError(
                f"{self.folder / stage / str(step)} does not hold this run's state "
                f"({str(error).splitlines()[0]}): remove it to go on from an earlier one."
            ) from error
        state = jax.tree.map(
            lambda new, old: jax.random.wrap_key_data(new) if _is_key(old) else jnp.asarray(new),
            found["state"],
            like,
        )
        return step, state, found["progress"]

    def _manager(self, stage):
        if stage not in self._managers:
            folder = self.folder / stage
            folder.mkdir(parents=True, exist_ok=True)
            here, alone = jax.process_index(), ocp.options.MultiprocessingOptions()
            if jax.process_count() > 1:
                alone = ocp.options.MultiprocessingOptions(here, {here}, f"host_{here}")
            options = ocp.CheckpointManagerOptions(
                max_to_keep=2,
                create=False,
                enable_async_checkpointing=False,
                multiprocessing_options=alone,
            )
            self._managers[stage] = ocp.CheckpointManager(folder, options=options)
        return self._managers[stage]


def _difference(name, kept, identity):
    """What differs, down to the innermost field."""
    old, new = kept.get(name), identity.get(name)
    while isinstance(old, dict) and isinstance(new, dict):
        both = ((k, old.get(k, "absent"), new.get(k, "absent")) for k in sorted({*old, *new}))
        inner, old, new = next(values for values in both if values[1] != values[2])
        name = f"{name}.{inner}"
    return f"whose {name} is {old} and not {new}"


def _is_key(leaf):
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(state):
    """The state as NumPy arrays, which belong to no device of no host."""
    return jax.device_get(
        jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
    )
