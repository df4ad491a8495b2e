import os
import resource
import tracemalloc

import cv2
import numpy as np
import pytest
from tiny_capture import POSE, frame, write_json

from jaxcloseup.captures import photo_reading
from jaxcloseup.captures.load import SceneError, load_scene


def write_photographs(folder, count, width, height):
    """Write `count` files that show the same image but have different hashes."""
    row, column = np.mgrid[:height, :width]
    channels = [250 * row // height, 250 * column // width, 250 * (row + column) // (3 * height)]
    image = np.stack(channels, -1).astype(np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    names = [f"{i:03d}.jpg" for i in range(count)]
    for i, name in enumerate(names):
        (folder / name).write_bytes(data + b"%d" % i)  # decoders ignore bytes after the end
    pose = POSE.tolist()
    frames = [{"file_path": name, "transform_matrix": pose} for name in names]
    write_json(folder / "transforms.json", frames, fl_x=1500.0)
    return image[..., ::-1]


def test_photographs_are_never_all_in_memory_at_full_size(tmp_path, monkeypatch):
    """12 photographs of 3 megapixels take 108 MB; loading holds only a few at full size."""
    monkeypatch.setattr(photo_reading, "MAX_CONCURRENT", 2)
    image = write_photographs(tmp_path, 12, 2000, 1500)
    tracemalloc.start()
    try:
        scene = load_scene(tmp_path, downscale=8)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(scene.train) + len(scene.test_far) == 12
    assert scene.train.rgb.shape[1:] == (187, 250, 3)
    assert 9e6 < peak < 50e6
    np.testing.assert_allclose(scene.train.rgb[0, 90, 120], image[724, 964], atol=3)


def test_photographs_that_exceed_memory_are_refused_before_they_are_read(tmp_path, monkeypatch):
    write_photographs(tmp_path, 9, 400, 300)
    (tmp_path / "008.jpg").write_bytes(b"never read")
    monkeypatch.setattr(photo_reading, "installed_memory", lambda: 2 * 2**20)
    with pytest.raises(SceneError, match=r"9 photographs of 400 x 300 pixels need .* at least 3"):
        load_scene(tmp_path)
    (tmp_path / "008.jpg").write_bytes((tmp_path / "007.jpg").read_bytes() + b"8")
    assert len(load_scene(tmp_path, downscale=3).train) == 7


@pytest.mark.skipif("JAXCLOSEUP_MANY" not in os.environ, reason="JAXCLOSEUP_MANY=500 takes minutes")
@pytest.mark.parametrize("options", [{"downscale": 8}, {"split": "zoom", "zoom": 8}])
def test_many_photographs_of_12_megapixels_stay_under_2_gib(tmp_path, options):
    """Bound the peak memory of the process; 500 decoded photographs would take 18 GB."""
    count = int(os.environ["JAXCLOSEUP_MANY"])
    write_photographs(tmp_path, count, 4000, 3000)
    scene = load_scene(tmp_path, **options)
    assert len(scene.train) + len(scene.test_far) == count
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2 * 2**20  # KiB


def test_photographs_keep_the_order_of_their_frames(tmp_path):
    """The order does not depend on how long each photograph takes to decode."""
    for i in range(9):
        side = 400 if i % 2 else 20
        (tmp_path / f"{i}.png").write_bytes(
            cv2.imencode(".png", np.tri(side, dtype=np.uint8) + i)[1].tobytes()
        )
    write_json(tmp_path / "transforms_train.json", [frame(f"{i}.png") for i in range(9)])
    scene = load_scene(tmp_path)
    assert scene.train.rgb[:, 0, 0, 0].tolist() == list(range(1, 10))
