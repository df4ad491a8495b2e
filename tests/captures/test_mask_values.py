"""Masks of any kind: white pixels, ones, objects of a palette or in colors, shapes in alpha."""

import io

import cv2
import numpy as np
import PIL.Image
import pytest
from tiny_capture import HEIGHT, WIDTH, frame, single_file, write_image, write_json
from wrong_input import put

from jaxcloseup.captures.load import load_scene
from jaxcloseup.captures.mask_values import read_mask, understand_masks


SHAPE = np.zeros((HEIGHT, WIDTH), np.uint8)
SHAPE[:, :3] = 1
NONE, ALL = SHAPE * 0, SHAPE * 0 + 1
COLORS = [0, 0, 0, 128, 0, 0, 0, 128, 0]  # of video segmentation: objects 1 and 2


def png(pixels):
    return cv2.imencode(".png", pixels)[1].tobytes()


def saved(picture, kind="PNG", **options):
    file = io.BytesIO()
    picture.save(file, kind, **options)
    return file.getvalue()


def palette(indices, colors=COLORS, **options):
    picture = PIL.Image.fromarray(indices)
    picture.putpalette(colors)
    return saved(picture, **options)


def layers(*bands):
    return png(np.dstack(bands))


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda m: png(m * 255), "white is kept"),
        (lambda m: png(m * np.uint16(65535)), "white is kept"),
        (lambda m: png(m * np.uint16(255)), "white is kept"),
        (lambda m: saved(PIL.Image.fromarray(m > 0)), "white is kept"),
        (lambda m: saved(PIL.Image.fromarray(m > 0), "TIFF"), "white is kept"),
        (lambda m: saved(PIL.Image.fromarray(m * 255), "JPEG"), "white is kept"),
        (png, "0 and 1; 1 is kept"),
        (lambda m: png(m.astype(np.uint16)), "0 and 1; 1 is kept"),
        (lambda m: layers(m * 0, m, m * 0), "0 and 1; 1 is kept"),
        (lambda m: png(m * 128), "0 and 128; 128 is kept"),
        (palette, "palette; index above 0 is kept"),
        (lambda m: palette(m * 2), "palette; index above 0 is kept"),
        (lambda m: palette(m, [0, 0, 0, 255, 255, 255]), "white is kept"),
        (lambda m: palette(1 - m, [255, 255, 255, 0, 0, 0]), "white is kept"),
        (lambda m: palette(m, transparency=0), "shapes in alpha; opaque is kept"),
        (lambda m: layers(m * 0, m * 255, m * 0), "colors; any but black is kept"),
        (lambda m: layers(m * 0, m * 0, m * 128), "colors; any but black is kept"),
        (lambda m: layers(*[m * 0] * 3, m * 255), "shapes in alpha; opaque is kept"),
        (lambda m: layers(*[m * 0 + 90] * 3, m * 255), "shapes in alpha; opaque is kept"),
        (lambda m: layers(*[m * 255] * 3, m * 0 + 255), "white is kept"),
    ],
)
def test_all_masks_together_tell_what_a_value_means(tmp_path, write, words):
    """The first is black everywhere, and the second white."""
    shapes = [NONE, ALL, SHAPE]
    files = [tmp_path / f"{i}.png" for i in range(3)]
    for file, shape in zip(files, shapes, strict=True):
        file.write_bytes(write(shape))
    values, said = understand_masks(files)
    assert said == words
    for file, shape in zip(files, shapes, strict=True):
        np.testing.assert_allclose(read_mask(file, values), shape * 255, atol=5)  # of a JPEG
    _, inverted = understand_masks(files, inverted=True)
    assert inverted.split("; ")[-1] in (
        *("black is kept", "0 is kept", "index 0 is kept", "transparent is kept"),
    )


def test_soft_masks_stay_soft(tmp_path):
    soft = np.arange(48, dtype=np.uint8).reshape(HEIGHT, WIDTH) * 5
    write_image(tmp_path / "a.png", soft)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), soft)
    write_image(tmp_path / "a.png", soft.astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), soft)


@pytest.mark.parametrize(
    ("kept", "options", "weight", "words"),
    [
        (ALL, {}, 1, "3 of 3 photographs have a mask (white everywhere: they mask nothing)"),
        (NONE, {"invert_masks": True}, 1, "a mask (black everywhere: they mask nothing)"),
        (SHAPE, {}, 3 / 8, "3 of 3 photographs have a mask (0 and 1; 1 is kept)"),
        (SHAPE, {"invert_masks": True}, 5 / 8, "have a mask (0 and 1; 0 is kept)"),
    ],
)
def test_a_note_says_how_masks_are_understood(tmp_path, kept, options, weight, words):
    single_file(tmp_path, 3)
    for i in range(3):
        write_image(tmp_path / f"masks/00{i}.png", kept)
    scene = load_scene(tmp_path, **options)
    np.testing.assert_allclose(scene.train.weight.mean((1, 2)), weight)
    assert scene.metadata["notes"][-1].endswith(words)


@pytest.mark.parametrize("options", [{}, {"invert_masks": True}])
def test_masks_of_instant_ngp_ignore_what_is_not_black(tmp_path, options):
    """They are no photographs, and marking ignored pixels is their nature, not an inversion."""
    single_file(tmp_path, 2)
    for i in range(2):
        put(f"images/dynamic_mask_00{i}.png", palette(SHAPE))(tmp_path)
    scene = load_scene(tmp_path, **options)
    np.testing.assert_array_equal(scene.train.weight[0], 1 - SHAPE)
    assert scene.metadata["notes"][-1].endswith("all but black of dynamic_mask files is ignored)")


def test_a_mask_under_the_key_mask_filename(tmp_path):
    write_image(tmp_path / "a.png")
    write_image(tmp_path / "seg/a.png", SHAPE * 255)
    write_json(tmp_path / "transforms_train.json", [frame("a.png", mask_filename="seg/a.png")])
    np.testing.assert_array_equal(load_scene(tmp_path).train.weight[0], SHAPE)
