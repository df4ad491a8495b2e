"""Exposures in EXIF that Pillow wrote, and files that state none."""

import math

import numpy as np
import PIL.Image
import pytest
from PIL.ExifTags import IFD, Base

from jaxcloseup.captures.photo_exif import read_exposure


def write(path, detail, make="Maker ", model="Model 3"):
    exif = PIL.Image.Exif()
    if make:
        exif[Base.Make], exif[Base.Model] = make, model
    exif.get_ifd(IFD.Exif).update(detail)
    PIL.Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(path, exif=exif.tobytes())
    return path


FULL = {Base.ExposureTime: 0.02, Base.ISOSpeedRatings: 200, Base.FNumber: 2.2}


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
def test_time_sensitivity_and_aperture_are_read(tmp_path, ending):
    found = read_exposure(write(tmp_path / f"photograph.{ending}", FULL))
    assert found.camera == "Maker Model 3"
    assert found.log_exposure == pytest.approx(math.log(0.02 * 200 / 2.2**2), abs=1e-4)


def test_a_fixed_aperture_needs_no_number(tmp_path):
    detail = {tag: value for tag, value in FULL.items() if tag != Base.FNumber}
    found = read_exposure(write(tmp_path / "photograph.jpg", detail, make=None))
    assert found.camera.strip() == ", f-number unknown" and found.log_exposure == pytest.approx(
        math.log(4)
    )


@pytest.mark.parametrize(
    "detail",
    [
        {},
        {Base.ExposureTime: 0.02},
        {Base.ISOSpeedRatings: 200},
        FULL | {Base.ExposureTime: 0.0},
        FULL | {Base.ISOSpeedRatings: 0},
        FULL | {Base.FNumber: 0.0},
    ],
)
def test_files_that_state_no_exposure(tmp_path, detail):
    assert read_exposure(write(tmp_path / "photograph.jpg", detail)) is None


def test_damaged_and_missing_files_state_none(tmp_path):
    path = write(tmp_path / "photograph.jpg", FULL)
    data = path.read_bytes()
    for end in (0, 10, 40, 80):
        path.write_bytes(data[:end])
        assert read_exposure(path) is None
    assert read_exposure(tmp_path / "absent.jpg") is None
