import tracemalloc

import cv2
import numpy as np
from tiny_capture import POSE, frame, write_json

from jaxcloseup.scenes import load_scene, photographs


def test_photographs_are_never_all_in_memory_at_full_size(tmp_path, monkeypatch):
    """12 photographs of 3 megapixels are 108 MB; those being read and the small ones are not."""
    monkeypatch.setattr(photographs, "_MOST_AT_ONCE", 2)
    row, column = np.mgrid[:1500, :2000]
    image = np.stack([row // 6, column // 8, (row + column) // 14], -1).astype(np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    names = [f"{i:02d}.jpg" for i in range(12)]
    for name in names:
        (tmp_path / name).write_bytes(data)
    pose = POSE.tolist()
    frames = [{"file_path": name, "transform_matrix": pose} for name in names]
    write_json(tmp_path / "transforms.json", frames, fl_x=1500.0)
    tracemalloc.start()
    try:
        scene = load_scene(tmp_path, downscale=8)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(scene.train) + len(scene.test_far) == 12
    assert scene.train.rgb.shape[1:] == (187, 250, 3)
    assert 9e6 < peak < 50e6
    np.testing.assert_allclose(scene.train.rgb[0, 90, 120], image[724, 964][::-1], atol=3)


def test_photographs_keep_the_order_of_their_frames(tmp_path):
    """However long each takes to decode."""
    for i in range(9):
        side = 400 if i % 2 else 20
        (tmp_path / f"{i}.png").write_bytes(
            cv2.imencode(".png", np.full((side, side, 3), i, np.uint8))[1].tobytes()
        )
    write_json(tmp_path / "transforms_train.json", [frame(f"{i}.png") for i in range(9)])
    scene = load_scene(tmp_path)
    assert scene.train.rgb[:, 0, 0, 0].tolist() == list(range(9))
