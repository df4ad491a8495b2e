"""Find the files of COLMAP's models, and prepare them for pycolmap.

Other programs write `Cameras.txt`, or points as `points3D.ply`, which pycolmap does not read. Of a
text model it cuts names at spaces, and drops the last image if no line of observations follows.
"""

import contextlib
import pathlib
import tempfile
from collections.abc import Iterator
from typing import NamedTuple


NAMES = ("cameras", "images", "points3D")
_PARENTS = ("sparse", "colmap/sparse")
MODELS = (f"{_PARENTS[0]}/0", *_PARENTS[:1], f"{_PARENTS[1]}/0")  # where models are expected


class ModelFiles(NamedTuple):
    """The files of a model that exist."""

    folder: pathlib.Path
    suffix: str  # of all but a PLY file, ".bin" or ".txt"
    paths: dict[str, pathlib.Path]  # of cameras, images, points3D, rigs and frames, by name
    ply: pathlib.Path | None  # its points, if it has no other

    def path(self, name: str) -> pathlib.Path:
        """Return the path of a file, whether it exists or not."""
        return self.paths.get(name, self.folder / (name + self.suffix))


def find_model_files(folder: pathlib.Path) -> ModelFiles | None:
    """Find a model's files in a folder, in any case; None without cameras. Binary files win."""
    if not folder.is_dir():
        return None
    # In this order, because COLMAP's own names are mostly of small letters and win.
    found = {path.name.lower(): path for path in sorted(folder.iterdir())}
    files = {name: path for name, path in found.items() if path.is_file()}
    for suffix in (".bin", ".txt"):
        if f"cameras{suffix}" in files:
            paths = {name: files.get(name.lower() + suffix) for name in NAMES}
            # pycolmap reads these, whatever they are.
            paths |= {name: found.get(name + suffix) for name in ("rigs", "frames")}
            present = {name: path for name, path in paths.items() if path}
            ply = None if "points3D" in present else files.get("points3d.ply")
            return ModelFiles(folder, suffix, present, ply)
    return None


def find_models(folder: pathlib.Path) -> list[tuple[str, int]]:
    """Find a capture's models: their folders, and how many photographs have a pose in each.

    They come in order of precedence: of the models in one folder `sparse` the largest comes first.
    Those of a single model are not counted.
    """
    families = []
    for parent in _PARENTS:
        numbered = (folder / parent).iterdir() if (folder / parent).is_dir() else ()
        names = sorted((path.name for path in numbered if path.name.isdecimal()), key=int)
        families.append([*(f"{parent}/{name}" for name in names), parent])
    models = [
        [(name, files) for name in names if (files := find_model_files(folder / name))]
        for names in [*families, ["."]]
    ]
    several = sum(map(len, models)) > 1
    counted = [
        [(name, _count_images(files) if several else 0) for name, files in family]
        for family in models
    ]
    return [one for family in counted for one in sorted(family, key=lambda model: -model[1])]


def _count_images(files: ModelFiles) -> int:
    """Count a model's photographs; 0 if its file is missing."""
    file = files.paths.get("images")
    if file is None:
        return 0
    if files.suffix == ".bin":
        with file.open("rb") as opened:
            return int.from_bytes(opened.read(8), "little")
    text = file.read_text("utf-8-sig", errors="replace")
    return sum(bool(image.strip()) for (_, image), _ in image_records(text))


def image_records(text: str) -> list[tuple[tuple[int, str], tuple[int, str]]]:
    """Split `images.txt` into lines of images and of their observations, with their numbers.

    An image without observations has an empty line, which may be missing at the end.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line[:1] != "#"]
    while lines and not lines[0][1].strip():
        lines.pop(0)
    lines += [(0, "")] * (len(lines) % 2)
    return list(zip(lines[::2], lines[1::2], strict=True))


@contextlib.contextmanager
def prepare_model(files: ModelFiles) -> Iterator[tuple[pathlib.Path, dict[int, str]]]:
    """Yield a folder that pycolmap reads, and the names of a text model's images by their ids.

    In a text model's copy, images are named by their ids.
    """
    expected = {name: files.folder / (name + files.suffix) for name in NAMES}
    if files.suffix == ".bin" and expected.items() <= files.paths.items():
        yield files.folder, {}
        return
    names: dict[int, str] = {}
    with tempfile.TemporaryDirectory() as place:
        copy = pathlib.Path(place)
        for name, path in files.paths.items():
            data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
            if path == files.paths.get("images") and files.suffix == ".txt":
                data = _without_names(data.decode(), names).encode()
            (copy / (name + files.suffix)).write_bytes(data)
        if files.ply:
            (copy / ("points3D" + files.suffix)).write_bytes(bytes(8 * (files.suffix == ".bin")))
        yield copy, names


def _without_names(text: str, names: dict[int, str]) -> str:
    """Name images by their ids, and keep their names in `names`."""
    lines = []
    for (_, image), (_, seen) in image_records(text):
        if image.strip():
            *fields, name = image.split(maxsplit=9)
            names[int(fields[0])] = name.strip()
            lines += [" ".join([*fields, fields[0]]), seen]
    return "\n".join([*lines, ""])
