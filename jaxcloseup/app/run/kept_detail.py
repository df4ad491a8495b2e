"""Detail of a trained state: residuals of its photographs, and its depth in their views.

Everything is made from the state and its training photographs, so a run keeps it and makes it again
where they have changed.
"""

import dataclasses
import functools
import hashlib
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcloseup
from jaxcloseup.app import progress
from jaxcloseup.app.run.left_out import LeftOut, check_left_out
from jaxcloseup.app.run.manifest import hash_data
from jaxcloseup.app.run.photograph_sizes import describe_photographs, finest_read
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.residuals import brightest, render_residuals, reproduced
from jaxcloseup.detail.add import Detail, Detailed, add_to_rendering, label_with_detail
from jaxcloseup.detail.residuals import Residuals, trusted_depths
from jaxcloseup.detail.weights import DetailWeights, known_weights, with_larger_errors
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.cache import Stored, cached
from jaxcloseup.photos.depth_maps import GatherSources, join_maps
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views
from jaxcloseup.training.state import TrainState


_RECIPE = 17  # a change of how detail is made raises it, so that kept detail is made again


def detailed(programs: Programs, detail: Detail, camera: Camera, rendering: Rendering) -> Detailed:
    """Add detail to a whole image that the programs rendered with `camera`."""
    return add_to_rendering(detail, camera, rendering, far=programs.scene.far)


def detailed_views(programs: Programs, state: TrainState, detail: Detail, cameras: Camera) -> Views:
    """Render stacked cameras `[Q]` with detail; pixels weigh as much as it is trusted."""
    return label_with_detail(
        detail,
        lambda camera: programs.render(state, camera),
        cameras,
        far=programs.scene.far,
        each=lambda label, views: progress.each(label, views, "views with detail"),
    )


GetDetail = Callable[[], tuple[Detail, dict[str, Any]]]


def detail_getter(
    programs: Programs, state: TrainState, path: pathlib.Path | None = None
) -> GetDetail:
    """Return a function that finds the detail of a state on its first call, and keeps it."""
    return functools.cache(functools.partial(find_detail, programs, state, path))


def find_detail(
    programs: Programs, state: TrainState, path: pathlib.Path | None = None
) -> tuple[Detail, dict[str, Any]]:
    """Return the detail of a state from the file that keeps it, or make it and keep it there.

    Without a path nothing is kept.

    Returns:
      The detail, and a record for JSON: `divisor` of the photographs' size that the finest level
      has, `sizes` of the levels, and what `check_left_out` found.
    """
    if path is None:
        return make_detail(programs, state)
    return cached(
        path,
        _hash(programs, state),
        lambda: make_detail(programs, state),
        pack=_pack,
        unpack=functools.partial(_unpack, programs),
        level=1,  # against zlib's default level: a fifth of the time, 8% more bytes
        report=print,
    )


def detail_path(folder: pathlib.Path, stage: str) -> pathlib.Path:
    """Return the path at which a run's folder keeps the detail of a stage."""
    return folder / "detail" / f"{stage}.npz"


def make_detail(programs: Programs, state: TrainState) -> tuple[Detail, dict[str, Any]]:
    """Render the residuals of all photographs."""
    scene = programs.scene
    pyramid, divisor = programs.pyramid()
    print(f"   detail of {describe_photographs(pyramid, divisor)}", flush=True)
    found = render_residuals(programs, state, pyramid)
    finer = jnp.float32(np.log2(pyramid.sizes[0][1] / scene.train.cameras.width))
    sources, weights = _sources(scene.train, found), _weights(scene)
    detail = Detail(found.shown, sources, weights, finer, _grain(programs, state))
    detail = detail.replace(brightest=jnp.float32(brightest(programs)))
    checked = check_left_out(programs, state, detail, pyramid)
    sizes = list(map(list, pyramid.sizes))
    about = {"divisor": divisor, "sizes": sizes, **checked._asdict()}
    return _as_checked(detail, checked), about


def _as_checked(detail: Detail, checked: LeftOut) -> Detail:
    weights = with_larger_errors(detail.weights, checked.error_scale)
    return detail.replace(weights=weights, confirmed=jnp.float32(checked.confirmed))


def _weights(scene: Scene) -> DetailWeights:
    # A built-in scene is judged without its own held-out views.
    return known_weights(scene.name if scene.surface else None)


def _grain(programs: Programs, state: TrainState) -> jax.Array:
    """Return the median radius of the splats, `[]`; 0 of a field without."""
    if programs.method.splats is None:
        return jnp.float32(0)
    splats, alive = programs.method.splats(state.params, state.buffers)
    radius = jnp.exp(jnp.max(splats.log_scales, axis=-1))
    return jnp.nan_to_num(jnp.nanmedian(jnp.where(alive, radius, jnp.nan)))


def _sources(views: Views, found: Residuals) -> GatherSources:
    height, width = found.shown.sizes[-1]  # of the largest, perhaps of some photographs alone
    trust = views.weight[:, :height, :width] * reproduced(found.shown)
    return jax.jit(trusted_depths)(found, trust)


def refresh_detail(
    programs: Programs, state: TrainState, detail: Detail, views: Sequence[int]
) -> Detail:
    """Return the detail of a state that was trained on from another, of some photographs alone.

    The weights of `detail`, which is of the other state, stay.
    """
    pyramid, _ = programs.pyramid()
    found = render_residuals(programs, state, pyramid, views)
    chosen = jax.tree.map(lambda leaf: leaf[np.asarray(views)], programs.scene.train)
    return dataclasses.replace(detail, shown=found.shown, sources=_sources(chosen, found))


def _hash(programs: Programs, state: TrainState) -> str:
    """Return a hash of what detail depends on: state, renderer, photographs, this version."""
    finest, field = finest_read(programs.preset, programs.scene), programs.preset.field
    made_by = f"{jaxcloseup.__version__} {_RECIPE} {finest} {hash_data(programs.scene)} {field}"
    digest = hashlib.sha256(made_by.encode())
    for leaf in jax.tree.leaves((state.params, state.buffers, programs.exposures)):
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()


def _pack(made: tuple[Detail, dict[str, Any]]) -> Stored:
    detail, about = made
    arrays = {
        "values": detail.shown.values,
        "intrinsics": detail.shown.intrinsics,
        "extents": detail.shown.extents,
        "inverse_depth": detail.sources.inverse_depth,
        "trust": detail.sources.trust,
        "finer": detail.finer,
        "grain": detail.grain,
    }
    return Stored({name: np.asarray(array) for name, array in arrays.items()}, about)


def _unpack(programs: Programs, stored: Stored) -> tuple[Detail, dict[str, Any]]:
    """Return what `_pack` packed; raise an exception for other arrays or another record."""
    scene = programs.scene
    about, cameras = stored.record, scene.train.cameras
    sizes = tuple((int(height), int(width)) for height, width in about["sizes"])
    _check(stored, sizes, cameras)
    level = sizes.index(stored.arrays["trust"].shape[1:])
    arrays = {name: jnp.asarray(array) for name, array in stored.arrays.items()}
    shown = Pyramid(arrays["values"], arrays["intrinsics"], arrays["extents"])
    cameras = shown.cameras(cameras, level)
    sources = join_maps(cameras, arrays["inverse_depth"], arrays["trust"])
    detail = Detail(shown, sources, _weights(scene), arrays["finer"], arrays["grain"])
    detail = detail.replace(brightest=jnp.float32(brightest(programs)))
    return _as_checked(detail, LeftOut(**{name: about[name] for name in LeftOut._fields})), about


def _check(stored: Stored, sizes: tuple[tuple[int, int], ...], cameras: Camera) -> None:
    """Raise unless a file holds what `_pack` returns for these cameras."""
    count, extents = cameras.intrinsics.shape[0], stored.arrays["extents"]
    depths = (count, *stored.arrays["trust"].shape[1:])
    expected = {
        "values": ((int(extents.prod(-1).sum()), 6), np.dtype(np.int8)),
        "intrinsics": ((count, len(sizes), 4), np.dtype(np.float32)),
        "extents": ((count, len(sizes), 2), np.dtype(np.int32)),
        "inverse_depth": (depths, np.dtype(np.float32)),
        "trust": (depths, np.dtype(np.float32)),
        "finer": ((), np.dtype(np.float32)),
        "grain": ((), np.dtype(np.float32)),
    }
    if {name: (array.shape, array.dtype) for name, array in stored.arrays.items()} != expected:
        raise ValueError("other arrays")
    if extents.min() < 1 or not np.array_equal(extents.max(0), sizes):
        raise ValueError("images of other sizes")
    if depths[1:] not in sizes:
        raise ValueError("depth maps of another size")
    if set(stored.record) != {"divisor", "sizes", *LeftOut._fields}:
        raise ValueError("another record")
