"""Write captures of a few pixels with COLMAP models or LLFF poses, for tests of the loaders."""

import numpy as np
from tiny_capture import HEIGHT, WIDTH, write_image


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
