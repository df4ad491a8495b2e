"""Write captures of a few pixels, for tests of the loaders."""

import json
import os
import struct
import zlib

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
    data = cv2.imencode(path.suffix, image)[1].tobytes()
    if path.suffix == ".png":  # photographs of one content are no copies: bytes at the end differ
        data += b"%08x" % zlib.crc32(os.fsencode(path))
    path.write_bytes(data)


def tiff(image, order, orientation, *more):
    """Encode an uncompressed TIFF; `more` are further tags and their numbers."""
    height, width, channels = image.shape
    tags = {256: width, 257: height, 258: 8 * image.itemsize, 259: 1, 262: 1 + (channels > 1)}
    tags |= {273: 8, 274: orientation, 277: channels, 278: height, 279: image.nbytes, 284: 1}
    tags |= {338: 2} if channels == 4 else {}
    tags |= dict(more)
    entries = [struct.pack(order + "HHIHH", tag, 3, 1, tags[tag], 0) for tag in sorted(tags)]
    if channels > 1:  # the bits of each channel follow the directory
        bits = 8 + image.nbytes + 2 + 12 * len(entries) + 4
        entries[sorted(tags).index(258)] = struct.pack(order + "HHII", 258, 3, channels, bits)
    return b"".join(
        [
            b"II*\0" if order == "<" else b"MM\0*",
            struct.pack(order + "I", 8 + image.nbytes),
            image.astype(image.dtype.newbyteorder(order)).tobytes(),
            struct.pack(order + "H", len(entries)),
            *entries,
            bytes(4),
            struct.pack(order + f"{channels}H", *[8 * image.itemsize] * channels),
        ]
    )


def own_poses(scene, split="train"):
    """Return OpenCV poses `[V, 3, 4]` in the coordinates of the capture's files."""
    return scene.placement.poses_to_capture(getattr(scene, split).cameras.camtoworld)


def own_points(scene):
    return scene.placement.to_capture(scene.points)


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


PINHOLE = f"1 PINHOLE {WIDTH} {HEIGHT} 10 11 4 3"
POINTS = [f"{i} {i - 3} 0.5 5 {10 * i} 20 255 0.5" for i in range(1, 6)]


def image_line(number, name, pose="1 0 0 0 0 0 0", camera=1):
    return f"{number} {pose} {camera} {name}"


def write_model(folder, images, cameras=(PINHOLE,), points=POINTS):
    """Write a text model; `images` holds its lines, each image followed by its observations."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("# Cameras\n" + "".join(f"{c}\n" for c in cameras))
    (folder / "images.txt").write_text("# Images\n" + "".join(f"{line}\n" for line in images))
    (folder / "points3D.txt").write_text("# Points\n" + "".join(f"{p}\n" for p in points))


def colmap_capture(folder, count=3, model="sparse/0", depths=None, **changes):
    """Write photographs `000.png`, ... in `images/`, each of which sees five points ahead.

    Args:
      folder: folder of the capture.
      count: number of photographs.
      model: folder of the model inside `folder`.
      depths: depth of the points in each photograph; 5 by default.
      changes: arguments for `write_model`.
    """
    lines, tracks = [], [[] for _ in POINTS]
    for i in range(count):
        name = f"{i:03d}.png"
        write_image(folder / "images" / name, value=i)
        back = 0 if depths is None else depths[i] - 5
        lines.append(image_line(i + 1, name, f"1 0 0 0 {0.1 * i} 0 {back}"))
        lines.append(" ".join(f"4 3 {point}" for point in range(1, 6)))
        for point, track in enumerate(tracks):
            track.append(f"{i + 1} {point}")
    points = [f"{point} {' '.join(track)}" for point, track in zip(POINTS, tracks, strict=True)]
    write_model(folder / model, lines, **{"points": points, **changes})
    return folder


def random_pose(rng):
    """Draw a rotation as matrix `[3, 3]` and quaternion (w, x, y, z), and a position `[3]`."""
    quaternion = rng.normal(size=4)
    w, x, y, z = quaternion = quaternion / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return rotation, quaternion, rng.normal(size=3)


def llff_rows(count, seed=0):
    """Draw random cameras as rows of poses_bounds.npy and as OpenCV poses `[count, 3, 4]`."""
    rng = np.random.default_rng(seed)
    rows, poses = [], []
    for i in range(count):
        rotation, _, position = random_pose(rng)
        right, down, forward = rotation.T
        lens = [HEIGHT, WIDTH, 9.0]
        matrix = np.column_stack([down, right, -forward, position, lens])
        rows.append([*matrix.ravel(), 2.0 - 0.1 * i, 20.0 + i])
        poses.append(np.column_stack([rotation, position]))
    return np.array(rows), np.array(poses)


def llff_capture(folder):
    """Write three photographs with LLFF's file of their cameras."""
    for i in range(3):
        write_image(folder / f"images/{i}.png", value=i)
    np.save(folder / "poses_bounds.npy", llff_rows(3)[0])
    return folder
