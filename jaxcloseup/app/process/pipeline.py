"""Make a capture in four stages: photographs, features, matches, mapping."""

import dataclasses
import hashlib
import importlib.metadata
import os
import pathlib
import shutil
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcloseup.app.process.capture_stages import Stages
from jaxcloseup.app.process.capture_summary import other_models, why_left_out
from jaxcloseup.app.process.from_above import draw_cameras
from jaxcloseup.app.process.options import LENSES
from jaxcloseup.app.process.pairs import choose_pairing, expected_seconds
from jaxcloseup.app.process.photo_folder import Copied, copy_photographs, list_files
from jaxcloseup.app.process.solver_process import ProcessingError, run_job
from jaxcloseup.app.process.video_frames import extract_frames, open_video
from jaxcloseup.app.progress import saying
from jaxcloseup.captures.contents import list_photographs
from jaxcloseup.io.files import write_file
from jaxcloseup.version import __version__


IMAGES, MODEL, PICTURE = "images", "sparse/0", "cameras.png"  # in the capture's folder
_WORK, _DATABASE = "colmap", "colmap/database.db"


@dataclasses.dataclass(frozen=True)
class Request:
    """Sources and settings of a capture."""

    images: pathlib.Path | None  # folder of photographs, or None
    video: pathlib.Path | None  # a video file, or None; exactly one of both is given
    count: int  # largest number of frames of the video
    lens: str  # a key of `choices.LENSES`
    pairs: str  # which photographs are matched: `auto` or one of `choices.PAIRINGS`

    def identity(self) -> dict[str, Any]:
        """Return all that determines the capture, for JSON.

        Raises:
          ProcessingError: the folder or the video cannot be read, or holds too little.
          OSError: likewise.
        """
        held = []
        if self.images is not None:
            sizes = (
                (path, (self.images / path).stat().st_size) for path in list_files(self.images)[0]
            )
            held = [[path.as_posix(), size] for path, size in sizes]
        if self.video is not None:
            open_video(self.video).release()
            held = [[self.video.name, self.video.stat().st_size]]
        return {
            "images": None if self.images is None else str(self.images.resolve()),
            "video": None if self.video is None else str(self.video.resolve()),
            "files": hashlib.sha256(repr(held).encode()).hexdigest(),
            "count": None if self.video is None else self.count,
            "lens": self.lens,
            "pairs": self.pairs,
            "versions": {
                "jaxcloseup": __version__,
                "pycolmap": importlib.metadata.version("pycolmap"),
            },
        }


def make_capture(request: Request, folder: pathlib.Path, stages: Stages) -> dict[str, Any]:
    """Make a capture, or continue one, and return the summary that `process.json` keeps.

    Raises:
      ProcessingError: the photographs give no model; the message says why.
      SceneError: the model cannot be read again.
      OSError: a file cannot be written.
    """
    (folder / _WORK).mkdir(exist_ok=True)
    at = {"images": str(folder / IMAGES), "database": str(folder / _DATABASE)}
    log = folder / _WORK / "log.txt"

    gathered = stages.run("photographs", IMAGES, lambda: _gather(request, folder / IMAGES))
    copied = [Copied(**each) for each in gathered["copied"]]
    names = [each.name for each in copied]
    if request.video is not None:
        print(f"took {len(names)} of the video's {gathered['frames']} frames")

    pairing = choose_pairing(request.pairs, len(names), video=request.video is not None)

    def find_features() -> dict[str, int]:
        _say_time(copied, pairing)
        given = {"lenses": _by_lens(copied), "model": LENSES[request.lens]} | at
        return run_job("features", "finding features", "photographs", log, **given)

    features = stages.run("features", _DATABASE, find_features)

    def match() -> dict[str, int]:
        given = {"database": at["database"], "pairing": pairing, "names": names}
        return run_job("matches", f"matching ({pairing})", "pairs", log, **given)

    partners = stages.run("matches", _DATABASE, match)

    def solve() -> list[dict[str, Any]]:
        shutil.rmtree(part := folder / _WORK / "model", ignore_errors=True)
        part.mkdir()
        models = run_job("mapping", "finding poses", "photographs", log, folder=str(part), **at)
        if models:
            shutil.rmtree(model := folder / MODEL, ignore_errors=True)
            model.parent.mkdir(exist_ok=True)
            part.rename(model)
        return models

    models = stages.run("mapping", MODEL, solve)
    if not models:
        raise ProcessingError(_why_no_model(features, partners))
    reasons = why_left_out(names, features, partners, models)
    left_out = {each.source: reasons[each.name] for each in copied if each.name in reasons}
    summary = {
        "photographs": len(names),
        "registered": len(models[0]["photographs"]),
        **{key: value for key, value in models[0].items() if key != "photographs"},
        "other_models": other_models(models),
        "left_out": left_out | gathered["left_out"],
    }
    stages.keep("summary", summary)
    _draw_from_above(folder)
    return summary


def _say_time(copied: Sequence[Copied], pairing: str) -> None:
    cores = os.cpu_count() or 1
    seconds = expected_seconds([each.size for each in copied], pairing, cores)
    print(f"finding poses takes about {max(1, round(seconds / 60))} minutes with {cores} cores")


def _draw_from_above(folder: pathlib.Path) -> None:
    with saying("drawing cameras and points from above"):
        listed = list_photographs(folder)
        poses = np.stack([frame.camtoworld for frame in listed.frames])
        write_file(folder / PICTURE, draw_cameras(poses, listed.points, listed.rgb))


def _gather(request: Request, folder: pathlib.Path) -> dict[str, Any]:
    """Write the photographs of the capture; remove the ones of an interrupted process."""
    shutil.rmtree(folder, ignore_errors=True)
    if request.video is not None:
        copied, frames = extract_frames(request.video, request.count, folder)
        return {"copied": [each._asdict() for each in copied], "left_out": {}, "frames": frames}
    assert request.images is not None
    photographs, left_out = list_files(request.images)
    copied, unread = copy_photographs(photographs, request.images, folder)
    places = {each.lens[0] for each in copied}
    if len(places) > 1:
        print(f"the photographs lie in {len(places)} folders, each with a lens of its own")
    return {"copied": [each._asdict() for each in copied], "left_out": left_out | unread}


def _by_lens(copied: Sequence[Copied]) -> list[list[str]]:
    lenses: dict[str, list[str]] = {}
    for each in copied:
        lenses.setdefault(str(each.lens), []).append(each.name)
    return list(lenses.values())


def _why_no_model(features: dict[str, int], partners: dict[str, int]) -> str:
    overlapping = sum(map(bool, partners.values()))
    if not overlapping:
        return (
            f"no two photographs show the same (the richest has {max(features.values())} "
            "features): take sharp photographs that overlap by more than half"
        )
    return (
        f"{overlapping} of {len(partners)} photographs overlap, but no poses fit them: move the "
        "camera between photographs instead of turning it, and show each place in three or more"
    )
