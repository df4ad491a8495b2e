"""Checkpoints of a run: the training states of its stages and the run's identity.

Orbax writes to a temporary folder and renames it, so a crash never leaves half a checkpoint. With
several hosts, the first one writes and all read; each host holds the whole state.

A checksum beside each state reveals damage; checkpoints of earlier versions have none.
"""

import json
import pathlib
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from jaxcloseup.io.files import check_file, read_object, write_file
from jaxcloseup.io.messages import printable, reason


_CHECKSUM = "crc32"  # entry of the progress item
_LARGEST = 2**36  # bytes of a file


class CheckpointError(Exception):
    """A run cannot be saved or resumed; the message is one sentence that says what to do."""

    def __init__(self, message: str) -> None:
        """Escape what a terminal would obey in what files say."""
        super().__init__(printable(message))


class Checkpoints:
    """The checkpoints of one run.

    Args:
      folder: folder of the checkpoints, with a subfolder per stage.
      identity: JSON values that identify the run: scene, method, configuration, ...

    Raises:
      CheckpointError: the folder belongs to another run; names the first field that differs.
    """

    def __init__(self, folder: str | pathlib.Path, identity: Mapping[str, Any]) -> None:
        """Write the identity to a new folder, or check that an existing folder has the same one."""
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
            kept = read_object(path)
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise CheckpointError(
                f"{path} cannot be read ({why}): start a new run in another output folder."
            ) from error
        for name in sorted(kept.keys() | identity.keys(), key=lambda name: (name != "scene", name)):
            if kept.get(name) != identity.get(name):
                raise CheckpointError(
                    f"{self.folder} belongs to another run, {_difference(name, kept, identity)}: "
                    "resume it with its own settings, or choose a new output folder."
                )

    def save(self, stage: str, step: int, state: Any, progress: Mapping[str, Any]) -> None:
        """Save a stage's state after `step` steps, and keep the stage's two newest checkpoints.

        Args:
          stage: name of the stage.
          step: number of steps done in the stage.
          state: pytree of arrays; may hold random keys.
          progress: JSON values to save with the state.

        Raises:
          CheckpointError: the checkpoint cannot be written; earlier ones stay.
        """
        if jax.process_index() > 0:
            return
        plain = _plain(state)
        marked = {**progress, _CHECKSUM: _checksum(plain, progress)}
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(plain), progress=ocp.args.JsonSave(marked)
        )
        try:
            self._manager(stage).save(step, args=items, force=True)
        except (ValueError, OSError) as error:  # a full disk raises ValueError
            why = str(error).partition("\n")[0].rsplit(": ", 1)[-1].split(" [os_error")[0]
            raise CheckpointError(
                f"{self.folder / stage / str(step)} cannot be written ({why}): make room on the "
                "disk and resume the run from the previous checkpoint."
            ) from error

    def load(self, stage: str, like: Any) -> tuple[int, Any, dict[str, Any]] | None:
        """Load a stage's newest step, state and progress, or None if it has no checkpoint.

        Args:
          stage: name of the stage.
          like: pytree with the structure, shapes and types of the state.

        Raises:
          CheckpointError: the checkpoint cannot be read, its bytes were changed, or its state
            differs from `like` or is not finite.
        """
        manager = self._manager(stage)
        step = manager.latest_step()
        if step is None:
            return None
        items = ocp.args.Composite(
            # As nested dicts: Orbax would refuse a state that lacks a field that is None in `like`.
            state=ocp.args.StandardRestore(),
            progress=ocp.args.JsonRestore(),
        )
        try:
            found = manager.restore(step, args=items)
            plain = jax.tree_util.tree_map_with_path(
                lambda path, leaf: _follow(found["state"], path, leaf), _plain(like)
            )
            progress = _checked(plain, found["progress"])
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise CheckpointError(
                f"{self.folder / stage / str(step)} does not hold this run's state "
                f"({reason(error)}): remove it to resume from an earlier one."
            ) from error
        state = jax.tree.map(
            lambda new, old: jax.random.wrap_key_data(new) if _is_key(old) else jnp.asarray(new),
            plain,
            like,
        )
        return step, state, progress

    def _manager(self, stage: str) -> ocp.CheckpointManager:
        if stage not in self._managers:
            folder = self.folder / stage
            folder.mkdir(parents=True, exist_ok=True)
            _check_files(folder)
            here, alone = jax.process_index(), ocp.options.MultiprocessingOptions()
            if jax.process_count() > 1:
                alone = ocp.options.MultiprocessingOptions(here, {here}, f"host_{here}")
            options = ocp.CheckpointManagerOptions(
                max_to_keep=2,
                create=False,
                enable_async_checkpointing=False,
                multiprocessing_options=alone,
            )
            try:
                self._managers[stage] = ocp.CheckpointManager(folder, options=options)
            except (ValueError, KeyError, TypeError, OverflowError, OSError) as error:
                raise CheckpointError(
                    f"{folder} holds a checkpoint whose records are damaged ({reason(error)}): "
                    "remove it to resume from an earlier one."
                ) from error
        return self._managers[stage]


def _check_files(folder: pathlib.Path) -> None:
    """Raise unless a folder holds ordinary files alone: Orbax would wait for a pipe."""
    for path in folder.rglob("*"):
        try:
            if not path.is_dir():
                check_file(path, most=_LARGEST)
        except OSError as error:
            raise CheckpointError(
                f"{path} cannot be read ({error.strerror}): restore it, or remove its checkpoint "
                "to resume from an earlier one."
            ) from error


def _difference(name: str, kept: Mapping[str, Any], identity: Mapping[str, Any]) -> str:
    """Describe the first difference, down to the innermost field."""
    old, new = kept.get(name), identity.get(name)
    while isinstance(old, dict) and isinstance(new, dict):
        both = ((k, old.get(k, "absent"), new.get(k, "absent")) for k in sorted({*old, *new}))
        inner, old, new = next(values for values in both if values[1] != values[2])
        name = f"{name}.{inner}"
    return f"whose {name} is {old} instead of {new}"


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(state: Any) -> Any:
    """Copy the state to NumPy arrays, which belong to no device, and unwrap its random keys."""
    return jax.device_get(
        jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
    )


def _checked(plain: Any, marked: Any) -> dict[str, Any]:
    """Return the progress without its checksum; raise ValueError if the state was changed."""
    if not isinstance(marked, dict):
        raise ValueError("its progress is not an object")
    progress = {name: value for name, value in marked.items() if name != _CHECKSUM}
    if marked.get(_CHECKSUM, found := _checksum(plain, progress)) != found:
        raise ValueError("its files were changed or damaged after they were written")
    for path, leaf in jax.tree_util.tree_leaves_with_path(plain):
        if jnp.issubdtype(leaf.dtype, jnp.inexact) and not np.isfinite(leaf).all():
            raise ValueError(f"{jax.tree_util.keystr(path)} is not finite")
    return progress


def _checksum(plain: Any, progress: Mapping[str, Any]) -> int:
    """Return the CRC-32 of the arrays and the progress, which any change of few bytes alters."""
    value = zlib.crc32(json.dumps(progress, sort_keys=True).encode())
    for leaf in jax.tree.leaves(plain):
        value = zlib.crc32(np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data, value)
    return value


def _follow(tree: Any, path: tuple[Any, ...], like: Any) -> Any:
    """Return the leaf of nested dicts and lists that lies at a pytree's path."""
    for key in path:
        name = jax.tree_util.keystr((key,), simple=True)
        try:
            tree = tree[int(name)] if isinstance(tree, list | tuple) else tree[name]
        except (KeyError, IndexError):
            raise ValueError(f"{jax.tree_util.keystr(path)} is missing") from None
    if (tree.shape, tree.dtype) != (like.shape, like.dtype):
        raise ValueError(
            f"{jax.tree_util.keystr(path)} is {tree.dtype}{list(tree.shape)} instead of "
            f"{like.dtype}{list(like.shape)}"
        )
    return tree
