"""`Scene`, the record that every loader returns, with its errors and warnings."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.io.messages import printable
from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.photos.views import Photograph, Views, camera_at


_FINER = 4  # times as fine as photographs are surfaces that may hide points
_NEARER = 1.01  # times the depth of a surface up to which a point lies on it


class SceneError(ValueError):
    """The scene cannot be loaded; the message is one printable sentence that says what to do."""

    def __init__(self, message: str):
        """Keep what names from files bring out of the terminal: the message is escaped."""
        super().__init__(printable(message))


class SceneWarning(UserWarning):
    """The scene was loaded, but something in its files looks like a mistake."""

    def __init__(self, message: str):
        """Keep what names from files bring out of the terminal: the message is escaped."""
        super().__init__(printable(message))


class UnknownKeyWarning(SceneWarning):
    """A file holds fields that the loader ignores."""


class ImageSizeWarning(SceneWarning):
    """Photographs differ in size from what their file states; intrinsics were scaled."""


class BlankPhotographWarning(SceneWarning):
    """Photographs are fully transparent, and were left out, or have one color everywhere."""


class NearFarWarning(SceneWarning):
    """The files give no depth range, so it was estimated."""


class DuplicateFileWarning(SceneWarning):
    """A photograph is listed more than once, or under two names."""


class PointsWarning(SceneWarning):
    """Some initial points were dropped."""


class Surface(NamedTuple):
    """The exact image, depth and normals that a camera sees, per pixel `[H, W]`.

    Attributes:
      rgb: `[H, W, 3]` anti-aliased color in [0, 1].
      depth: `[H, W]` exact z-depth at the pixel center in world units; 0 where rays hit nothing.
      normal: `[H, W, 3]` unit world normal at the pixel center, facing the camera; 0 where rays
        hit nothing.
    """

    rgb: jax.Array
    depth: jax.Array
    normal: jax.Array


@dataclasses.dataclass(frozen=True)
class Scene:
    """A capture in memory, in coordinates of its own: world units, which `placement` maps.

    Attributes:
      name: name of the scene.
      train: far photographs to train on.
      test: held-out close-ups, or None.
      test_far: held-out ordinary views, or None.
      points: `[P, 3]` float32 world points on surfaces; P may be 0.
      rgb: `[P, 3]` float32 colors of the points in [0, 1].
      near: lower bound of z-depth in the scene, in world units.
      far: upper bound of z-depth in the scene, in world units.
      names: for each split present, the names of its photographs in order.
      metadata: extra facts from the loader, such as source paths and downscale; `own_sizes`, width
        and height of each photograph of a split before it was reduced; `distortions`, what of its
        lens was undone in reading, or None; `seen`, for each training photograph the indices of the
        points that it shows, and `point_errors`, their mean reprojection errors `[P]` in pixels of
        the photographs' own size, where the files list them.
      surface: renders a `Camera` to its exact `Surface`; None for photographed scenes.
      photographs_at: reads the photographs of a split again at 1 / n of their own size, given n
        and the split, "train" by default; None where they have no finer size to be read at.
      placement: maps this world to that of the capture's files, which programs write and print.
    """

    name: str
    train: Views
    test: Views | None
    test_far: Views | None
    points: np.ndarray
    rgb: np.ndarray
    near: float
    far: float
    names: dict[str, list[str]]
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    surface: Callable[[Camera], Surface] | None = None
    photographs_at: Callable[..., list[Photograph]] | None = None
    placement: Placement = UNMOVED

    def sizes(self, split: str) -> list[tuple[int, int]]:
        """Return width and height of each photograph of a split, without its padding."""
        views = getattr(self, split)
        padded = views.cameras.width, views.cameras.height
        return self.metadata.get("sizes", {}).get(split) or [padded] * len(views)

    def camera(self, split: str, index: int) -> Camera:
        """Return the camera of one photograph, without the padding at its right and bottom."""
        width, height = self.sizes(split)[index]
        return camera_at(getattr(self, split).cameras, index).replace(width=width, height=height)

    def own_camera(self, split: str, index: int) -> Camera:
        """Return the camera of one photograph at its own size, before it was reduced."""
        camera, own = self.camera(split, index), self.metadata.get("own_sizes")
        if own is None:
            return camera
        width, height = own[split][index]
        x, y = width / camera.width, height / camera.height
        intrinsics = camera.intrinsics * jnp.array([x, y, x, y], jnp.float32)
        return camera.replace(intrinsics=intrinsics, width=width, height=height)


def keep_photographs(scene: Scene, chosen: Sequence[int]) -> Scene:
    """Return the scene with some training photographs, and the points that two of them see.

    A point that only photographs see that do not stay would tell of places that none shows.

    Args:
      scene: a scene whose metadata say nothing of single training photographs.
      chosen: indices of the training photographs that stay.
    """
    if len(chosen) == len(scene.train):
        return scene
    rows = np.array(chosen)

    def take(views: Views) -> Views:
        return jax.tree.map(lambda leaf: leaf[rows], views)

    def photographs_at(factor: int, split: str = "train") -> list[Photograph]:
        assert scene.photographs_at is not None
        found = scene.photographs_at(factor, split)
        return [found[i] for i in chosen] if split == "train" else found

    train = take(scene.train)
    surface = scene.surface
    exact = None if surface is None else jax.jit(lambda camera: surface(camera).depth)
    times_seen = np.zeros(len(scene.points), int)
    for view in range(len(rows)):
        camera = camera_at(train.cameras, view)
        depths = None
        if exact is not None:
            finer = {"height": _FINER * camera.height, "width": _FINER * camera.width}
            camera = camera.replace(intrinsics=_FINER * camera.intrinsics, **finer)
            depths = np.asarray(exact(camera))
        times_seen += _see(camera, scene.points, depths)
    metadata = dict(scene.metadata)
    for name in ("own_sizes", "distortions"):
        if own := metadata.get(name):
            metadata[name] = own | {"train": [own["train"][i] for i in chosen]}
    return dataclasses.replace(
        scene,
        metadata=metadata,
        train=train,
        points=scene.points[times_seen > 1],
        rgb=scene.rgb[times_seen > 1],
        names=scene.names | {"train": [scene.names["train"][i] for i in chosen]},
        photographs_at=scene.photographs_at and photographs_at,
    )


def _see(camera: Camera, points: np.ndarray, depths: np.ndarray | None) -> np.ndarray:
    """Return which points `[P]` lie in a camera's image, and not behind the depths `[H, W]`."""
    pixels, depth = map(np.asarray, points_to_pixels(camera, jnp.asarray(points)))
    size = np.array([camera.width, camera.height], np.float32)
    seen = np.all((pixels >= 0) & (pixels < size), axis=-1) & (depth > 0)
    if depths is None:
        return seen
    # Hidden is what lies behind all four pixels around it.
    x, y = np.floor(np.where(seen[:, None], pixels, 0) - 0.5).astype(int).T
    x, y = (
        np.clip(corner + np.array([[0], [1]]), 0, end - 1)
        for corner, end in ((x, camera.width), (y, camera.height))
    )
    around = depths[y[:, None], x[None]].max((0, 1))
    return seen & (depth <= _NEARER * around)


def move_photographs(scene: Scene, camtoworld: jax.Array) -> Scene:
    """Return the scene with other poses `[V, 3, 4]` of its training photographs."""

    def photographs_at(factor: int, split: str = "train") -> list[Photograph]:
        assert scene.photographs_at is not None
        found = scene.photographs_at(factor, split)
        if split != "train":
            return found
        return [
            photograph._replace(camera=photograph.camera.replace(camtoworld=pose))
            for photograph, pose in zip(found, camtoworld, strict=True)
        ]

    cameras = scene.train.cameras.replace(camtoworld=camtoworld)
    return dataclasses.replace(
        scene,
        train=scene.train.replace(cameras=cameras),
        photographs_at=scene.photographs_at and photographs_at,
    )
