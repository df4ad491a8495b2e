"""Detail of a trained state: residuals of its photographs, and how far to trust them.

Everything is made from the state and its training photographs, so a run keeps it and makes it again
where they have changed.
"""

import dataclasses
import hashlib
import io
import json
import pathlib
import zipfile
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import track

import jaxcloseup
from experiments.training.manifest import hash_data
from experiments.training.programs import Programs
from jaxcloseup.detail import (
    FOLDS,
    TENTHS,
    Detail,
    Detailed,
    DetailWeights,
    Evidence,
    add_detail,
    detail_features,
    evidence,
    learn_weights,
    reliability,
)
from jaxcloseup.field import Rendering
from jaxcloseup.files import write_file
from jaxcloseup.gather import GatherSources, gather, gather_sources
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.label_rules import label_depth
from jaxcloseup.metrics import fit_colors
from jaxcloseup.numerics import matmul
from jaxcloseup.photographs import camera_at, to_float
from jaxcloseup.pyramids import Pyramid, scene_pyramid
from jaxcloseup.scene import SceneError
from jaxcloseup.train import TrainState


FINER = 4  # how many times finer than in training photographs are read, if they are so fine
FINER_RAYS = 2  # the same for fields that render single rays, and so whole images slowly
LEFT_OUT = 20  # photographs that teach the weights
WINDOW = 64  # side in pixels of what is compared of such a photograph at once
MISFIT = 4  # times the median error at which a photograph has a quarter of its trust
COLOR_RIDGE = 0.01  # resistance to that map, see `fit_colors`
WINDOWS = 3  # for each of them, level and imitated distance
_TEXTS = ("key", "about")


class Shot(NamedTuple):
    """A left-out photograph at one level, as the state renders it.

    Attributes:
      view: its index.
      level: level of the pyramid.
      residual: `[H, W, 3]` in [-1, 1].
      weight: `[H, W]` weight of its pixels.
      depth: `[H, W]` rendered z-depth.
      alpha: `[H, W]` rendered opacity.
    """

    view: int
    level: int
    residual: np.ndarray
    weight: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


_add = jax.jit(add_detail)


def detailed(programs: Programs, detail: Detail, camera: Camera, rendering: Rendering) -> Detailed:
    """Add detail to a whole image that the programs rendered with `camera`."""
    pixels = pixel_grid(camera.height, camera.width)
    depth = label_depth(rendering, near=0, far=programs.scene.far)
    return _add(detail, camera, pixels, rendering.rgb, rendering.alpha, depth)


def find_detail(
    programs: Programs, state: TrainState, path: pathlib.Path | None = None
) -> tuple[Detail, dict[str, Any]]:
    """Detail of a state: what a file keeps of it, or else made now and kept there.

    Args:
      programs: the run's.
      state: the state that is rendered.
      path: the file, such as `detail_path` of a run; None keeps nothing.

    Returns:
      The detail, and a record for JSON: `divisor` of the photographs' size that the finest level
      has, `sizes` of the levels, and `reliability` of the weights, see `calibrate`.
    """
    if path is None:
        return make_detail(programs, state)
    key = _hash(programs, state)
    found = _load(path, key, programs.scene.train.cameras)
    if found is None:
        found = make_detail(programs, state)
        try:
            _save(path, key, *found)
        except OSError as error:
            print(f"the detail is made again next time: {error}")
    return found


def detail_path(folder: pathlib.Path, stage: str) -> pathlib.Path:
    """Where a run's folder keeps the detail of a stage."""
    return folder / "detail" / f"{stage}.npz"


def make_detail(programs: Programs, state: TrainState) -> tuple[Detail, dict[str, Any]]:
    """Render the residuals of all photographs, and learn from left-out ones how to weigh them."""
    scene = programs.scene
    most = FINER_RAYS if programs.method.renders_pixels else FINER
    finest = max(1, programs.preset.downscale // most)
    try:
        pyramid, divisor = scene_pyramid(scene, finest=finest)
    except SceneError as error:  # such as full-size photographs that were not kept
        print(f"   detail has only the photographs that training reads: {error}")
        alone = dataclasses.replace(scene, photographs_at=None)
        pyramid, divisor = scene_pyramid(alone, finest=finest)
    (height, width), *_ = pyramid.sizes
    share = f"1 / {divisor} of their size" if divisor > 1 else "their own size"
    print(f"   detail of photographs of {width} x {height} pixels, {share}", flush=True)
    count = len(scene.train)
    left_out = np.unique(np.linspace(0, count - 1, LEFT_OUT).round().astype(int)).tolist()
    residuals, shots, depths = render_residuals(programs, state, pyramid, left_out)
    trust = scene.train.weight * reproduced(residuals, scene.train.cameras)
    sources = jax.jit(gather_sources)(scene.train.cameras, depths, trust)
    finer = jnp.float32(np.log2(width / scene.train.cameras.width))
    detail = Detail(residuals, sources, None, finer)
    weights, table = calibrate(detail, shots)
    about = {"divisor": divisor, "sizes": list(map(list, pyramid.sizes)), "reliability": table}
    return detail.replace(weights=weights), about


def render_residuals(
    programs: Programs, state: TrainState, pyramid: Pyramid, left_out: Sequence[int]
) -> tuple[Pyramid, list[Shot], jax.Array]:
    """Render every photograph's own view at every level, and subtract it from the photograph.

    Exposure is not detail: an affine map first brings each photograph's colors to its render's.

    Args:
      programs: the run's.
      state: the state to render.
      pyramid: photographs with their weights.
      left_out: views whose renders are kept.

    Returns:
      The residuals, int8; the renders of `left_out`; and the depths `[V, H, W]` of all photographs
      at their training size.
    """
    scene = programs.scene
    cameras, far = scene.train.cameras, scene.far
    # Large images need more room than training does, which must not slow it down.
    large = Programs(programs.preset, scene)
    larger = pyramid.sizes[0][1] / cameras.width
    large.make_room(programs.growth * max(1, round(larger**2 / 2)))
    values = np.empty((*pyramid.values.shape[:2], 3), np.int8)
    shots, depths = [], []
    for view in track(range(len(scene.train)), description="   residuals"):
        own = camera_at(cameras, view)
        depths.append(label_depth(programs.render(state, own), near=scene.near, far=far))
        colors = None
        for level in reversed(range(len(pyramid.sizes))):
            seen = large.render(state, pyramid.camera(own, view, level))
            photograph = pyramid.image(view, level)
            # The coarsest level, whose detail the model has learned, shows the exposure.
            if colors is None:
                colors = _match(photograph, seen.rgb, seen.alpha)
            residual, weight = map(np.asarray, _subtract(photograph, seen.rgb, colors))
            values[view, pyramid.pixels_of(level)] = residual.reshape(-1, 3)
            if view in left_out:
                kept = (label_depth(seen, near=0, far=far), seen.alpha)
                unit = residual / np.float32(127)
                shots.append(Shot(view, level, unit, weight, *map(np.asarray, kept)))
    return pyramid.replace(values=jnp.asarray(values)), shots, jnp.stack(depths)


def reproduced(residuals: Pyramid, cameras: Camera) -> jax.Array:
    """How far the model reproduces each photograph at its coarsest level, `[V, H, W]` in [0, 1].

    Where it fails at the size that it learned from, its depth is not to be trusted either: a
    floater in front of one camera would else spoil every view that it sees.

    Args:
      residuals: of V photographs.
      cameras: stacked, of the size to return.
    """
    error = np.abs(np.asarray(residuals.level(len(residuals.sizes) - 1), np.float32)).mean(-1)
    size = cameras.width, cameras.height
    error = np.stack([cv2.resize(cv2.GaussianBlur(one, (0, 0), 1.5), size) for one in error])
    typical = max(float(np.median(error)), 1e-6)
    return jnp.asarray(1 / (1 + (error / (MISFIT * typical)) ** 4) ** 2, jnp.float32)


@jax.jit
def _match(photograph, rgb, alpha):
    """The affine change `(matrix, offset)` of a photograph's colors to those of its render.

    It is the inverse of the best change of the render, because a blurred render tells a photograph
    without bias, and a photograph a blurred render with too little contrast.
    """
    values = to_float(photograph)
    rgb = jnp.clip(rgb, 0, 1)
    # What the model lacks, or has too much, says nothing about exposure.
    error = jnp.mean(jnp.abs(values[..., :3] - rgb), axis=-1)
    typical = jnp.maximum(jnp.median(error), 1e-3)
    weight = values[..., 3] * alpha**2 / (1 + (error / (2 * typical)) ** 2) ** 2
    matrix, offset = fit_colors(rgb, values[..., :3], weight, ridge=COLOR_RIDGE)
    inverse = jnp.linalg.inv(matrix)
    change = inverse, -matmul(offset[None], inverse)[0]
    known = jnp.all(jnp.isfinite(change[0])) & jnp.all(jnp.abs(change[0]) < 2)
    same = jnp.eye(3, dtype=rgb.dtype), jnp.zeros(3, rgb.dtype)
    return jax.tree.map(lambda found, none: jnp.where(known, found, none), change, same)


@jax.jit
def _subtract(photograph, rgb, colors):
    values, (matrix, offset) = to_float(photograph), colors
    weight = values[..., 3]
    matched = matmul(values[..., :3], matrix[None]) + offset[None, None]
    residual = jnp.where(weight[..., None] > 0, matched - jnp.clip(rgb, 0, 1), 0)
    return jnp.round(127 * jnp.clip(residual, -1, 1)).astype(jnp.int8), weight


def calibrate(detail: Detail, shots: Sequence[Shot]) -> tuple[Any, list[dict[str, float]]]:
    """Learn the weights from left-out photographs.

    Each is compared, at every level, with the residual gathered from the others: as they are, and
    without their finest levels, which imitates views that are nearer than any photograph.

    Args:
      detail: without weights.
      shots: the left-out photographs.

    Returns:
      The weights, and their reliability: for each tenth of the predicted share the mean that was
      `predicted` and the `actual` one, both weighted by the residual's power, and the share of the
      `pixels`. Each fold of the photographs is tried with weights that the others teach.
    """
    found: dict[int, list[Evidence]] = {}
    for view, one in _left_out(detail, shots):
        found.setdefault(view, []).append(one)
    photographs = list(found.values())
    sums, folds = np.zeros((TENTHS, 4)), min(FOLDS, len(photographs))
    for fold in range(folds):
        teachers = [one for i, one in enumerate(photographs) if i % folds != fold]
        tried = [window for one in photographs[fold::folds] for window in one]
        sums += reliability(learn_weights(teachers or photographs), tried)
    table = []
    for power, predicted, actual, count in sums:
        if power > 0:
            means = {"predicted": predicted / power, "actual": actual / power}
            means["pixels"] = count / sums[:, 3].sum()
            table.append({name: float(value) for name, value in means.items()})
    return learn_weights(photographs), table


def _left_out(detail, shots):
    """`Evidence` of windows of left-out photographs, with the view of each."""
    levels = len(detail.residuals.sizes)
    side = min(WINDOW, *(min(shot.depth.shape) for shot in shots))
    rng = np.random.default_rng(0)
    grid = np.asarray(pixel_grid(side, side))
    for shot in shots:
        height, width = shot.depth.shape
        own = camera_at(detail.sources.cameras, shot.view)
        # All levels share one static size, so that nothing is compiled twice.
        intrinsics = detail.residuals.intrinsics[shot.view, shot.level]
        camera = own.replace(intrinsics=intrinsics, height=side, width=side)
        for finest in (0, *range(shot.level + 1, levels)):
            for _ in range(WINDOWS):
                y, x = rng.integers(height - side + 1), rng.integers(width - side + 1)
                window = np.s_[y : y + side, x : x + side]
                shown = (shot.residual, shot.weight, shot.depth, shot.alpha)
                shown = [array[window] for array in shown]
                pixels = grid + np.array([x, y], np.float32)
                one = _compare(detail, camera, pixels, *shown, shot.view, finest)
                yield shot.view, Evidence(*map(np.asarray, one))


@jax.jit
def _compare(detail, camera, pixels, residual, weight, depth, alpha, view, finest):
    sources, residuals = detail.sources, detail.residuals
    found = gather(camera, pixels, depth, sources, residuals, exclude=view, finest=finest)
    finer = detail.finer - jnp.asarray(finest, jnp.float32)
    features = detail_features(found, alpha, depth, finer=finer)
    return evidence(features, found, residual, weight)


def _hash(programs, state):
    """What the detail depends on: the state that is rendered, the photographs, this version."""
    digest = hashlib.sha256(f"{jaxcloseup.__version__} {hash_data(programs.scene)}".encode())
    for leaf in jax.tree.leaves((state.params, state.buffers)):
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()


def _save(path, key, detail, about):
    arrays = {
        "values": detail.residuals.values,
        "intrinsics": detail.residuals.intrinsics,
        "inverse_depth": detail.sources.inverse_depth,
        "trust": detail.sources.trust,
        "coefficients": detail.weights.coefficients,
        "regressed": detail.weights.regressed,
        "actual": detail.weights.actual,
        "finer": detail.finer,
    }
    file = io.BytesIO()
    np.savez_compressed(file, key=key, about=json.dumps(about), **arrays)
    write_file(path, file.getvalue())


def _load(path, key, cameras):
    """The kept detail and its record; None where there is none, or that of another state."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            about = json.loads(str(kept["about"]))
            arrays = {name: jnp.asarray(kept[name]) for name in kept if name not in _TEXTS}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    sizes = tuple(map(tuple, about["sizes"]))
    residuals = Pyramid(arrays["values"], arrays["intrinsics"], sizes)
    sources = GatherSources(cameras, arrays["inverse_depth"], arrays["trust"])
    weights = DetailWeights(*(arrays[name] for name in ("coefficients", "regressed", "actual")))
    return Detail(residuals, sources, weights, arrays["finer"]), about
