"""Poses that a coarse model corrects: cameras come back, and a run's folder keeps them."""

import dataclasses
import json
import pathlib
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from tiny_runs import TINY_SURFELS

from jaxcloseup.app.methods.method import CoarseConfig
from jaxcloseup.app.run.corrected_poses import (
    NAME,
    corrects_poses,
    kept_or_corrected,
    read_poses,
    write_poses,
)
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.read_photographs import ReadPhotographs
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, read_run
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.photos.alignment import move_camera


PRESET = dataclasses.replace(
    TINY_SURFELS, coarse=CoarseConfig(TINY_SURFELS.field, steps=20, poses=True)
)


def render_plane(_, camera):
    """Show the plane exactly, as a perfect coarse model would."""
    rgb, depth, _ = (jnp.asarray(array, jnp.float32) for array in plane.photograph(camera))
    return Rendering(rgb, depth, jnp.ones_like(depth), jnp.zeros_like(rgb), ())


def programs_with(cameras, photographs):
    """Stand in for programs whose coarse model shows the plane."""
    scene, _ = plane.make_scene(cameras)
    train = scene.train.replace(rgb=photographs)
    scene = dataclasses.replace(scene, train=train, surface=None)
    return SimpleNamespace(
        scene=scene,
        train=train,
        coarse=SimpleNamespace(render=render_plane),
        preset=PRESET,
        growth=1,
        read=ReadPhotographs(scene),
    )


EXACT = [plane.camera_above(x, 0.2 * x, 4.0, tilt=0.2 * x) for x in (-1.0, 0.0, 1.0)]


def moved_by(scale, camera, seed):
    motion = np.random.default_rng(seed).normal(scale=scale, size=6)
    return move_camera(camera, jnp.asarray(motion, jnp.float32))


def test_cameras_come_back(tmp_path, capsys):
    off = [moved_by(0.01, camera, seed) for seed, camera in enumerate(EXACT)]
    programs = programs_with(off, plane.make_views(EXACT)[0].rgb)
    moved = kept_or_corrected(programs, None, tmp_path)
    poses = moved.scene.train.cameras.camtoworld
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 5))
    at = np.stack([x, y, np.ones_like(x)], axis=-1)

    def where_rays_meet_the_plane(pose):
        pose = np.asarray(pose)
        rays = at @ pose[:, :3].T
        return pose[:2, 3] - rays[..., :2] * pose[2, 3] / rays[..., 2:]

    for given, exact, pose in zip(off, EXACT, poses, strict=True):
        truth, before, after = map(
            where_rays_meet_the_plane, (exact.camtoworld, given.camtoworld, pose)
        )
        assert np.abs(after - truth).max() < 0.1 * np.abs(before - truth).max()
    np.testing.assert_array_equal(moved.train.cameras.camtoworld, poses)
    assert "3 of 3 cameras were moved to fit their photographs" in capsys.readouterr().out
    # A resumed run goes on with the poses that it keeps, whatever it would find now.
    programs.coarse.render = None
    again = kept_or_corrected(programs, None, tmp_path)
    np.testing.assert_array_equal(again.scene.train.cameras.camtoworld, poses)
    (tmp_path / NAME).write_text("{}")
    with pytest.raises(TrainingError, match="does not hold the poses of these photographs"):
        kept_or_corrected(programs, None, tmp_path)


def test_cameras_stay_whose_photographs_do_not_tell(tmp_path, capsys):
    """One shows noise, one nothing, and one is off by many pixels."""
    off = [*EXACT[:2], moved_by(0.5, EXACT[2], 3)]
    rgb = plane.make_views(EXACT)[0].rgb
    rgb = rgb.at[0].add(0.1 * jax.random.normal(jax.random.key(1), rgb.shape[1:])).at[1].set(0.5)
    programs = programs_with(off, rgb)
    assert kept_or_corrected(programs, None, tmp_path) is programs
    assert not capsys.readouterr().out and not list(tmp_path.iterdir())


def test_exact_poses_of_drawn_scenes_are_left_alone():
    scene, _ = plane.make_scene([plane.camera_above(0.0, 0.0, 4.0)])
    assert not corrects_poses(PRESET, scene)
    capture = dataclasses.replace(scene, surface=None)
    assert corrects_poses(PRESET, capture)
    assert not corrects_poses(TINY_SURFELS, capture)


def test_renders_take_the_poses_that_a_run_keeps(kept, tmp_path):
    run = pathlib.Path(shutil.copytree(kept, tmp_path / "run"))
    given = load_run_scene(read_run(run))
    names = given.names["train"]
    assert read_poses(run, names) is None
    cameras = jax.vmap(move_camera)(
        given.train.cameras, jnp.full((len(names), 6), 0.01, jnp.float32)
    )
    write_poses(run, cameras, names)
    scene = load_run_scene(read_run(run))
    np.testing.assert_array_equal(scene.train.cameras.camtoworld, cameras.camtoworld)
    np.testing.assert_array_equal(scene.test.cameras.camtoworld, given.test.cameras.camtoworld)
    if scene.photographs_at is not None:
        again = scene.photographs_at(1)
        np.testing.assert_array_equal(again[1].camera.camtoworld, cameras.camtoworld[1])
    about = json.loads((run / NAME).read_text())
    about["camtoworld"].pop(names[0])
    (run / NAME).write_text(json.dumps(about))
    with pytest.raises(RunError, match="does not hold the poses of these photographs"):
        load_run_scene(read_run(run))
