"""Poses of real photographs, against the model that came with them."""

import pathlib

import numpy as np
import pytest
from posing import errors, poses_by_name, run_process


pycolmap = pytest.importorskip("pycolmap")

EVERY = 4  # of 97 photographs, which walk around a toy


def test_poses_of_real_photographs_are_those_of_their_model(shared, tmp_path):
    """Every fourth photograph: positions to 1 % of the extent, most rotations to half a degree.

    Both models have errors; of all photographs they agree to 0.5 degrees everywhere.
    """
    (tmp_path / "photographs").mkdir()
    capture = shared / "data" / "plush_raw"
    for path in sorted((capture / "images").iterdir())[::EVERY]:
        (tmp_path / "photographs" / path.name).symlink_to(path)
    out = tmp_path / "capture"
    run_process(images=str(tmp_path / "photographs"), output_dir=str(out))
    _, found = poses_by_name(out)
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    known = {
        pathlib.Path(image.name).stem: image.cam_from_world().inverse().matrix()
        for image in model.images.values()
    }
    assert len(found) > 22
    away, turned = errors(np.stack(list(found.values())), np.stack([known[n] for n in found]))
    assert away.max() < 0.01
    assert np.median(turned) < 0.5 and np.quantile(turned, 0.9) < 1
