"""Damage to files, by format: a mutation changes one file of a folder.

A function of a format takes a `random.Random` and the bytes of a file, and returns other bytes.
"""

import io
import json
import os
import pathlib
import random
import shutil
import struct
import zipfile
import zlib

import cv2
import numpy as np
import PIL.Image


LARGEST = 2**30  # bytes of a file that is read to be damaged
NESTED = "nested"
VALUES = [
    *(None, True, False, "", "a" * 300, "\x1b[31mred", "a\nb", "a\0b", "../../up", "/", "\ud800"),
    *(-1, 0, 1, 2, 0.5, 255, 2**31, -(2**31), 2**63, 10**30, 1e-300, 1e-9, 1e9, 1e30, 1e39, 1e300),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [[]], [0], {"a": 1}, NESTED),
]
WORDS = "0 -1 1 2 0.5 nan inf -inf 1e9 1e39 1e300 1e-300 255 4294967296 18446744073709551616 x -"
NUMBERS = {  # by little-endian type
    "<d": [float("nan"), float("inf"), -1e300, 1e39, 0.0, 1e-300],
    "<f": [float("nan"), float("inf"), -1e38, 0.0],
    "<q": [-1, 2**62, -(2**63), 10**6],
    "<Q": [2**64 - 1, 2**40, 10**12, 0],
    "<i": [-1, 2**31 - 1, 0, 12345, 7],
}
PNG_START = b"\x89PNG\r\n\x1a\n"


def damage_bytes(rng, data):
    """Cut, overwrite, insert, repeat or drop bytes anywhere."""
    at = rng.randrange(len(data) + 1)
    length = min(rng.choice([1, 1, 2, 4, 8, 64, 1000]), len(data) - at)
    noise = rng.choice([rng.randbytes(length), b"\0" * length, b"\xff" * length])
    before, part, after = data[:at], data[at : at + length], data[at + length :]
    flipped = bytearray(data)
    if data:
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    added = data + rng.randbytes(rng.choice([1, 100, 5000]))
    repeated = before + part * rng.choice([2, 50]) + after
    inserted, overwritten = before + noise + part + after, before + noise + after
    return rng.choice(
        [before, b"", added, inserted, before + after, repeated, overwritten, bytes(flipped)]
    )


def damage_json(rng, data):
    """Change a value, a name or a list at a random place of the tree."""
    root = json.loads(data)
    places = list(_places(root))
    holder, key = rng.choice(places)
    kind = rng.randrange(8)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder *= rng.choice([0, 2, 300])
    elif kind == 1:
        holder[str(key)[::-1]] = holder.pop(key)
    elif kind == 2 and type(holder[key]) in (int, float):
        holder[key] *= rng.choice([-1, 1e-12, 1e3, 1e9, 1e38, 1e300])
    elif kind == 3:
        other, place = rng.choice(places)
        holder[key], other[place] = other[place], holder[key]
    elif kind == 4:
        for name in list(holder) if isinstance(holder, dict) else range(len(holder)):
            holder[name] = rng.choice(VALUES)
    else:
        holder[key] = rng.choice(VALUES)
    try:
        text = json.dumps(root)
    except (ValueError, RecursionError):  # a swap put a tree into itself
        return b"[]"
    return text.replace(f'"{NESTED}"', "[" * 3000 + "]" * 3000).encode()


def _places(node):
    keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    for key in list(keys):
        yield node, key
        yield from _places(node[key])


def damage_lines(rng, data):
    """Change one line of JSON lines."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = damage_json(rng, lines[at]) if lines[at].startswith(b"{") else b"[[]]"
    return b"\n".join(lines)


def damage_text(rng, data):
    """Change words and lines of a text of numbers."""
    lines = data.decode("latin-1").split("\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    others = list(words)
    for _ in range(rng.choice([1, 1, 3])):
        others[rng.randrange(len(words))] = rng.choice(WORDS.split())
    change = rng.randrange(7)
    if change == 0:
        rng.shuffle(lines)
    else:
        more, fewer = words + words[: rng.randrange(3)], words[: rng.randrange(len(words))]
        kept = [[lines[at]] * rng.choice([0, 2, 1000]), [" ".join(more)], [" ".join(fewer)]]
        lines[at : at + 1] = kept[change - 1] if change <= 3 else [" ".join(others)]
    return "\n".join(lines).encode("latin-1")


def damage_numbers(rng, data):
    """Overwrite a count, an identity or a floating-point number in little-endian binary."""
    if len(data) < 8:
        return damage_bytes(rng, data)
    kind = rng.choice(list(NUMBERS))
    value = struct.pack(kind, rng.choice(NUMBERS[kind]))
    # Counts and identities lie at the beginning, and everything at multiples of four, or nearly.
    at = rng.choice([0, 8, 12, 16, 20, 4 * rng.randrange(len(data) // 4), rng.randrange(len(data))])
    at = min(at, len(data) - len(value))
    return data[:at] + value + data[at + len(value) :]


def damage_ply(rng, data):
    """Change a line of the header, or the vertices."""
    end = data.find(b"end_header")
    if end < 0 or rng.random() < 0.3:
        return (damage_text if data[:60].find(b"ascii") > 0 else damage_numbers)(rng, data)
    lines = data[:end].split(b"\n")[:-1]
    at, kind = rng.randrange(len(lines)), rng.randrange(6)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, rng.choice(lines))
    elif kind == 2:
        count = rng.choice([0, -1, 1, 10**6, 10**12, 2**63, 10**30])
        lines = [b"element vertex %d" % count if b"vertex" in line else line for line in lines]
    elif kind == 3:
        types = [b"double", b"uchar", b"int", b"list uchar int", b"complex", b"float128", b"short"]
        lines[at] = lines[at].replace(b"float", rng.choice(types))
    elif kind == 4:
        formats = [b"ascii", b"binary_big_endian", b"binary_little_endian", b"zip"]
        lines[1] = b"format %s 1.0" % rng.choice(formats)
    else:
        lines[at] = damage_bytes(rng, lines[at]).replace(b"\n", b" ")
    return b"\n".join([*lines, data[end:]])


def damage_npy(rng, data):
    """Change the header of an array, or its numbers."""
    if len(data) < 80 or rng.random() < 0.4:
        start = 128 if len(data) > 136 else 0
        return data[:start] + damage_numbers(rng, data[start:])
    (length,) = struct.unpack("<H", data[8:10])
    header = data[10 : 10 + length]
    kinds = [b"<f4", b">f8", b"<f2", b"<c16", b"|O", b"|S8", b"<U4", b"|b1", b"<M8[s]", b"|V8"]
    shapes = ["()", "(0, 17)", "(3,)", "(-3, 17)", "(1000000000000, 17)", "(3, 0)", "(17, 3)", "3"]
    claim = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {rng.choice(shapes)}, }}\n"
    changes = [
        header.replace(b"<f8", rng.choice(kinds)),
        claim.encode(),
        header.replace(b"False", rng.choice([b"True", b"None", b"1", b"[]"])),
        damage_bytes(rng, header),
        header,
    ]
    header = rng.choice(changes)
    version = data[6:8]
    if header == changes[-1]:
        version = bytes([rng.randrange(5), rng.randrange(3)])
    size = struct.pack("<H", min(len(header), 65535))
    return data[:6] + version + size + header + data[10 + length :]


def damage_png(rng, data):
    """Change the header's fields, with a right checksum, or chunks."""
    chunks, at = [], len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    at, kind = rng.randrange(len(chunks)), rng.randrange(8)
    if kind > 5:
        return repaint(rng, data)
    if kind <= 2:
        width, height, depth, color, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
        side = rng.choice([0, 1, 3, 100, 30000, 2**16, 2**31 - 1, 2**32 - 1])
        sizes = [(side, height), (width, side), (side, side), (width, height)]
        width, height = rng.choice(sizes)
        if kind == 2:
            depth, color = rng.choice([1, 2, 4, 8, 16, 32]), rng.choice([0, 2, 3, 4, 6, 9])
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, *rest))
    elif kind == 3:
        del chunks[at]
    elif kind == 4:
        noise = rng.randbytes(rng.choice([0, 8, 300]))
        name = rng.choice([b"PLTE", b"tRNS", b"gAMA", b"iCCP", b"eXIf", b"acTL", b"fcTL", b"tEXt"])
        chunks.insert(at, (name, noise))
    else:
        chunks[at] = (chunks[at][0], damage_bytes(rng, chunks[at][1]))
    return PNG_START + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )


def repaint(rng, data):
    """Keep an image's brighter half as one value in pixels of another kind, as masks may have."""
    gray = np.array(PIL.Image.open(io.BytesIO(data)).convert("L"))
    shape = (gray > np.median(gray)).astype(np.uint8)
    shape = rng.choice([shape, 1 - shape, shape * 0, shape * 0 + 1, shape[1:]])
    shape = shape * rng.choice([1, 2, 90, 128, 255])
    if rng.random() < 0.3:
        picture = PIL.Image.fromarray(shape)
        picture.putpalette([0, 0, 0, *rng.randbytes(9)])
        file = io.BytesIO()
        picture.save(file, "PNG")
        return file.getvalue()
    empty = shape * 0
    layers = [[shape], [empty, shape, empty], [*[empty] * 3, shape], [*[shape] * 3, empty]]
    pixels = np.dstack(rng.choice(layers)) * rng.choice([np.uint8(1), np.uint16(1), np.uint16(257)])
    return cv2.imencode(rng.choice([".png", ".tif"]), pixels)[1].tobytes()


def damage_jpeg(rng, data):
    """Change the size or the components that a JPEG claims, or add a segment."""
    at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    kind = rng.randrange(4)
    if at < 0 or kind == 0:
        return damage_bytes(rng, data)
    if kind == 1:
        side = struct.pack(">H", rng.choice([0, 1, 3, 65535, 30000]))
        return data[: at + 5] + side * 2 + data[at + 9 :]
    if kind == 2:
        return data[: at + 9] + bytes([rng.choice([0, 1, 2, 4, 255])]) + data[at + 10 :]
    # EXIF with an orientation, or only the beginning of it.
    entry = struct.pack("<HHIHH", 0x0112, 3, rng.choice([1, 0, 2**31]), rng.randrange(12), 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", rng.choice([8, 8, 2**31]), 1) + entry + b"\0" * 4
    exif = exif[: rng.choice([len(exif), 20])]
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def damage_torch(rng, data):
    """Change a part of a zip of tensors, most often the pickle and what it names."""
    if not zipfile.is_zipfile(io.BytesIO(data)) or rng.random() < 0.1:
        return damage_bytes(rng, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name, kind = rng.choice(list(parts)), rng.randrange(7)
    pickled = next(name for name in parts if name.endswith("data.pkl"))
    body = parts[pickled]
    if kind == 0:
        del parts[name]
    elif kind == 1:
        parts[name[::-1]] = parts.pop(name)
    elif kind == 2:
        parts[name] = damage_bytes(rng, parts[name])
    elif kind == 3:  # an integer of one, two or four bytes becomes another: a shape, an offset
        sizes = {b"K": 2, b"M": 3, b"J": 5}
        spot = rng.choice([i for i in range(len(body) - 2) if body[i : i + 1] in sizes] or [0])
        new = [b"K\x00", b"K\xff", b"J\xff\xff\xff\xff", b"J\xff\xff\xff\x7f", b"N", b"]"]
        end = spot + sizes.get(body[spot : spot + 1], 1)
        parts[pickled] = body[:spot] + rng.choice(new) + body[end:]
    elif kind == 4:
        types = [b"FloatStorage", b"LongStorage", b"OrderedDict", b"_rebuild_tensor_v2", b"torch"]
        other = rng.choice([*types, b"system", b"os", b"eval"])
        parts[pickled] = body.replace(rng.choice(types), other, 1)
    else:
        parts[pickled] = damage_bytes(rng, body)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, body in parts.items():
            archive.writestr(name, body)
    return file.getvalue()


BY_ENDING = {
    **{".json": damage_json, ".jsonl": damage_lines, ".txt": damage_text, ".bin": damage_numbers},
    **{".ply": damage_ply, ".npy": damage_npy, ".png": damage_png, ".jpg": damage_jpeg},
    ".tif": damage_numbers,
    **{".pth": damage_torch},
}


def replace_file(rng, path):
    """Put something else in the file's place, that may be no ordinary file."""
    others = [other for other in path.parent.iterdir() if other.is_file() and other != path]
    path.unlink()
    changes = [
        path.mkdir,
        lambda: os.mkfifo(path),
        lambda: path.symlink_to(path),
        lambda: path.symlink_to("/dev/zero"),
        lambda: path.touch() or os.truncate(path, 2**40),
        lambda: others and shutil.copy(rng.choice(others), path),
        lambda: None,
    ]
    rng.choice(changes)()


def mutate(rng: random.Random, folder: pathlib.Path, only: str = "*") -> str:
    """Damage one file of a folder whose name fits the pattern `only`; return which and how."""
    files = (path for path in folder.rglob(only) if path.is_file())
    path = rng.choice(sorted(path for path in files if path.stat().st_size < LARGEST))
    if rng.random() < 0.07:
        replace_file(rng, path)
        return f"{path.relative_to(folder)} replaced"
    known = BY_ENDING.get(path.suffix)
    damage = known if known and rng.random() < 0.8 else damage_bytes
    data = path.read_bytes()
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        try:
            data = damage(rng, data)
        except Exception:  # it is no longer of its format
            damage = damage_bytes
            data = damage(rng, data)
    path.write_bytes(data)
    return f"{path.relative_to(folder)} by {damage.__name__}"
