"""Make a run's close-ups, a dolly and the page that shows them."""

import pathlib
from collections.abc import Iterable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.exposed import expose
from jaxcloseup.app.run.kept_detail import detail_getter, detail_path, detailed
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.share.closeups import CloseUp, choose_places, make_closeups
from jaxcloseup.app.share.kept import keep_closeup, kept_closeups
from jaxcloseup.app.share.places import Place, best_places
from jaxcloseup.app.share.scene_page import write_page
from jaxcloseup.app.store.stored_run import RunError, StoredRun, load_run_scene, restore
from jaxcloseup.app.view.camera_paths import (
    dolly,
    find_view,
    named_cameras,
    resized_shots,
    training_focus,
)
from jaxcloseup.app.view.orientation import up_direction
from jaxcloseup.app.view.photograph_pixels import pinhole_pixel
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.artifacts.spz import pack_spz
from jaxcloseup.artifacts.video import ENDINGS, write_video
from jaxcloseup.detail.add import Detail
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.scene import Scene
from jaxcloseup.training.state import TrainState


BEST = 3  # close-ups where none is asked for
_CANDIDATES = 12
_FRAMES, _FPS, _LONGEST = 48, 24, 960  # of the dolly, and its longer side in pixels


def present(
    folder: pathlib.Path,
    record: StoredRun,
    stage: str,
    asked: Sequence[tuple[str, tuple[float, float]]],
    *,
    near: float,
    single_file: bool,
    title: str | None = None,
    moved_to: str | None = None,
) -> list[pathlib.Path]:
    """Make close-ups of a stored run, and a page of these and of earlier ones in the folder.

    Args:
      folder: gets `closeups/`, a video `dolly` unless it has one, and `share/`.
      record: the run, of a field of splats.
      stage: whose state is shown.
      asked: names of photographs and pixels (x, y) at their own size; none: the best places.
      near: how many times nearer than the photograph.
      single_file: whether the page is one file.
      title: of the page; None: the scene's name.
      moved_to: folder of the run's capture, if that was moved.

    Returns:
      The pictures of the new close-ups, the dolly if it is new, and the page.

    Raises:
      RunError: the field has no splats.
      CameraError: a photograph or a pixel does not exist, or shows no surface.
      ValueError: an earlier close-up is damaged.
    """
    if METHODS[record.preset.method].splats is None:
        raise RunError(
            f"{record.folder} was trained with --method={record.preset.method}, which has no "
            "splats for a page: make its close-ups with the program render"
        )
    scene = load_run_scene(record, moved_to)
    places = [_place(scene, *one) for one in asked]
    programs, state = restore(record, scene, stage)
    detail, _ = detail_getter(programs, state, detail_path(record.folder, stage))()
    if not places:
        with progress.saying("choosing what to look at"):
            candidates = best_places(detail, count=_CANDIDATES, near=near)
        places = choose_places(programs, state, detail, candidates, near=near, count=BEST)
    made = make_closeups(programs, state, detail, places, near=near)
    for closeup in made:
        keep_closeup(folder / "closeups", closeup)
    paths = [folder / "closeups" / f"{closeup.name}.png" for closeup in made]
    # A run's own report has one too, as dolly.webp.
    if places and not any((folder / f"dolly{ending}").exists() for ending in ENDINGS):
        frames = _dolly(programs, state, detail, made[0], near)
        paths.append(write_video(folder / "dolly", frames, fps=_FPS))
    with progress.saying("writing the page"):
        paths.append(_write_page(folder, programs, state, title, single_file=single_file))
    return paths


def _place(scene: Scene, name: str, pixel: tuple[float, float]) -> Place:
    view = find_view(scene, name, flag="at")
    camera = scene.own_camera("train", view)
    x, y = pinhole_pixel(scene, view, pixel, given=f"--at={name}:")
    return Place(view, x / camera.width, y / camera.height)


def _write_page(
    folder: pathlib.Path,
    programs: Programs,
    state: TrainState,
    title: str | None,
    *,
    single_file: bool,
) -> pathlib.Path:
    scene = programs.scene
    assert programs.method.splats is not None
    splats, _ = pack_spz(*programs.method.splats(state.params, state.buffers))
    distances = np.linalg.norm(training_focus(scene)[1], axis=1)
    farthest = int(distances.argmax())
    return write_page(
        folder / "share",
        kept_closeups(folder / "closeups"),
        title=title or scene.name,
        splats=splats,
        overview=scene.own_camera("train", farthest),
        distance=float(distances[farthest]),
        up=up_direction(scene),
        single_file=single_file,
    )


def _dolly(
    programs: Programs, state: TrainState, detail: Detail, closeup: CloseUp, near: float
) -> Iterable[np.ndarray]:
    """Render frames, uint8 `[H, W, 3]`, whose camera ends at a close-up's."""
    end, point = closeup.camera, closeup.point
    ahead = (np.asarray(end.position) - point) @ np.asarray(end.rotation)[:, 2]
    begin = np.column_stack(
        [np.asarray(end.rotation), point + near * (np.asarray(end.position) - point)]
    )
    shots = dolly(
        end.replace(camtoworld=jnp.asarray(begin, jnp.float32)),
        (float(end.intrinsics[2]), float(end.intrinsics[3])),
        -near * float(ahead),
        magnification=near,
        frames=_FRAMES,
    )
    shots = resized_shots(shots, None, None, min(1.0, _LONGEST / max(end.height, end.width)))

    def frame(camera: Camera) -> np.ndarray:
        seen = programs.render(state, camera)
        sharper = detailed(programs, detail, camera, seen)
        return to_uint8(expose(programs, sharper.rgb, seen))

    cameras = [camera for _, camera in named_cameras(shots)]
    return progress.each(frame, cameras, "frames of the dolly")
