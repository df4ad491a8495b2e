"""Write captures of a few pixels, for tests of the loaders."""

import json

import cv2
import numpy as np


WIDTH, HEIGHT = 8, 6
LENS = {"fx": 10.0, "fy": 11.0, "cx": 4.0, "cy": 3.0}
POSE = np.diag([1.0, 1, 1, 1])
POSE[:3, 3] = [1, 2, 3]


def write_image(path, image=None, value=100):
    """Save an RGB or RGBA image in the format of its suffix; by default gray of 8 x 6 pixels."""
    if image is None:
        image = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, 3][: image.shape[-1]]]
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def frame(listed, **changes):
    return {"file_path": listed, "transform_matrix": POSE.tolist(), **LENS, **changes}


def write_json(path, frames, **fields):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"near": 1.0, "far": 9.0, **fields, "frames": frames}))


def paper_capture(folder):
    """The paper's layout, with two training photographs and one close-up."""
    for listed in ("train/a.png", "train/b.png", "test/a.png"):
        write_image(folder / listed, value=len(listed))
    write_json(folder / "transforms_train.json", [frame("train/a.png"), frame("train/b.png")])
    write_json(folder / "transforms_test.json", [frame("test/a.png", fx=30.0)])
    return folder


def single_file(folder, count, **fields):
    listed = [f"images/{i:03d}.png" for i in range(count)]
    for i, name in enumerate(listed):
        write_image(folder / name, value=i)
    poses = [{"file_path": name, "transform_matrix": POSE.tolist()} for name in listed]
    lens = {"fl_x": 7.0, "fl_y": 9.0, "cx": 3.5, "cy": 2.5, "w": WIDTH, "h": HEIGHT}
    write_json(folder / "transforms.json", poses[::-1], **lens, k1=0.0, aabb_scale=16, **fields)


PROPERTIES = [("x", "f4"), ("y", "f8"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
PLY_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}


def write_ply(path, vertices, encoding="binary_little_endian", newline="\n", after=b""):
    lines = ["ply", f"format {encoding} 1.0", "comment made by hand"]
    lines += [f"element vertex {len(vertices)}"]
    for name in vertices.dtype.names:
        lines += [f"property {PLY_NAMES[vertices.dtype[name].str[1:]]} {name}"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    if encoding == "ascii":
        body = "".join(" ".join(map(repr, row.tolist())) + newline for row in vertices)
        body = body.replace(",", "").replace("(", "").replace(")", "").encode()
    else:
        order = "<" if "little" in encoding else ">"
        body = vertices.astype(vertices.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(newline.join(lines).encode() + body + after)


def vertices(properties=PROPERTIES, count=5):
    rng = np.random.default_rng(3)
    result = np.zeros(count, properties)
    for name, kind in properties:
        top = {"u1": 255, "u2": 65535}.get(kind, 1)
        values = rng.integers(0, top, count) if kind[0] == "u" else rng.uniform(0, top, count)
        result[name] = values
    return result
