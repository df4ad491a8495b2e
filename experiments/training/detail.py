"""Detail of a trained state: residuals of its photographs, and how far to trust them.

Everything is made from the state and its training photographs, so a run keeps it and makes it again
where they have changed.
"""

import functools
import hashlib
import io
import itertools
import json
import pathlib
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcloseup
from experiments import progress
from experiments.training.manifest import hash_data
from experiments.training.programs import Programs, describe_photographs
from experiments.training.residuals import Window, render_residuals, reproduced
from jaxcloseup.detail import (
    FEATURES,
    Detail,
    Detailed,
    add_detail,
    find_candidates,
    testify,
)
from jaxcloseup.detail_weights import KNOTS, WIDTHS, DetailWeights, Evidence, learn_weights
from jaxcloseup.field import Rendering
from jaxcloseup.files import read_bytes, write_file
from jaxcloseup.gather import GatherSources, gather_sources
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.label_rules import label_depth
from jaxcloseup.photographs import Views, camera_at
from jaxcloseup.pyramids import Pyramid
from jaxcloseup.train import TrainState


LEFT_OUT = 60  # photographs, at most, that teach the weights
_RECIPE = 7  # a change of how detail is made raises it, so that kept detail is made again
_TEXTS = ("key", "about")
_WEIGHTS = ("center", "scale", "share", "actual")
_LARGEST = 2**32  # bytes of a file that keeps detail


def detailed(programs: Programs, detail: Detail, camera: Camera, rendering: Rendering) -> Detailed:
    """Add detail to a whole image that the programs rendered with `camera`."""
    pixels = pixel_grid(camera.height, camera.width)
    depth = label_depth(rendering, near=0, far=programs.scene.far)
    return add_detail(detail, camera, pixels, rendering.rgb, rendering.alpha, depth)


def detailed_views(programs: Programs, state: TrainState, detail: Detail, cameras: Camera) -> Views:
    """Renders of stacked cameras `[Q]` with detail; pixels weigh as much as it is trusted."""

    def label(index):
        camera = camera_at(cameras, index)
        return detailed(programs, detail, camera, programs.render(state, camera))

    found = list(progress.each(label, range(cameras.intrinsics.shape[0]), "views with detail"))
    rgb, weight = (jnp.stack([getattr(one, name) for one in found]) for name in ("rgb", "weight"))
    return Views(cameras, rgb, weight)


FindDetail = Callable[[], tuple[Detail, dict[str, Any]]]


def detail_finder(
    programs: Programs, state: TrainState, path: pathlib.Path | None = None
) -> FindDetail:
    """`find_detail` of a state, the first time that it is asked for."""
    return functools.cache(functools.partial(find_detail, programs, state, path))


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
    pyramid, divisor = programs.pyramid()
    print(f"   detail of {describe_photographs(pyramid, divisor)}", flush=True)
    count = len(scene.train)
    left_out = np.unique(np.linspace(0, count - 1, LEFT_OUT).round().astype(int)).tolist()
    shown, windows, depths = render_residuals(programs, state, pyramid, left_out)
    finer = jnp.float32(np.log2(pyramid.sizes[0][1] / scene.train.cameras.width))
    detail = Detail(shown, _sources(scene.train, shown, depths), None, finer)
    weights, table = calibrate(detail, windows)
    about = {"divisor": divisor, "sizes": list(map(list, pyramid.sizes)), "reliability": table}
    return detail.replace(weights=weights), about


def _sources(views, shown, depths):
    trust = views.weight * reproduced(shown)
    return jax.jit(gather_sources)(views.cameras, depths, trust)


def refresh_detail(
    programs: Programs, state: TrainState, detail: Detail, views: Sequence[int]
) -> Detail:
    """Detail of a state that went on from another one, of some photographs alone.

    Args:
      programs: the run's.
      state: the state that is rendered.
      detail: of the other state, whose weights stay.
      views: the photographs.
    """
    pyramid, _ = programs.pyramid()
    shown, _, depths = render_residuals(programs, state, pyramid, views=views)
    own = jax.tree.map(lambda leaf: leaf[np.asarray(views)], programs.scene.train)
    return detail.replace(shown=shown, sources=_sources(own, shown, depths))


def calibrate(detail: Detail, windows: Sequence[Window]) -> tuple[Any, list[dict[str, float]]]:
    """Learn the weights from left-out photographs.

    Each is compared, at every level, with the residual gathered from the others: as they are, and
    without their finest levels, which imitates views that are nearer than any photograph.

    Args:
      detail: without weights.
      windows: of the left-out photographs, all of one size.

    Returns:
      The weights, and their reliability: for each tenth of the predicted share the mean that was
      `predicted` and the `actual` one, both weighted by the residual's power, and the share of the
      `pixels`. Each fold of the photographs is tried with weights that the others teach.
    """
    found: dict[int, list[Evidence]] = {}
    evidence_of = progress.each(
        functools.partial(_testify, detail), windows, "windows of left-out photographs"
    )
    for window, one in zip(windows, evidence_of, strict=True):
        found.setdefault(window.view, []).append(one)
    with progress.saying("learning how far to trust the photographs"):
        weights, sums = learn_weights(list(found.values()))
    table = []
    for power, predicted, actual, count in sums:
        if power > 0:
            means = {"predicted": predicted / power, "actual": actual / power}
            means["pixels"] = count / sums[:, 3].sum()
            table.append({name: float(value) for name, value in means.items()})
    return weights, table


def _testify(detail, window):
    """`Evidence` of one window."""
    side, _ = window.depth.shape
    own = camera_at(detail.sources.cameras, window.view)
    # All levels share one static size, so that nothing is compiled twice.
    intrinsics = detail.shown.intrinsics[window.view, window.level]
    camera = own.replace(intrinsics=intrinsics, height=side, width=side)
    pixels = np.asarray(pixel_grid(side, side)) + window.corner
    seen = window.rgb, window.alpha, window.depth
    without = {"exclude": window.view, "finest": window.finest}
    found = find_candidates(detail, camera, pixels, *seen, **without)
    return jax.device_get(testify(found, window.residual, window.weight))


def _hash(programs, state):
    """What the detail depends on: the state that is rendered, the photographs, this version."""
    made_by = f"{jaxcloseup.__version__} {_RECIPE} {hash_data(programs.scene)}"
    digest = hashlib.sha256(made_by.encode())
    for leaf in jax.tree.leaves((state.params, state.buffers)):
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()


def _save(path, key, detail, about):
    arrays = {
        "values": detail.shown.values,
        "intrinsics": detail.shown.intrinsics,
        "inverse_depth": detail.sources.inverse_depth,
        "trust": detail.sources.trust,
        **{name: getattr(detail.weights, name) for name in _WEIGHTS},
        **{f"layer_{i}": layer for i, layer in enumerate(detail.weights.layers)},
        "finer": detail.finer,
    }
    arrays |= {"key": key, "about": json.dumps(about)}
    file = io.BytesIO()
    # As np.savez_compressed writes it, but for the level: a fifth of the time, 8% more bytes.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(values), allow_pickle=False)
    write_file(path, file.getvalue())


def _check(arrays, about, sizes, cameras):
    """Raise unless a file holds what `_save` writes for these cameras."""
    count, pixels = cameras.intrinsics.shape[0], sum(height * width for height, width in sizes)
    depths = (count, cameras.height, cameras.width)
    nets = len(arrays["layer_0"])
    shapes = {
        **{"values": (count, pixels, 6), "intrinsics": (count, len(sizes), 4)},
        **{"inverse_depth": depths, "trust": depths, "finer": ()},
        **{"center": (FEATURES,), "scale": (FEATURES,), "share": (KNOTS,), "actual": (KNOTS,)},
    }
    for i, (before, after) in enumerate(itertools.pairwise((FEATURES, *WIDTHS))):
        shapes |= {f"layer_{2 * i}": (nets, before, after), f"layer_{2 * i + 1}": (nets, after)}
    expected = {name: (shape, np.dtype(np.float32)) for name, shape in shapes.items()}
    expected["values"] = shapes["values"], np.dtype(np.int8)
    if {name: (array.shape, array.dtype) for name, array in arrays.items()} != expected:
        raise ValueError("other arrays")
    if set(about) != {"divisor", "sizes", "reliability"}:
        raise ValueError("another record")


def _load(path, key, cameras):
    """The kept detail and its record; None where there is none, or that of another state.

    A damaged file is reported and counts as none.
    """
    try:
        data = io.BytesIO(read_bytes(path, most=_LARGEST))
        with np.load(data, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            about = json.loads(str(kept["about"]))
            arrays = {name: kept[name] for name in kept if name not in _TEXTS}
        sizes = tuple((int(height), int(width)) for height, width in about["sizes"])
        _check(arrays, about, sizes, cameras)
    except FileNotFoundError:
        return None
    except Exception as error:  # damage can fail in any way
        print(f"{path} is damaged ({type(error).__name__}): the detail is made again")
        return None
    arrays = {name: jnp.asarray(array) for name, array in arrays.items()}
    shown = Pyramid(arrays["values"], arrays["intrinsics"], sizes)
    sources = GatherSources(cameras, arrays["inverse_depth"], arrays["trust"])
    count = sum(name.startswith("layer_") for name in arrays)
    layers = tuple(arrays[f"layer_{i}"] for i in range(count))
    weights = DetailWeights(layers=layers, **{name: arrays[name] for name in _WEIGHTS})
    return Detail(shown, sources, weights, arrays["finer"]), about
