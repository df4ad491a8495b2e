"""Checkpoints: saved states load exactly, partial ones are ignored, other runs are refused."""

import contextlib
import json
import os
import resource
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints


RUN = {"scene": "table", "seed": 0, "config": {"field": {"capacity": 100}, "steps": [1, 2]}}


def state(value):
    return {
        "step": jnp.int32(value),
        "alive": jnp.arange(5) < value,
        "moments": (jnp.full((3, 2), value / 3, jnp.float32), ()),
        "key": jax.random.key(value),
    }


def test_the_newest_state_loads_bit_for_bit(tmp_path):
    first = Checkpoints(tmp_path / "c", RUN)
    assert first.load("baseline", state(0)) is None
    for step in (2, 4, 6):
        first.save("baseline", step, state(step), {"history": [{"loss": step / 7}]})
    first.save("closeup", 1, state(9), {})
    again = Checkpoints(tmp_path / "c", RUN)
    step, found, progress = again.load("baseline", state(0))
    assert step == 6
    assert progress == {"history": [{"loss": 6 / 7}]}
    expected = state(6)
    np.testing.assert_array_equal(
        jax.random.uniform(found.pop("key")), jax.random.uniform(expected.pop("key"))
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert again.load("closeup", state(0))[0] == 1
    kept = {path.name for path in (tmp_path / "c" / "baseline").iterdir()}
    assert kept == {"4", "6"}


def test_a_partial_checkpoint_is_ignored(tmp_path):
    checkpoints = Checkpoints(tmp_path, RUN)
    checkpoints.save("baseline", 3, state(3), {})
    # A crash leaves a checkpoint under its temporary name.
    half = tmp_path / "baseline" / "5.orbax-checkpoint-tmp"
    (half / "state").mkdir(parents=True)
    (half / "state" / "data").write_bytes(b"half")
    step, _, _ = Checkpoints(tmp_path, RUN).load("baseline", state(0))
    assert step == 3


@contextlib.contextmanager
def room_for(size):
    """Limit the size of every file that the process writes to `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# Orbax abandons its other writes, whose callbacks may then find a closed event loop.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_costs_only_the_newest_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path, RUN)
    checkpoints.save("baseline", 3, state(3), {})
    noise = {"noise": jax.random.uniform(jax.random.key(0), (600_000,))}
    with (
        room_for(1_000_000),
        pytest.raises(CheckpointError, match=r"baseline/5 cannot be written \(File too large\)"),
    ):
        checkpoints.save("baseline", 5, state(5) | noise, {})
    step, found, _ = Checkpoints(tmp_path, RUN).load("baseline", state(0))
    assert (step, int(found["step"])) == (3, 3)


def test_another_run_is_refused_with_the_first_difference(tmp_path):
    Checkpoints(tmp_path, RUN)
    other = RUN | {"config": {"field": {"capacity": 200}, "steps": [1, 2]}}
    with pytest.raises(CheckpointError, match=r"whose config.field.capacity is 100 instead of 200"):
        Checkpoints(tmp_path, other)
    other = RUN | {"config": RUN["config"] | {"colors": None}}  # an older version lacks this field
    with pytest.raises(CheckpointError, match=r"whose config.colors is absent instead of None"):
        Checkpoints(tmp_path, other)
    with pytest.raises(CheckpointError, match=r"whose seed is 0 instead of 1"):
        Checkpoints(tmp_path, RUN | {"seed": 1})
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"run.json cannot be read"):
        Checkpoints(tmp_path, RUN)


def test_a_state_of_another_structure_is_refused(tmp_path):
    checkpoints = Checkpoints(tmp_path, RUN)
    checkpoints.save("baseline", 3, state(3), {})
    with pytest.raises(CheckpointError, match="does not hold this run's state"):
        checkpoints.load("baseline", {"step": jnp.int32(0)})


def noise(value):
    return {"noise": jax.random.normal(jax.random.key(value), (100_000,))}


def overwrite(folder):
    """Eight bytes in the middle of the largest file."""
    file = max(
        (path for path in folder.rglob("*") if path.is_file()), key=lambda p: p.stat().st_size
    )
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8] = b"\xff" * 8
    file.write_bytes(data)


def test_a_damaged_state_is_refused_and_an_earlier_one_loads(tmp_path):
    checkpoints = Checkpoints(tmp_path, RUN)
    for step in (2, 4):
        checkpoints.save("baseline", step, noise(step), {})
    overwrite(tmp_path / "baseline" / "4")
    with pytest.raises(
        CheckpointError, match=r"baseline/4 .*: remove it to resume from an earlier"
    ):
        Checkpoints(tmp_path, RUN).load("baseline", noise(0))
    shutil.rmtree(tmp_path / "baseline" / "4")
    step, found, progress = Checkpoints(tmp_path, RUN).load("baseline", noise(0))
    assert step == 2 and progress == {}
    np.testing.assert_array_equal(found["noise"], noise(2)["noise"])


@pytest.mark.parametrize("change", [{"growth": 8}, {"crc32": 3}])
def test_edited_progress_is_refused(tmp_path, change):
    Checkpoints(tmp_path, RUN).save("baseline", 2, state(2), {"growth": 1})
    file = tmp_path / "baseline" / "2" / "progress" / "metadata"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(CheckpointError, match="its files were changed or damaged"):
        Checkpoints(tmp_path, RUN).load("baseline", state(0))


def test_a_pipe_in_a_checkpoint_is_refused(tmp_path):
    """Whoever opens it for reading waits for ever."""
    kept = Checkpoints(tmp_path, {})
    kept.save("baseline", 1, {"a": jnp.zeros(3)}, {})
    path = tmp_path / "baseline" / "1" / "_CHECKPOINT_METADATA"
    assert path.is_file()
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match=r"_CHECKPOINT_METADATA cannot be read \(Not an ord"):
        Checkpoints(tmp_path, {}).load("baseline", {"a": jnp.zeros(3)})


def test_a_checkpoint_of_the_far_future_is_refused(tmp_path):
    """Orbax reads the times of all checkpoints before any is loaded."""
    Checkpoints(tmp_path, {}).save("baseline", 1, {"a": jnp.zeros(3)}, {})
    path = tmp_path / "baseline" / "1" / "_CHECKPOINT_METADATA"
    fields = json.loads(path.read_text())
    path.write_text(json.dumps(fields | {"commit_timestamp_nsecs": 10**22}))
    with pytest.raises(CheckpointError, match="holds a checkpoint whose records are damaged"):
        Checkpoints(tmp_path, {}).load("baseline", {"a": jnp.zeros(3)})


def test_a_checkpoint_without_a_checksum_loads(tmp_path):
    Checkpoints(tmp_path, RUN).save("baseline", 2, state(2), {"growth": 1})
    file = tmp_path / "baseline" / "2" / "progress" / "metadata"
    file.write_text(json.dumps({"growth": 1}))
    step, _, progress = Checkpoints(tmp_path, RUN).load("baseline", state(0))
    assert step == 2 and progress == {"growth": 1}


def test_a_state_that_is_not_finite_is_refused(tmp_path):
    bad = noise(0)["noise"].at[7].set(jnp.nan)
    Checkpoints(tmp_path, RUN).save("baseline", 2, {"noise": bad}, {})
    with pytest.raises(CheckpointError, match=r"'noise'.* is not finite"):
        Checkpoints(tmp_path, RUN).load("baseline", noise(0))


def test_a_state_of_a_version_that_lacked_a_field_loads_where_the_field_is_none(tmp_path):
    Checkpoints(tmp_path, RUN).save("baseline", 1, {"alive": jnp.ones(3)}, {})
    like = {"alive": jnp.zeros(3), "interval": None}
    _, found, _ = Checkpoints(tmp_path, RUN).load("baseline", like)
    assert found["interval"] is None and found["alive"].sum() == 3
    like["interval"] = jnp.zeros(3)
    with pytest.raises(CheckpointError, match=r"interval.* is missing"):
        Checkpoints(tmp_path, RUN).load("baseline", like)


def test_arrays_of_another_shape_are_refused(tmp_path):
    Checkpoints(tmp_path, RUN).save("baseline", 1, {"alive": jnp.ones(3)}, {})
    with pytest.raises(CheckpointError, match=r"alive.* is float32\[3\] instead of float32\[4\]"):
        Checkpoints(tmp_path, RUN).load("baseline", {"alive": jnp.zeros(4)})
