"""Cameras to render: the views of a split, an orbit, or a dolly towards a surface.

Poses are camera-to-world in the scene's own world.
"""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.view.orientation import up_direction
from jaxcloseup.captures.load import Scene
from jaxcloseup.geometry.cameras import Camera, pixels_to_points
from jaxcloseup.geometry.poses import closeup_position
from jaxcloseup.io.memory import installed_memory
from jaxcloseup.io.messages import printable
from jaxcloseup.photos.views import Views, camera_at


OPENGL = np.diag([1.0, -1, -1])  # y and z change sign between the OpenGL and OpenCV frames
_BYTES_PER_PIXEL = 400  # half of what rendering surfels took


class CameraError(Exception):
    """The requested cameras are invalid. The message is one sentence that says what to do."""

    def __init__(self, message: str) -> None:
        """Escape control characters, which may come from files."""
        super().__init__(printable(message))


class Shots(NamedTuple):
    """Cameras to render."""

    cameras: Camera  # `[Q]` stacked cameras
    names: list[str]  # file name of each camera's images, without ending
    fps: float | None = None  # frames per second that the camera path asks for, or None
    # width and height of each photograph without its padding; None if no image is padded
    sizes: list[tuple[int, int]] | None = None
    split: str | None = None  # of the photographs whose cameras these are, or None


def view_shots(scene: Scene, split: str) -> Shots:
    """Return the cameras of a split at the photographs' own size, named after these.

    Raises:
      CameraError: the scene has no such split.
    """
    views: Views | None = getattr(scene, split, None) if split in scene.names else None
    if views is None:
        raise CameraError(
            f"--views={split}: {scene.name} has no such split: choose " + ", ".join(scene.names)
        )
    own = [scene.own_camera(split, i) for i in range(len(views))]
    sizes = [(camera.width, camera.height) for camera in own]
    width, height = np.max(sizes, axis=0).tolist()
    check_memory(width, height, "--width")
    intrinsics = jnp.stack([camera.intrinsics for camera in own])
    cameras = views.cameras.replace(intrinsics=intrinsics, width=width, height=height)
    return Shots(cameras, list(scene.names[split]), sizes=sizes, split=split)


def orbit(scene: Scene, frames: int, *, up: Sequence[float] | None = None) -> Shots:
    """Return cameras on a circle around the training cameras' focus point, looking at it.

    The circle has the training cameras' median height above that point and their median distance
    from the vertical through it. Lens and image size are those of the first training photograph.

    Args:
      scene: the scene with the training cameras.
      frames: number of cameras.
      up: `[3]` up direction in the world; default: `up_direction` of the scene.
    """
    center, offset = training_focus(scene)
    axis = up_direction(scene) if up is None else _unit(np.asarray(up, np.float64))
    height = np.median(offset @ axis)
    flat = offset - (offset @ axis)[:, None] * axis
    radius = np.median(np.linalg.norm(flat, axis=1))
    # Two axes perpendicular to `axis`; the first frame is as near as possible to the first view.
    ahead = np.asarray(scene.train.cameras.rotation, np.float64)[0, :, 2]
    start = flat[0] if np.linalg.norm(flat[0]) > 1e-6 else np.cross(axis, ahead)
    east = _unit(start)
    north = np.cross(axis, east)
    poses = []
    for angle in np.arange(frames) * (2 * np.pi / frames):
        position = radius * (np.cos(angle) * east + np.sin(angle) * north) + height * axis
        poses.append(look_at(center + position, center, axis))
    first = scene.own_camera("train", 0)
    intrinsics = np.tile(np.asarray(first.intrinsics), (frames, 1))
    return numbered_shots(poses, intrinsics, first.height, first.width)


def training_focus(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the training cameras' focus point `[3]`, and positions `[V, 3]` relative to it."""
    cameras = scene.train.cameras
    positions, rotations = (np.asarray(a, np.float64) for a in (cameras.position, cameras.rotation))
    center = focus_point(positions, rotations[..., 2], near=scene.near, far=scene.far)
    return center, positions - center


def focus_point(
    positions: np.ndarray, forward: np.ndarray, *, near: float, far: float
) -> np.ndarray:
    """Return the point `[3]` nearest to all optical axes, in the least-squares sense.

    If the median depth of that point is outside `near` to `far`, return the mean over cameras of
    the point on the optical axis half-way, in inverse depth, between `near` and `far`.

    Args:
      positions: `[V, 3]` camera positions.
      forward: `[V, 3]` viewing directions, of unit length.
      near: smallest depth that the cameras see.
      far: largest depth that the cameras see.
    """
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix, vector = across.sum(0), np.einsum("vij,vj->i", across, positions)
    point = np.linalg.lstsq(matrix, vector, rcond=1e-6)[0]
    depth = np.sum((point - positions) * forward, axis=1)
    if near <= np.median(depth) <= far:
        return point
    middle = 2 / (1 / near + 1 / far)
    return np.mean(positions + middle * forward, axis=0)


def find_view(scene: Scene, name: str, *, flag: str = "from") -> int:
    """Return the index of a training view by its name, with or without file ending.

    `flag` is the one that names it.

    Raises:
      CameraError: no training view has this name.
    """
    names = scene.names["train"]
    for candidate in (name, pathlib.Path(name).stem):
        if candidate in names:
            return names.index(candidate)
    some = ", ".join(names[:3]) + (f" ... {names[-1]}" if len(names) > 3 else "")
    raise CameraError(f"--{flag}={name} is no training view of {scene.name}: choose one of {some}")


def check_pixel(camera: Camera, pixel: tuple[float, float], *, given: str = "--pixel=") -> None:
    """Refuse a pixel (x, y) outside a camera's image; `given` is how it was given, up to that.

    Raises:
      CameraError: the pixel is outside the image.
    """
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise CameraError(
            f"{given}{x:g},{y:g} is outside the view: choose a pixel within the "
            f"{camera.width} x {camera.height} pixels of the photograph"
        )


def dolly(
    camera: Camera, pixel: tuple[float, float], depth: float, *, magnification: float, frames: int
) -> Shots:
    """Return cameras that move from a view towards the surface at a pixel, without turning.

    The last camera is `magnification` times nearer to the surface. The surface's apparent size
    grows by the same factor from each frame to the next. A single frame is the last one.

    Args:
      camera: camera of the view.
      pixel: (x, y) of the surface in the view.
      depth: z-depth of the surface at the pixel.
      magnification: how many times nearer the last camera is; at least 1.
      frames: number of cameras.
    """
    anchor = pixels_to_points(camera, jnp.asarray(pixel, jnp.float32), jnp.float32(depth))
    powers = np.linspace(0, 1, frames) if frames > 1 else np.ones(1)
    poses = []
    for power in powers:
        position = closeup_position(anchor, camera.position, magnification**power)
        poses.append(np.column_stack([camera.rotation, position]))
    intrinsics = np.tile(np.asarray(camera.intrinsics), (frames, 1))
    return numbered_shots(poses, intrinsics, camera.height, camera.width)


def resized(camera: Camera, width: int | None, height: int | None) -> Camera:
    """Change the image size of a camera or of stacked cameras; the field of view stays.

    Args:
      camera: one camera, or stacked cameras.
      width: new width in pixels; None keeps the aspect ratio.
      height: new height in pixels; None keeps the aspect ratio.

    Raises:
      CameraError: such an image does not fit into memory.
    """
    if width is None:
        if height is None:
            return camera
        width = max(1, round(height * camera.width / camera.height))
    if height is None:
        height = max(1, round(width * camera.height / camera.width))
    check_memory(width, height, "--width and --height")
    x, y = width / camera.width, height / camera.height
    scale = jnp.array([x, y, x, y], jnp.float32)
    scale = scale.reshape((1,) * (camera.intrinsics.ndim - 1) + (4,))
    return camera.replace(intrinsics=camera.intrinsics * scale, height=height, width=width)


def resized_shots(
    shots: Shots, width: int | None, height: int | None, scale: float | None = None
) -> Shots:
    """Change the size of all images; the fields of view stay.

    Args:
      shots: cameras, whose images may differ in size.
      width: new width in pixels of the largest image; None keeps the aspect ratio.
      height: new height in pixels of the largest; None keeps the aspect ratio.
      scale: factor on both, without `width` and `height`; None: 1.

    Raises:
      CameraError: such images do not fit into memory.
    """
    before = shots.cameras
    if scale is not None:
        width, height = (max(1, round(scale * side)) for side in (before.width, before.height))
    cameras = resized(before, width, height)
    x, y = cameras.width / before.width, cameras.height / before.height
    sizes = shots.sizes and [(max(1, round(x * w)), max(1, round(y * h))) for w, h in shots.sizes]
    return shots._replace(cameras=cameras, sizes=sizes)


def check_memory(width: int, height: int, given_by: str) -> None:
    """Refuse images that would not fit into memory, before rendering them.

    Args:
      width: of the images, in pixels.
      height: of the images.
      given_by: name of the flags or fields that set the size, for the message.

    Raises:
      CameraError: they need more memory than the computer has.
    """
    needed = _BYTES_PER_PIXEL * width * height
    if needed > (held := installed_memory()):
        raise CameraError(
            f"{given_by}: frames of {width} x {height} pixels need {needed / 2**30:.1f} GiB, but "
            f"this computer has {held / 2**30:.1f}: choose smaller ones"
        )


def named_cameras(shots: Shots) -> list[tuple[str, Camera]]:
    """Return each camera with its name."""
    return [(name, camera_at(shots.cameras, i)) for i, name in enumerate(shots.names)]


def numbered_shots(
    poses: Sequence[np.ndarray],
    intrinsics: Sequence[Sequence[float]] | np.ndarray,
    height: int,
    width: int,
    *,
    fps: float | None = None,
) -> Shots:
    """Return cameras of one size with these poses `[3, 4]`, named `0000`, `0001`, ..."""
    cameras = Camera(
        jnp.asarray(np.stack(poses), jnp.float32),
        jnp.asarray(intrinsics, jnp.float32),
        height,
        width,
    )
    return Shots(cameras, [f"{i:04d}" for i in range(len(poses))], fps)


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the camera-to-world pose `[3, 4]` at a position that looks at a target.

    Args:
      position: `[3]` camera position, in the world.
      target: `[3]` point to look at, in the world.
      up: `[3]` direction that points up in the image.
    """
    forward = _unit(target - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # looks straight up or down: choose any right
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right = _unit(right)
    return np.column_stack([right, np.cross(forward, right), forward, position])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.linalg.norm(vector), 1e-12)
