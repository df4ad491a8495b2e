"""The output folder of closeup: of one source each, and never one that holds something else."""

import contextlib
import pathlib
from typing import Any

from jaxcloseup.app.cli.output_folder import check_unused
from jaxcloseup.io.files import read_object, write_json


MESH_BEGUN = ".mesh_begun"  # in the folder while closeup makes `mesh` in it
_SOURCE = "source.json"  # in the folder: what its close-ups are of, and how their run is trained


def check_folder(source: str, kind: str, folder: pathlib.Path, *, mesh: bool) -> None:
    """Refuse a folder, or with `mesh` its folder `mesh`, that holds what no closeup began.

    Raises:
      OSError: one sentence that names the flag, or the folder cannot be read.
    """
    if not _is_own(source, kind, folder) and not begun(folder):
        check_unused(folder)
    if mesh:
        check_mesh(folder)


def check_mesh(folder: pathlib.Path) -> None:
    """Refuse a folder whose `mesh` holds neither a mesh nor what closeup left of one.

    Raises:
      OSError: one sentence that names it.
    """
    made = folder / "mesh" / "mesh.json"
    if not (folder / MESH_BEGUN).exists() and not made.exists():
        check_unused(folder / "mesh")


def check_source(source: str, kind: str, folder: pathlib.Path) -> None:
    """Refuse a folder with close-ups of another source; say if the source has other files now.

    Raises:
      ValueError: one sentence that names the flag.
      OSError: the source cannot be read, or the folder not written.
    """
    if _is_own(source, kind, folder):
        return
    place = source if kind == "scene" else str(pathlib.Path(source).resolve())
    known = {"source": place, "files": _files(pathlib.Path(source), kind, folder)}
    before = begun(folder) or known
    moved = kind in ("photographs", "video") and before.get("files") == known["files"]
    if before["source"] != place and not moved:
        raise ValueError(
            f"{folder} holds close-ups of {before['source']}, not of {source}: name another "
            "folder with --output_dir"
        )
    if before.get("files") != known["files"] and (folder / "run" / "results.json").exists():
        print(
            f"{source} has other files than those that {folder} was made of, which stays as it is: "
            "to use them, name another folder with --output_dir"
        )
    if before is known:
        write_json(folder / _SOURCE, known)


def begun(folder: pathlib.Path) -> dict[str, Any]:
    """Return what a folder says of its source and training; nothing if no closeup began it.

    Raises:
      OSError: it cannot be read.
    """
    about: dict[str, Any] = {}
    if (folder / _SOURCE).is_file():
        with contextlib.suppress(ValueError):  # a file of another program, perhaps
            about = read_object(folder / _SOURCE)
    return about if "source" in about else {}


def keep(folder: pathlib.Path, **about: Any) -> None:
    """Write more of what `begun` returns.

    Raises:
      OSError: the folder cannot be read or written.
    """
    write_json(folder / _SOURCE, begun(folder) | about)


def _is_own(source: str, kind: str, folder: pathlib.Path) -> bool:
    """Return whether close-ups go into the folder of the run that they are of."""
    return kind == "run" and folder.resolve() == pathlib.Path(source).resolve()


def _files(source: pathlib.Path, kind: str, folder: pathlib.Path) -> list[list[Any]]:
    """Return names and bytes of the photographs or the video; nothing of what has poses."""
    from jaxcloseup.captures.photo_files import ENDINGS

    found = [source] if kind == "video" else []
    if kind == "photographs":
        paths = (path for path in source.rglob("*") if path.suffix.lower() in ENDINGS)
        files = (path for path in paths if path.is_file())  # not a link to what is gone
        made = folder.resolve()  # perhaps within the photographs
        found = [path for path in files if made not in path.resolve().parents]
    return sorted([path.name, path.stat().st_size] for path in found)
