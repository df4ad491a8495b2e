"""Tell formats of image files by their first bytes, whatever their names say."""

import struct
from typing import NamedTuple

import numpy as np


_AS_JPEG, _DEVELOPED = "export it as JPEG", "develop it and export it as JPEG or TIFF"
_RAW = "is a camera's raw file", _DEVELOPED
_JPEG_XL = "is a JPEG XL image", _AS_JPEG
# The wheels of pillow-heif, which could read HEIC, bundle x265 under the GPL: no extra asks for it.
_HEIC = "is a HEIC photograph", _AS_JPEG
_STARTS = {  # by the offset of bytes: what the file is, and what to do
    (0, b"\xff\x0a"): _JPEG_XL,
    (0, b"\0\0\0\x0cJXL "): _JPEG_XL,
    (0, b"\x76\x2f\x31\x01"): ("is an OpenEXR image", "export it as PNG"),
    (4, b"ftypcrx "): _RAW,
    (8, b"CR\x02"): _RAW,
    **{(0, start): _RAW for start in (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")},
}
_TIFF = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}  # byte order by start
_LARGE = (b"II+\0", b"MM\0+")  # BigTIFF, of 64-bit offsets
_SUBFILE, _PHOTOMETRIC, _ORIENTATION, _PARTS = 254, 262, 274, 330
_EXTRA, _DNG = 338, 50706


class _Tag(NamedTuple):
    """A number in the first directory of a TIFF."""

    value: int
    at: int  # offset of its bytes
    code: str  # its type for `struct`


def unread_format(data: np.ndarray) -> tuple[str, str] | None:
    """Return what a file of a known format is that is not read, and what to do.

    Args:
      data: `[N]` uint8 bytes of the file.

    Returns:
      Such as "is a HEIC photograph" and "export it as JPEG"; None for any other file.
    """
    start = data[:64].tobytes()
    for (offset, wanted), said in _STARTS.items():
        if start[offset:].startswith(wanted):
            return said
    if start[4:8] == b"ftyp":
        brands = start[8 : int.from_bytes(start[:4], "big")]
        return _HEIC if b"hei" in brands or b"hev" in brands else None
    tags = _tiff_tags(data)
    # The first picture of raw files is a thumbnail, which a decoder would take for the photograph.
    if _DNG in tags or (_PARTS in tags and _SUBFILE in tags and tags[_SUBFILE].value & 1):
        return _RAW
    if _PHOTOMETRIC in tags and tags[_PHOTOMETRIC].value == 5:
        return "is a TIFF of CMYK colors", "export it as RGB"
    return None


def as_stored(data: np.ndarray) -> np.ndarray:
    """Return the bytes `[N]` of a file; of a TIFF with tags by which OpenCV changes no pixel.

    Even where it is told to return pixels as they are stored, OpenCV turns a TIFF by its
    orientation, and multiplies colors of 8 bits by alpha that is not associated with them.
    """
    tags = _tiff_tags(data)
    changed = [tag for key in (_ORIENTATION, _EXTRA) if (tag := tags.get(key)) and tag.value > 1]
    if changed:
        data = data.copy()
    for tag in changed:
        struct.pack_into(tag.code, data.data, tag.at, 1)
    return data


def _tiff_tags(data: np.ndarray) -> dict[int, _Tag]:
    """Read the numbers in the first directory of a TIFF; empty for other and damaged files."""
    start = data[:4].tobytes()
    order = _TIFF.get(start)
    if order is None:
        return {}
    large = start in _LARGE
    size, head, skip = (20, "Q", 12) if large else (12, "H", 8)
    held, tags = data.data, {}
    try:
        (at,) = struct.unpack_from(f"{order}{'Q' if large else 'I'}", held, 8 if large else 4)
        (count,) = struct.unpack_from(order + head, held, at)
        at += struct.calcsize(head)
        for entry in range(at, at + size * min(count, 4096), size):
            tag, kind = struct.unpack_from(f"{order}HH", held, entry)
            code = order + {1: "B", 3: "H", 4: "I"}.get(kind, "B")
            (value,) = struct.unpack_from(code, held, entry + skip)
            tags[tag] = _Tag(value, entry + skip, code)
    except (struct.error, OverflowError):
        return {}
    return tags
