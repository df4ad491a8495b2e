"""Rendering a run: its state is the plane as surfels, kept as a run would keep it."""

import dataclasses
import itertools
import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import plane
import pytest
from absl import flags
from absl.testing import flagsaver
from tiny_runs import KEPT, copy_of, path_file

from jaxcloseup.app.cli import render as program
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import plain_config
from jaxcloseup.app.run import fine_tuning
from jaxcloseup.app.run.labels import LabelStart
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_config import preset_from_config
from jaxcloseup.app.store.stored_run import RunError, change_settings, load_run_scene, read_run
from jaxcloseup.app.view import frames
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.labels.make import LabelSources


@pytest.fixture
def render(kept, tmp_path):
    """Run the program with flags; returns its output folder."""
    flags.FLAGS(["render"])

    def call(**given):
        given = {"run": str(kept), "output_dir": str(tmp_path / "out"), "detail": False} | given
        promotion = jax.numpy_dtype_promotion("standard")
        with promotion, flagsaver.flagsaver(compilation_cache="", **given):
            program.main(["render"])
        return tmp_path / "out"

    return call


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_test_views_are_rendered_with_their_own_cameras(render, capture_folder, capsys):
    out = render(views="test", detail=True)
    kinds = ("depth", "error", "normals", "rgb", "support", "trust")
    assert files(out) == [f"{kind}/0.png" for kind in kinds]
    truth = cv2.imread(str(capture_folder / "test" / "0.png"))
    image = cv2.imread(str(out / "rgb" / "0.png"))
    assert image.shape == truth.shape
    # Pictures with legends are as large as these need.
    panels = {kind: cv2.imread(str(out / kind / "0.png")) for kind in ("support", "error")}
    assert panels["support"].shape[1] > 720 and panels["error"].shape[1] >= 360
    assert min(panel.shape[0] for panel in panels.values()) > truth.shape[0] * 360 // truth.shape[1]
    assert np.abs(image.astype(float) - truth).mean() < 25
    # The plane's normal, towards the camera, is +z.
    red_last = cv2.imread(str(out / "normals" / "0.png"))[plane.HEIGHT // 2, plane.WIDTH // 2]
    np.testing.assert_allclose(red_last, [255, 128, 128], atol=20)
    assert "closeup after 3 steps" in capsys.readouterr().out


def test_a_dolly_is_frames_and_videos(render):
    given = {"from": "2.png", "pixel": ["16", "12"], "magnification": 2.0, "frames": 3}
    out = render(stage="baseline", support=False, **given)
    frames = [f"{kind}/{i:04d}.png" for kind in ("depth", "normals", "rgb") for i in range(3)]
    videos = [name for name in files(out) if name not in frames]
    assert sorted(set(files(out)) - set(videos)) == frames
    assert {name.split(".")[0] for name in videos} == {"depth", "normals", "rgb"}
    assert cv2.imread(str(out / "rgb" / "0002.png")).shape == (plane.HEIGHT, plane.WIDTH, 3)
    capture = cv2.VideoCapture(str(out / next(v for v in videos if v.startswith("rgb"))))
    count = 0
    while capture.grab():
        count += 1
    assert count == 3


def test_a_camera_path_may_be_fine_tuned_for(render, tmp_path, capsys):
    entry = json.loads(path_file(tmp_path).read_text())["camera_path"][0]
    file = path_file(tmp_path, camera_path=[entry])
    out = render(target=str(file), target_steps=1, set=["label_loss_weight=0.5"])
    said = capsys.readouterr().out
    assert "pixels to be rendered; 1 steps" in said and "label_psnr" in said
    tuned = (out / "rgb" / "0000.png").read_bytes()
    out = render(camera_path=str(file), output_dir=str(out.with_name("plain")), support=False)
    assert (out.with_name("plain") / "rgb" / "0000.png").read_bytes() != tuned


def test_a_path_that_sees_nothing_says_so(render, tmp_path, capsys):
    entry = json.loads(path_file(tmp_path).read_text())["camera_path"][0]
    below = dict(entry, camera_to_world=list(entry["camera_to_world"]))
    below["camera_to_world"][11] = -5.0  # it looks down, and the plane is above it
    file = path_file(tmp_path, camera_path=[below])
    render(camera_path=str(file), support=False)
    assert "\nall frames show nothing of the scene: " in capsys.readouterr().out
    file = path_file(tmp_path, camera_path=[entry, below])
    render(camera_path=str(file), support=False, output_dir=str(tmp_path / "two"))
    assert "\n1 of 2 frames show nothing of the scene: " in capsys.readouterr().out


def test_nothing_is_fine_tuned_where_the_gate_lets_no_labels_in(capture_folder, monkeypatch):
    monkeypatch.setattr(fine_tuning, "weigh", lambda *_: {"weight": 0.0})
    programs = Programs(dataclasses.replace(KEPT, gated=True), load_scene(str(capture_folder)))
    start = LabelStart("state", None)
    assert fine_tuning.fine_tune(programs, start, None, None) == "state"


MISTAKES = {
    "no such run": ({"run": "nowhere"}, "--run=nowhere is not a folder"),
    "no run": ({"run": None}, "--run is missing"),
    "nothing to render": ({"views": None}, "give exactly one of --views, .*, not none"),
    "two things": ({"orbit": True}, "exactly one of .*, not --views and --orbit"),
    "no such stage": ({"stage": "test_time"}, "choose baseline or closeup"),
    "no such views": ({"views": "val"}, "--views=val: .* choose train, test, test_far"),
    "two sizes": ({"width": 64, "scale": 0.5}, "--scale=0.5 must be .* without --width"),
    "no size": ({"scale": 0.0}, "--scale=0 must be above 0"),
    "frames of views": ({"frames": 9}, "--frames does not apply to --views"),
    "pixel of views": ({"pixel": ["3", "4"]}, "--pixel does not apply to --views"),
    "up of views": ({"up": ["0", "0", "1"]}, "--up does not apply to --views"),
    "transform of views": (
        {"camera_transform": "t.json"},
        "--camera_transform does not apply to --views",
    ),
    "no direction": ({"views": None, "orbit": True, "up": ["0"] * 3}, "--up=0,0,0 must be three"),
    "up and nan": ({"views": None, "orbit": True, "up": ["0", "nan", "1"]}, "--up=0,nan,1 must be"),
    "up in words": ({"views": None, "orbit": True, "up": ["z"]}, "--up=z must be three"),
    "steps of nothing": ({"target_steps": 3}, "--target_steps needs --fine_tune or --target"),
    "fps of views": ({"fps": 10.0}, "--fps does not apply to --views"),
    "fps": ({"views": None, "orbit": True, "fps": 0.0}, "--fps=0 must be above 0"),
    "moved to nowhere": ({"data": "nowhere"}, "nowhere is neither a folder nor"),
    "no view": ({"views": None, "from": "x", "pixel": ["3", "4"]}, "--from=x is no training view"),
    "no pixel": ({"views": None, "from": "0"}, "--from needs --pixel=x,y"),
    "not numbers": ({"views": None, "from": "0", "pixel": ["a", "b"]}, "--from needs --pixel=x,y"),
    "outside": ({"views": None, "from": "0", "pixel": ["32", "4"]}, "--pixel=32,4 is outside"),
    "no depth": ({"views": None, "from": "0", "pixel": ["0", "0"]}, "--pixel=0,0: .* no surface"),
    "farther": (
        {"views": None, "from": "0", "pixel": ["3", "4"], "magnification": 0.9},
        "--magnification=0.9 must be 1 or more",
    ),
    "no setting": ({"set": ["sharpness=3"]}, "--set=sharpness=3: .* no setting sharpness"),
    "another shape": (
        {"set": ["capacity=9"]},
        "--set changes the shape .*: .* was trained with other",
    ),
    "too large": (
        {"views": None, "orbit": True, "width": 100_000, "height": 100_000},
        r"--width and --height: frames of 100000 x 100000 pixels need 3725.3 GiB, but this .* has",
    ),
    "too large a dolly": (
        {"views": None, "from": "0", "pixel": ["16", "12"], "width": 100_000},
        r"--width and --height: frames of 100000 x 75000 pixels need",
    ),
    "no camera path": ({"views": None, "camera_path": "no.json"}, "no.json cannot be read"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_nothing_is_written(render, kept, tmp_path, mistake):
    changes, message = MISTAKES[mistake]
    before = files(kept)
    with pytest.raises(SystemExit, match=message) as error:
        render(**{"views": "test"} | changes)
    assert "\n" not in error.value.code and error.value.code.startswith("jaxcloseup render: ")
    assert not (tmp_path / "out").exists()
    assert files(kept) == before


def test_a_folder_that_holds_something_is_refused(render, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("")
    with pytest.raises(SystemExit, match="already exists and is not empty"):
        render(views="test")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("manifest.json", lambda _: "{", "manifest.json cannot be read"),
        ("manifest.json", lambda _: {"scenes": {}}, "is of a sweep or unknown"),
        ("manifest.json", lambda a: a | {"scene": "/nowhere"}, "/nowhere is not a folder"),
        ("manifest.json", lambda a: a | {"load_options": {"lens": 3}}, "options that this version"),
        ("manifest.json", lambda a: a | {"load_options": {"downscale": 2}}, "was trained with"),
        ("manifest.json", lambda a: a.pop("placement") and a, "moves and scales: render it with"),
        ("checkpoints/run.json", lambda a: a | {"config": {}}, "whose configuration this version"),
        ("checkpoints/run.json", lambda a: a, "does not hold this run's state"),
    ],
)
def test_a_run_that_does_not_fit_is_one_sentence(render, kept, tmp_path, name, change, message):
    broken = copy_of(kept, tmp_path / "broken", name, change)
    with pytest.raises(SystemExit, match=message):
        render(run=broken, views="test")


def test_other_photographs_than_it_was_trained_on_are_said(kept):
    record = read_run(kept)
    other = dataclasses.replace(record, manifest={**record.manifest, "data_sha256": "0"})
    with pytest.warns(UserWarning, match="does not hold the photographs or cameras"):
        load_run_scene(other)
    load_run_scene(record)


def test_runs_that_are_none_are_one_sentence(render, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match=r"has no manifest\.json: name the folder of a run"):
        render(run=str(tmp_path / "empty"), views="test")


@pytest.mark.parametrize("method", list(METHODS))
def test_presets_come_back_from_their_json(method):
    presets = list(METHODS[method].presets.values()) + [KEPT] * (method == KEPT.method)
    for preset in presets:
        stored = json.loads(json.dumps(plain_config(preset)))
        assert preset_from_config(stored) == (preset, {})


def test_a_preset_of_another_form_names_the_field():
    stored = plain_config(KEPT)
    field = stored["field"] | {"glow": 1}
    with pytest.raises(ValueError, match=r"config\.field has glow, which this version does not"):
        preset_from_config(stored | {"field": field})
    with pytest.raises(ValueError, match="there is no method voxels"):
        preset_from_config(stored | {"method": "voxels"})


def test_a_setting_that_a_run_lacks_has_its_default():
    stored = plain_config(KEPT)
    del stored["field"]["ssim_weight"], stored["labels"]["look_at"]
    preset, absent = preset_from_config(stored)
    assert preset == KEPT and absent == {"ssim_weight": 0.2, "look_at": False}


def test_settings_change_what_is_fine_tuned(kept):
    changed = change_settings(read_run(kept), ["steps_per_target=7", "label_loss_weight=0.5"])
    assert (changed.preset.field.steps_per_target, changed.preset.labels.label_loss_weight) == (
        7,
        0.5,
    )
    assert changed.trained == KEPT
    with pytest.raises(RunError, match=r"--set=sharpness=3: .* no setting sharpness"):
        change_settings(read_run(kept), ["sharpness=3"])


def test_support_of_a_large_image_repeats_every_second_pixel(monkeypatch):
    views, depths = plane.make_views([plane.camera_above(x, 0.0, 3.0) for x in (-1.0, 0.5)])
    camera = plane.camera_above(0.3, 0.2, 4.0, tilt=0.1)
    camera = camera.replace(height=plane.HEIGHT - 1, width=plane.WIDTH - 3)  # odd
    depth, sources = plane.surface(camera)[1], LabelSources(views, depths, blocks=None)
    every = frames._support_of(camera, depth, sources)
    monkeypatch.setattr(frames, "_LARGE", 0)
    for whole, repeated in zip(every, frames._support_of(camera, depth, sources), strict=True):
        assert whole.shape == repeated.shape == depth.shape and len(np.unique(whole)) > 1
        for i, j in itertools.product((0, 1), (0, 1)):
            part = repeated[i::2, j::2]
            np.testing.assert_array_equal(
                part, whole[::2, ::2][: part.shape[0], : part.shape[1]], strict=True
            )


def test_support_is_as_fine_as_the_photographs_own_pixels(kept, monkeypatch):
    """Photographs reduced fourfold have four times finer pixels of their own."""
    record = read_run(kept)
    programs = Programs(record.preset, load_run_scene(record))
    views, depths = plane.make_views([plane.camera_above(x, 0.0, 3.0) for x in (-1.0, 0.5)])
    sources, camera = LabelSources(views, depths, blocks=None), plane.camera_above(0.3, 0.2, 4.0)
    rgb, depth, _ = plane.surface(camera)
    seen, shown = Rendering(rgb, depth, jnp.ones_like(depth)), []
    monkeypatch.setattr(frames, "colorize_support", lambda *maps: shown.append(maps) or maps[0])
    for reduced in (1, 4):
        programs.scene = dataclasses.replace(
            programs.scene,
            metadata={**programs.scene.metadata, "downscale": reduced},
            photographs_at=lambda factor, split="train": [],
        )
        frames.draw_pictures(programs, seen, camera, sources=sources)
    (counts, whole), (same, fine) = shown
    assert np.isfinite(whole).any()
    np.testing.assert_array_equal(counts, same)
    np.testing.assert_array_equal(whole, 4 * fine)
