"""Copy photographs into a capture: upright, without duplicates, under portable names."""

import concurrent.futures
import hashlib
import io
import os
import pathlib
import re
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageOps
from PIL.ExifTags import IFD, Base

from jaxcloseup.app.process.capture_stages import NAME
from jaxcloseup.app.process.counting import progress
from jaxcloseup.app.process.options import FEWEST
from jaxcloseup.app.process.solver_process import ProcessingError
from jaxcloseup.artifacts.images import encode_png
from jaxcloseup.captures.file_kinds import unread_format
from jaxcloseup.captures.photo_files import ENDINGS, read_file, read_image
from jaxcloseup.io.files import write_file
from jaxcloseup.io.messages import printable
from jaxcloseup.photos.scene import SceneError


_AT_ONCE = 4  # photographs in memory
_LONGEST_STEM = 60  # characters
_QUALITY = 95  # of a JPEG that was turned
_KEPT = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}  # formats that COLMAP reads everywhere
_HEAD = 2**16  # bytes that tell a format
_OTHER = "is not a photograph"
_RESULT = "holds {}, as results of jaxcloseup do: move photographs of your own elsewhere"
# Files of `process`, `closeup`, and `run` and `sweep`, below which all pictures are their results.
_RESULTS = {NAME, "source.json", "manifest.json"}
_OTHERS = re.compile(r"\..*|masks")  # folders without photographs
_REDUCED = re.compile(r"images_[248]")  # and, beside `images`, those of reduced copies
_NEEDS_CONVERSION = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"}


class Copied(NamedTuple):
    """A photograph in the capture."""

    name: str  # its path in the folder `images`
    source: str  # path of the file that it was made from, in the folder of photographs
    # identifies the lens: folder, size in pixels and, if EXIF has them, camera and focal length
    lens: list[Any]

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height in pixels, the only integers that identify the lens."""
        width, height = (value for value in self.lens if isinstance(value, int))
        return width, height


def list_files(folder: pathlib.Path) -> tuple[list[pathlib.Path], dict[str, str]]:
    """List the photographs of a folder and its subfolders, and why others are left out.

    Both by path in the folder. Hidden folders, masks and reduced copies beside `images` are not
    looked at. Subfolders with results of this package are left out as a whole, because renders are
    no photographs. What `render` and `export` write elsewhere than in a run is not recognized.

    Raises:
      ProcessingError: it is not a folder, or has fewer than 3 photographs.
    """
    if not folder.is_dir():
        raise ProcessingError(f"--images={folder} is not a folder: name a folder of photographs")
    files, results = [], {}
    for place, folders, names in os.walk(folder, onerror=_refuse):
        inside = pathlib.Path(place).relative_to(folder)
        if place != str(folder) and (held := _RESULTS.intersection(names)):
            results[f"{printable(inside.as_posix())}/"] = _RESULT.format(min(held))
            folders.clear()
            continue
        folders[:] = sorted(_with_photographs(folders))
        paths = [inside / name for name in names if name[0] != "."]
        files += [path for path in paths if (folder / path).is_file()]
    files.sort()
    photographs = [path for path in files if path.suffix.lower() in ENDINGS]
    left_out = {}
    for path in files:
        if path.suffix.lower() not in ENDINGS:
            left_out[printable(path.as_posix())] = _why_not(folder / path)
    if len(photographs) < FEWEST:
        others = f" beside {len(left_out)} files that are not" if left_out else ""
        left_out |= results
        unread = [f", and {name} {why}" for name, why in left_out.items() if why != _OTHER]
        raise ProcessingError(
            f"--images={folder} holds {len(photographs)} photographs "
            f"({', '.join(sorted(ENDINGS))}){others}: poses need at least {FEWEST}"
            + "".join(unread[:1])
        )
    return photographs, left_out | results


def _with_photographs(folders: Sequence[str]) -> list[str]:
    """Return the names of folders that may hold photographs of their own."""
    others = [_OTHERS, _REDUCED] if "images" in folders else [_OTHERS]
    return [name for name in folders if not any(other.fullmatch(name) for other in others)]


def _why_not(path: pathlib.Path) -> str:
    """Say why a file is left out, by what it holds or by the ending of its name."""
    try:
        with path.open("rb") as file:
            known = unread_format(np.frombuffer(file.read(_HEAD), np.uint8))
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if known is None and path.suffix.lower() in _NEEDS_CONVERSION:
        known = "has another format", "export it as JPEG"
    return _OTHER if known is None else f"{known[0]}, which is not read: {known[1]}"


def _refuse(error: OSError) -> None:
    raise error


def copy_photographs(
    photographs: Sequence[pathlib.Path], root: pathlib.Path, folder: pathlib.Path
) -> tuple[list[Copied], dict[str, str]]:
    """Copy photographs, given by their paths in the folder `root`, into a folder.

    Subfolders stay, and photographs in different ones do not share a lens.

    JPEG and PNG files are copied as they are, unless their EXIF orientation turns them: then the
    pixels are turned and the orientation is removed, so that COLMAP and `run` see the same. Other
    formats become PNG. EXIF's focal lengths stay.

    Returns:
      The copies, in the order of the photographs, and the reasons by name why others are left out:
      unreadable files, and duplicates of earlier ones.

    Raises:
      ProcessingError: fewer than 3 photographs remain.
      OSError: a copy cannot be written.
    """
    copied: list[Copied] = []
    left_out: dict[str, str] = {}
    taken: set[str] = set()  # names of copies
    first: dict[bytes, str] = {}  # first source with each hash
    workers = min(_AT_ONCE, os.cpu_count() or 1)
    with (
        warnings.catch_warnings(),
        concurrent.futures.ThreadPoolExecutor(workers) as pool,
        progress("copying photographs", "photographs") as report,
    ):
        warnings.simplefilter("ignore")  # Pillow warns of damaged EXIF and of many pixels
        # In parts, because all that waits in a queue is in memory.
        for start in range(0, len(photographs), workers):
            part = photographs[start : start + workers]
            reading = pool.map(_read, (root / path for path in part))
            for path, made in zip(part, reading, strict=True):
                source = printable(path.as_posix())
                if isinstance(made, str):
                    left_out[source] = made
                elif made.digest in first:
                    left_out[source] = f"is the same file as {first[made.digest]}"
                else:
                    first[made.digest] = source
                    name = _new_name(path, made.ending, taken)
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    write_file(folder / name, made.data)
                    copied.append(Copied(name, source, [path.parent.as_posix(), *made.lens]))
            report(start + len(part), len(photographs))
    if len(copied) < FEWEST:
        reasons = "; ".join(f"{name} {why}" for name, why in list(left_out.items())[:3])
        raise ProcessingError(
            f"only {len(copied)} different photographs can be read, and poses need at least "
            f"{FEWEST} ({reasons})"
        )
    return copied, left_out


class _Made(NamedTuple):
    """File of a copy: its bytes and ending, the lens, and a hash of the original."""

    data: bytes
    ending: str
    lens: list[Any]
    digest: bytes


def _read(path: pathlib.Path) -> _Made | str:
    """Read a photograph, or return the reason why it is unreadable."""
    try:
        held = read_file(path)
        rgb = read_image(path, data=held)
    except SceneError as error:
        reason = str(error).removeprefix(str(path)).strip()
        return printable(reason.rstrip(".").split(": ")[0])
    data = held.tobytes()
    digest = hashlib.sha256(data).digest()
    kept, lens, turn = _about(data)
    ending = kept or ".png"
    if turn:
        try:
            data, ending = _turned(data)
            rgb = read_image(path, data=np.frombuffer(data, np.uint8))
        except Exception as error:  # Pillow reads less than OpenCV, and raises various types
            return f"cannot be turned as its EXIF says ({type(error).__name__}): export it upright"
    elif kept is None:
        data = encode_png(rgb)
    return _Made(data, ending, [rgb.shape[1], rgb.shape[0], *lens], digest)


def _about(data: bytes) -> tuple[str | None, list[Any], bool]:
    """Return the ending of a copy without conversion, EXIF's lens, and whether EXIF turns it."""
    try:
        with PIL.Image.open(io.BytesIO(data)) as image:
            exif = image.getexif()
            detail = exif.get_ifd(IFD.Exif)
            focal = [detail.get(tag) for tag in (Base.FocalLength, Base.FocalLengthIn35mmFilm)]
            lens = [str(exif.get(tag)) for tag in (Base.Make, Base.Model)] + list(map(str, focal))
            turn = exif.get(Base.Orientation, 1) in range(2, 9)
            return _KEPT.get(image.format or ""), lens if any(focal) else [], turn
    except Exception:  # not known to Pillow, or damaged EXIF: OpenCV has read the pixels
        return None, [], False


def _turned(data: bytes) -> tuple[bytes, str]:
    """Turn a photograph upright; return the bytes and the ending of its new file."""
    with PIL.Image.open(io.BytesIO(data)) as image:
        upright = PIL.ImageOps.exif_transpose(image)
        kept = {"exif": upright.getexif(), "icc_profile": image.info.get("icc_profile")}
        file = io.BytesIO()
        if _KEPT.get(image.format or "") == ".jpg":
            upright.save(file, "JPEG", quality=_QUALITY, subsampling=0, **kept)
            return file.getvalue(), ".jpg"
        upright.save(file, "PNG", **kept)
        return file.getvalue(), ".png"


def _new_name(path: pathlib.Path, ending: str, taken: set[str]) -> str:
    """Return an unused path without spaces, which separate the names in COLMAP's lists."""
    *folders, stem = (_portable(part) for part in (*path.parent.parts, path.stem))
    stem = "/".join([*folders, stem])
    name, count = stem + ending, 1
    while name.lower() in taken:
        count += 1
        name = f"{stem}_{count}{ending}"
    taken.add(name.lower())
    return name


def _portable(name: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", name)[:_LONGEST_STEM].lstrip(".-") or "photograph"
