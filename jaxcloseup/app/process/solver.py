"""Run pycolmap in a separate process: features, matches and mapping.

pycolmap and OpenCV bring different copies of the libraries that write PNG files, and crash where
both are used in one process, so this module must not import OpenCV. A process can also be stopped
at any time, and keeps COLMAP's messages out of the terminal.

    python -m jaxcloseup.app.process.solver

reads one job from a line of standard input, as JSON. It writes lines of JSON: `{"done", "of"}`
any number of times, then `{"result"}`. It ends with its input, so it dies with the program that
started it.
"""

import contextlib
import json
import os
import pathlib
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pycolmap

from jaxcloseup.app.process.options import FEWEST, LONGEST_SIDE
from jaxcloseup.app.process.pairs import pairs_to_match


SEED = 0
_LARGE = 1600  # pixels of the longer side, from which photographs are not enlarged for features
_MOST_FEATURES = 8192  # in a photograph
_AT_ONCE = 2  # photographs for each thread between two lines of progress
_SECONDS = 6.0  # between two lines of progress on matches
_ENOUGH = 30  # photographs of a lens, for eight parameters instead of four
_RICHER = {"SIMPLE_RADIAL": "OPENCV", "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE"}
Say = Callable[[int, int], None]  # takes the count that is done and the total


def find_features(
    say: Say, *, database: str, images: str, lenses: Sequence[Sequence[str]], model: str
) -> dict[str, int]:
    """Find SIFT features of all photographs that lack them.

    Args:
      say: reports progress in photographs.
      database: path of COLMAP's database; made if missing.
      images: folder of the photographs.
      lenses: names of the photographs of each lens.
      model: COLMAP's name of the camera model.

    Returns:
      The number of features of each photograph.
    """
    reader = pycolmap.ImageReaderOptions(camera_model=model)
    names = [name for lens in lenses for name in lens]
    with _opened(database) as opened:
        listed = {image.name for image in opened.read_all_images()}
    if listed != set(names):  # new, or interrupted so early that it holds nothing else
        for ending in ("", "-wal", "-shm"):
            pathlib.Path(database + ending).unlink(missing_ok=True)
        pycolmap.Database.open(database).close()
        # Ids follow this order, whatever ends first later: the mapping depends on it.
        for lens in lenses:
            pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, lens, reader)
    with _opened(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        missing = [name for name in names if not opened.exists_descriptors(ids[name])]
        lens_of = {image.name: image.camera_id for image in opened.read_all_images()}
        sides = {one.camera_id: max(one.width, one.height) for one in opened.read_all_cameras()}
    done, step = len(names) - len(missing), _AT_ONCE * _threads()
    say(done, len(names))
    for large in (False, True):
        some = [name for name in missing if (sides[lens_of[name]] >= _LARGE) == large]
        for start in range(0, len(some), step):
            part = some[start : start + step]
            pycolmap.extract_features(
                database,
                images,
                part,
                pycolmap.CameraMode.PER_IMAGE,  # each has its camera already, shared or not
                reader,
                _extraction(large),
            )
            done += len(part)
            say(done, len(names))
    with _opened(database) as opened:
        return {name: opened.num_keypoints_for_image(ids[name]) for name in names}


def _extraction(large: bool) -> pycolmap.FeatureExtractionOptions:
    """Return how features of large photographs are found, or of small ones."""
    options = pycolmap.FeatureExtractionOptions(num_threads=_threads(), max_image_size=LONGEST_SIDE)
    options.sift.max_num_features = _MOST_FEATURES
    # Large photographs have thousands of features without those of single pixels, which are most of
    # the time of finding, matching and mapping.
    options.sift.first_octave = 0 if large else -1
    return options


def match(say: Say, *, database: str, pairing: str, names: Sequence[str]) -> dict[str, int]:
    """Match and verify pairs of photographs; those in the database are not matched again.

    Args:
      say: reports progress in pairs.
      database: path of COLMAP's database.
      pairing: one of `choices.PAIRINGS`.
      names: the photographs, in the order in which they were taken.

    Returns:
      For each photograph, the number of others that show the same from another position.
    """
    with _opened(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        descriptors = [opened.read_descriptors(ids[name]).data for name in names]
    pairs = pairs_to_match(pairing, descriptors)
    del descriptors
    options = pycolmap.FeatureMatchingOptions(num_threads=_threads())
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    table = pathlib.Path(database).with_name("pairs.txt")
    pairing_options = pycolmap.ImportedPairingOptions(match_list_path=str(table))
    done, step = 0, 8 * _threads()
    say(done, len(pairs))
    while done < len(pairs):
        part = pairs[done : done + step]
        table.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in part), "utf-8")
        began = time.monotonic()
        pycolmap.match_image_pairs(database, options, pairing_options, verification)
        done += len(part)
        say(done, len(pairs))
        seconds = max(time.monotonic() - began, 1e-3)
        step = int(min(max(step * _SECONDS / seconds, step / 2, _threads()), 2 * step))
    table.unlink(missing_ok=True)
    partners = dict.fromkeys(names, 0)
    with _opened(database) as opened:
        by_id = {number: name for name, number in ids.items()}
        numbers, inliers = opened.read_two_view_geometry_num_inliers()
        for number, count in zip(numbers, inliers, strict=True):
            for image in pycolmap.pair_id_to_image_pair(number) if count else ():
                partners[by_id[image]] += 1
    return partners


def map_photographs(say: Say, *, database: str, images: str, folder: str) -> list[dict[str, Any]]:
    """Solve poses, lenses and points, and write the model with most photographs.

    Uses one thread: sums over several threads depend on their order, and so would the results.

    Args:
      say: reports how many photographs have a pose.
      database: path of COLMAP's database.
      images: folder of the photographs.
      folder: existing empty folder for the binary files of the model.

    Returns:
      A record for each model, the written one first; empty without any.
    """
    with _opened(database) as opened:
        total = opened.num_images()
    found = 0

    def count(more: int) -> None:
        nonlocal found
        found += more
        say(min(found, total), total)

    pycolmap.set_random_seed(SEED)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=SEED, min_model_size=FEWEST
    )
    models = pycolmap.incremental_mapping(
        database,
        images,
        folder,
        options,
        initial_image_pair_callback=lambda: count(2),
        next_image_callback=lambda: count(1),
    )
    for written in pathlib.Path(folder).iterdir():  # each model in a folder of its own
        shutil.rmtree(written)
    ranked = sorted(
        models.values(),
        key=lambda model: (model.num_reg_images(), model.num_points3D()),
        reverse=True,
    )
    if ranked:
        _refine(ranked[0])
        ranked[0].write_binary(folder)
    return [_about(model) for model in ranked]


def _refine(model: pycolmap.Reconstruction) -> None:
    """Solve again with more distortion parameters for lenses that have enough photographs.

    With many parameters from the start, the first photographs would be fitted with a wrong
    distortion that fits no others.
    """
    changed = False
    for camera in model.cameras.values():
        if _posed(model, camera) >= _ENOUGH and camera.model_name in _RICHER:
            values = dict(zip(camera.params_info.split(", "), camera.params, strict=True))
            camera.model = pycolmap.CameraModelId.__members__[_RICHER[camera.model_name]]
            focal, center = [values["f"]] * 2, [values["cx"], values["cy"]]
            camera.params = [*focal, *center, values["k"], 0.0, 0.0, 0.0]
            changed = True
    if changed:
        options = pycolmap.BundleAdjustmentOptions()
        options.ceres.solver_options.num_threads = 1
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()


def _posed(model: pycolmap.Reconstruction, camera: pycolmap.Camera) -> int:
    """Count the photographs of a lens that have a pose."""
    images = model.images.values()
    return sum(image.has_pose for image in images if image.camera_id == camera.camera_id)


def _about(model: pycolmap.Reconstruction) -> dict[str, Any]:
    names = sorted(image.name for image in model.images.values() if image.has_pose)
    lenses = []
    for camera in model.cameras.values():
        if posed := _posed(model, camera):
            parameters = camera.params_info.split(", ")
            about = {
                "model": camera.model_name,
                "size": [camera.width, camera.height],
                "parameters": dict(zip(parameters, map(float, camera.params), strict=True)),
                "focal_length_in_exif": bool(camera.has_prior_focal_length),
                "photographs": posed,
            }
            lenses.append(about)
    return {
        "photographs": names,
        "points": model.num_points3D(),
        "reprojection_error": model.compute_mean_reprojection_error(),
        "track_length": model.compute_mean_track_length(),
        "lenses": lenses,
    }


@contextlib.contextmanager
def _opened(database: str) -> Iterator[Any]:
    opened = pycolmap.Database.open(database)
    try:
        yield opened
    finally:
        opened.close()


def _threads() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


JOBS: dict[str, Callable[..., Any]] = {
    "features": find_features,
    "matches": match,
    "mapping": map_photographs,
}


def main() -> None:
    """Run the job that standard input describes."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # so that no library prints among the answers
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    job = json.loads(sys.stdin.readline())

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()

    def say(done: int, total: int) -> None:
        print(json.dumps({"done": done, "of": total}), file=answers, flush=True)

    result = JOBS[job.pop("job")](say, **job)
    print(json.dumps({"result": result}), file=answers, flush=True)


if __name__ == "__main__":
    main()
