"""Table of runs on the same photographs in several sizes: time, memory, and what close-ups show.

    python -m experiments.studies.photograph_widths
    python -m experiments.studies.photograph_widths --scene=CAPTURE --split=closest

draws 16 photographs of `table`, half of them portrait, and six close-ups, writes them as captures
with `--widths`, or reduces the photographs of a capture to these; trains each in a process of its
own, and scores renders of about 1920 pixels' width, whatever the photographs' size. Everything lies
in `outputs/studies`; what is there is not made again.
"""

import json
import pathlib
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import cv2
import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from experiments.studies.pictures import render_detailed
from experiments.studies.tables import print_table
from experiments.studies.trained_run import open_run
from jaxcloseup.app import progress
from jaxcloseup.app.run.exposed import expose, how_taken
from jaxcloseup.app.score.targets import score_divisor
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.captures.load import load_scene
from jaxcloseup.geometry.cameras import Camera, crop_camera
from jaxcloseup.io.files import read_object
from jaxcloseup.metrics.image_metrics import psnr, quantize
from jaxcloseup.metrics.resolution import resolved_period, ring_correlation
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Photograph, Views, camera_at, to_float


FLAGS = flags.FLAGS
_PHOTOGRAPHS, _CLOSEUPS = 16, 6
_ROWS = 256  # drawn at once
_SHOWN = 1920  # width of the close-ups that are scored
_OPENGL = np.diag([1.0, -1, -1])


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("widths", ["960", "4032"], "longer sides of photographs, in pixels")
    flags.DEFINE_string("scene", "table", "built-in scene to draw, or folder of a capture")
    flags.DEFINE_string("split", "given", "how a capture's photographs are held out")
    flags.DEFINE_string("output_dir", "outputs/studies/sizes", "folder of captures and runs")


def main(_: list[str]) -> None:
    """Write captures, train on each, and print the table."""
    source, rows = pathlib.Path(FLAGS.scene), []
    scene = load_scene(FLAGS.scene, downscale=8, split=FLAGS.split)
    root = pathlib.Path(FLAGS.output_dir)
    for width in map(int, FLAGS.widths):
        folder = root / f"{source.name}_{width}"
        run = folder.with_name(f"run_{folder.name}")
        if not folder.exists():
            written = folder.with_suffix(".part")
            shutil.rmtree(written, ignore_errors=True)
            if source.is_dir():
                _reduce_capture(source, written, width)
            else:
                _write_capture(scene, written, width)
            written.rename(folder)
        record = _train(folder, run)
        found = _score(run, _closeups(scene))
        times = (f"{record[key] / 60:.1f} min" for key in ("seconds", "core_seconds"))
        cost = *times, f"{record['bytes'] / 2**30:.1f} GiB"
        rows.append([str(width), record["reduced"], *cost, *found])
    header = [
        "photographs' width",
        "reduced to",
        "time",
        "on all cores",
        "memory",
        "PSNR",
        "resolves (px)",
    ]
    print_table(f"Close-ups of {_SHOWN} pixels' width", header, rows)


def _camera(view: Camera, width: int, *, portrait: bool) -> Camera:
    """Return a camera with photographs of 4 : 3 whose longer side has `width` pixels."""
    size = (3 * width // 4, width) if portrait else (width, 3 * width // 4)
    focal = view.intrinsics[0] * width / view.width
    intrinsics = jnp.array([focal, focal, size[0] / 2, size[1] / 2])
    return view.replace(intrinsics=intrinsics, width=size[0], height=size[1])


def _draw(scene: Scene, camera: Camera) -> np.ndarray:
    """Return the true image `[H, W, 3]`, drawn in parts that fit into memory."""
    assert scene.surface is not None
    parts = []
    for top in range(0, camera.height, _ROWS):
        rows = min(_ROWS, camera.height - top)
        part = crop_camera(camera, jnp.array([0.0, top]), height=rows, width=camera.width)
        parts.append(np.asarray(scene.surface(part).rgb))
    return np.concatenate(parts)


def _views(scene: Scene, width: int) -> dict[str, list[Camera]]:
    """Return the cameras of the splits of a capture."""

    def some(views: Views, count: int, *, mixed: bool) -> list[Camera]:
        chosen = np.linspace(0, len(views) - 1, count).round().astype(int)
        return [
            _camera(camera_at(views.cameras, int(view)), width, portrait=mixed and i % 2 == 1)
            for i, view in enumerate(chosen)
        ]

    return {
        "train": some(scene.train, _PHOTOGRAPHS, mixed=True),
        "test": some(scene.test, _CLOSEUPS, mixed=False),
    }


def _write_capture(scene: Scene, folder: pathlib.Path, width: int) -> None:
    """Draw photographs, and write them with their poses and the scene's points."""
    for split, cameras in _views(scene, width).items():
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for i, camera in enumerate(progress.track(cameras, f"{split} of {width} pixels")):
            name = f"{split}/{i:02d}.jpg"
            imageio.imwrite(folder / name, to_uint8(_draw(scene, camera)), quality=95)
            pose = np.eye(4)
            pose[:3] = camera.camtoworld
            pose[:3, :3] = pose[:3, :3] @ _OPENGL
            intrinsics = dict(
                zip(("fx", "fy", "cx", "cy"), map(float, camera.intrinsics), strict=True)
            )
            size = {"w": camera.width, "h": camera.height}
            frames.append(
                {"file_path": name, "transform_matrix": pose.tolist(), **intrinsics, **size}
            )
        text = json.dumps({"near": scene.near, "far": scene.far, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    points = np.column_stack([scene.points, np.round(255 * np.asarray(scene.rgb)).astype(int)])
    names = [f"property float {axis}" for axis in "xyz"]
    names += [f"property uchar {color}" for color in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
    lines = ("{:.6g} {:.6g} {:.6g} {:.0f} {:.0f} {:.0f}".format(*row) for row in points)
    (folder / "points3d.ply").write_text("\n".join([*header, *lines, ""]))


def _reduce_capture(source: pathlib.Path, folder: pathlib.Path, width: int) -> None:
    """Copy a capture, and reduce the longer side of its photographs to `width` pixels."""
    shutil.copytree(source, folder)
    for file in progress.track(sorted((folder / "images").rglob("*.*")), f"{width} pixels"):
        photograph = imageio.imread(file)
        factor = width / max(photograph.shape[:2])
        if factor < 1:
            size = [round(factor * side) for side in photograph.shape[1::-1]]
            reduced = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
            imageio.imwrite(file, reduced, quality=95)


def _train(capture: pathlib.Path, run: pathlib.Path) -> dict[str, Any]:
    """Train a run on a capture, and return its time, its memory and its size of training."""
    record = run.with_suffix(".json")
    if not record.exists():
        given = [f"--scene={capture}", f"--output_dir={run}", "--seed=0", "--stages=detail"]
        given.append(f"--split={FLAGS.split}")
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-m", "experiments.run", *given], check=True)
        seconds, used = time.perf_counter() - begun, read_object(run / "manifest.json")
        found = {
            "seconds": seconds,
            "core_seconds": used["core_seconds"],
            "bytes": used["peak_bytes"],
            "reduced": "x".join(map(str, read_object(run / "results.json")["resolution"])),
        }
        record.write_text(json.dumps(found))
    return read_object(record)


def _closeups(scene: Scene) -> Iterator[tuple[str, Photograph]]:
    """Return close-ups of about `_SHOWN` pixels' width with their names in the captures.

    Cameras are in the coordinates of the capture's files, from which each run moves its scene.
    """
    if scene.surface is not None:
        for i, camera in enumerate(_views(scene, _SHOWN)["test"]):
            weight = np.ones((camera.height, camera.width), np.float32)
            yield f"{i:02d}", Photograph(camera, _draw(scene, camera), weight)
        return
    assert scene.photographs_at is not None
    divisor = score_divisor(scene, _SHOWN) or scene.metadata["downscale"]
    photographs = scene.photographs_at(divisor, "test")
    for name, photograph in zip(scene.names["test"], photographs, strict=True):
        poses = scene.placement.poses_to_capture(np.asarray(photograph.camera.camtoworld))
        yield name, photograph._replace(camera=photograph.camera.replace(camtoworld=poses))


def _score(folder: pathlib.Path, closeups: Iterator[tuple[str, Photograph]]) -> list[str]:
    """Return PSNR and the finest resolved period of close-ups, field alone and with detail."""
    run, resolved = open_run(folder, "baseline"), jax.jit(ring_correlation)
    errors: dict[str, list[float]] = {"field": [], "detail": []}
    curves: dict[str, list[np.ndarray]] = {"field": [], "detail": []}
    placement = run.programs.scene.placement
    for name, (camera, rgb, weights) in closeups:
        pose = placement.poses_to_scene(np.asarray(camera.camtoworld))
        camera = camera.replace(camtoworld=jnp.asarray(pose, jnp.float32))
        truth, weight = quantize(to_float(rgb)), to_float(weights)
        taken = how_taken(run.programs, "test", name)
        seen = run.programs.render(run.state, camera)
        for kind, found in (("field", seen.rgb), ("detail", render_detailed(run, camera).rgb)):
            image = quantize(expose(run.programs, found, seen, taken))
            errors[kind].append(float(psnr(image, truth, weight=weight)))
            curves[kind].append(np.asarray(resolved(image, truth, weight=weight)))
    values = [f"{np.mean(found):.2f}" for found in errors.values()]
    periods = [f"{resolved_period(np.mean(found, axis=0)):.1f}" for found in curves.values()]
    return [" / ".join(values), " / ".join(periods)]


if __name__ == "__main__":
    define_flags()
    app.run(main)
