"""What `export` writes of a run, opened by pycolmap, by our own loader and by readers of splats."""

import dataclasses
import json

import cv2
import jax
import numpy as np
import plane
import pytest
from absl import flags
from absl.testing import flagsaver
from reference_splats import rotation_of
from tiny_capture import own_points, own_poses

from jaxcloseup.app.cli import export as program
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.store.stored_run import load_run_scene, read_run
from jaxcloseup.app.view import exporting
from jaxcloseup.artifacts.capture_files import FileView, write_colmap
from jaxcloseup.artifacts.surfel_ply import read_surfels
from jaxcloseup.captures.load import load_scene
from jaxcloseup.io.placement import Placement


@pytest.fixture(scope="module")
def export(kept):
    """Run the program with flags; returns its output folder."""
    flags.FLAGS(["export"])

    def call(folder, **given):
        given = {"run": str(kept), "output_dir": str(folder)} | given
        promotion = jax.numpy_dtype_promotion("standard")
        with promotion, flagsaver.flagsaver(compilation_cache="", **given):
            program.main(["export"])
        return folder

    return call


@pytest.fixture(scope="module")
def exported(export, tmp_path_factory):
    every = [*program._SPLATS, "cameras"]
    return export(tmp_path_factory.mktemp("exported"), files=every)


def test_splats_are_written_in_every_format(exported):
    splats = read_surfels(exported / "splats.ply")
    sizes = {path.name: path.stat().st_size for path in exported.glob("splats.*")}
    assert set(sizes) == {"splats.ply", *exporting.PACKED}
    assert sizes["splats.spz"] < sizes["splats.compressed.ply"] < sizes["splats.ply"] / 3
    header = (exported / "splats.compressed.ply").read_bytes().partition(b"end_header")[0]
    assert f"element vertex {len(splats.means)}\n".encode() in header


def test_the_offset_that_spz_cannot_hold_is_printed(kept, tmp_path, capsys):
    record = read_run(kept)
    scene = load_run_scene(record)
    files = ["splats.ply", "splats.spz"]
    for origin, said in ((np.zeros(3), 0), (np.array([4e5, 5e6, 100.0]), 1)):
        placed = dataclasses.replace(scene, placement=Placement(origin, 1.0))
        exporting.export_splats(tmp_path, record, placed, "baseline", files)
        out = capsys.readouterr().out
        offset = "splats.spz has the capture's coordinates minus 400000, 5000000, 100, then turned"
        assert out.count(offset) == out.count("coordinates minus") == said


def test_our_loader_reads_the_cameras_back(exported, capture_folder):
    before, after = load_scene(capture_folder), load_scene(exported)
    for split in before.names:
        found, expected = getattr(after, split), getattr(before, split)
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        np.testing.assert_allclose(own_poses(after, split), own_poses(before, split), atol=1e-6)
        np.testing.assert_allclose(found.cameras.intrinsics, expected.cameras.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(own_points(after), own_points(before), atol=1e-5)
    unit = after.placement.scale / before.placement.scale
    np.testing.assert_allclose((after.near, after.far), (before.near * unit, before.far * unit))


def test_pycolmap_reads_the_cameras(exported, capture_folder):
    pycolmap = pytest.importorskip("pycolmap")
    scene, model = load_scene(capture_folder), pycolmap.Reconstruction()
    model.read_text(str(exported / "sparse" / "0"))
    images = {image.name: image for image in model.images.values()}
    count = sum(map(len, scene.names.values()))
    assert len(images) == count and len(model.points3D) == len(scene.points)
    assert set(images) == {path.name for path in (exported / "images").iterdir()}
    # All splits have a photograph 0; later ones are named after their splits.
    for split, prefix in (("train", ""), ("test", "test_"), ("test_far", "test_far_")):
        image = images[f"{prefix}0.png"]
        pose = np.vstack([own_poses(scene, split)[0], [0, 0, 0, 1]])
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), np.linalg.inv(pose)[:3], atol=1e-6
        )
        camera = model.cameras[image.camera_id]
        assert (camera.model_name, camera.width, camera.height) == (
            "PINHOLE",
            plane.WIDTH,
            plane.HEIGHT,
        )
        lens = getattr(scene, split).cameras.intrinsics[0]
        np.testing.assert_allclose(camera.params, lens, rtol=1e-6)


def test_a_reader_of_colmaps_text_finds_cameras_far_from_the_origin(tmp_path):
    """It computes -R^T t with the R of the quaternion, and float32 has rounded the rotation."""
    rng = np.random.default_rng(0)
    turns = [cv2.Rodrigues(rng.normal(size=3))[0].astype(np.float32) for _ in range(8)]
    positions = np.array([4e5, 5e6, 100]) + rng.normal(size=(8, 3))
    views = [
        FileView(f"{i}.png", "train", np.column_stack([turn, position]), np.ones(4), 24, 32, False)
        for i, (turn, position) in enumerate(zip(turns, positions, strict=True))
    ]
    write_colmap(tmp_path, views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    lines = (tmp_path / "images.txt").read_text().splitlines()[1::2]
    for line, turn, position in zip(lines, turns, positions, strict=True):
        _, *pose, _, _ = line.split()
        quaternion, shift = np.split(np.array(pose, float), [4])
        rotation = rotation_of(quaternion)
        np.testing.assert_allclose(rotation.T, turn, atol=1e-6)
        np.testing.assert_allclose(-rotation.T @ shift, position, rtol=0, atol=1e-7)


def test_masks_and_far_origins_are_kept(capture_folder, tmp_path):
    """A capture whose unit and origin are a map's, with a mask and spaces in names."""
    scene = load_scene(capture_folder)
    moved = Placement(np.array([4e5, 5e6, 100.0]), 0.01)
    weight = scene.train.weight.at[0, :, :5].set(0)
    names = {"train": [f"a {name}/b" for name in scene.names["train"]]}
    scene = dataclasses.replace(
        scene,
        placement=moved,
        train=scene.train.replace(weight=weight),
        test=None,
        test_far=None,
        names=names,
        photographs_at=None,
    )
    exporting.export_cameras(tmp_path, scene)
    again = load_scene(tmp_path, split="given")
    fields = json.loads((tmp_path / "transforms.json").read_text())
    assert [f["file_path"] for f in fields["frames"]] == [f"images/a_{i}_b.png" for i in range(5)]
    np.testing.assert_allclose(own_poses(again), own_poses(scene), atol=1e-6)
    np.testing.assert_array_equal(again.train.weight, weight)
    # nerfstudio wants masks of one channel, of all photographs or of none.
    masks = [cv2.imread(str(tmp_path / f["mask_path"]), -1) for f in fields["frames"]]
    assert [mask.shape for mask in masks] == 5 * [(plane.HEIGHT, plane.WIDTH)]
    assert [mask.min() for mask in masks] == [0, 255, 255, 255, 255]


def test_a_mistake_is_one_sentence(export, kept, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="--files=spz,obj must be some of ply, compressed, spz"):
        export(tmp_path / "out", files=["spz", "obj"])
    without = dataclasses.replace(METHODS["surfels"], splats=None)
    monkeypatch.setitem(METHODS, "surfels", without)
    with pytest.raises(SystemExit, match="has no splats: choose --files=cameras"):
        export(tmp_path / "out", files=["spz"])
    assert not (tmp_path / "out").exists()
    export(tmp_path / "out")  # by default what there is
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("images", "sparse", "transforms.json", "points.ply")
    }
