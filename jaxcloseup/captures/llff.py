"""Read LLFF's `poses_bounds.npy`, with the photographs in `images/`.

Each row holds a 3 x 5 matrix and two depths. The columns of the matrix are the camera's axes (down,
right, backward), its position in the world, and (height, width, focal length) in pixels. The depths
bound what the camera sees.
"""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcloseup.captures.json_fields import image_side, number, rigid_transform
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.io.files import check_file
from jaxcloseup.photos.scene import SceneError


def read_llff(
    file: pathlib.Path, folder: pathlib.Path, files: Sequence[pathlib.Path]
) -> tuple[dict[str, Any], list[Frame]]:
    """Read the fields `near` and `far` of the whole capture, and the frames of a folder's files.

    Rows belong to the photographs sorted by name. Near is 0.9 of the smallest near bound, as in
    NeRF's own loader, and far is the largest far bound.

    Raises:
      SceneError: names the file and the row, and says what to do.
    """
    try:
        check_file(file)
    except OSError as error:
        raise SceneError(f"{file} cannot be read ({error.strerror}): restore the file.") from error
    try:
        # Mapping compares the header's claims with the size of the file and allocates nothing.
        with np.errstate(over="raise"):
            rows = np.lib.format.open_memmap(file, mode="r")
    except Exception as error:  # a damaged header can fail in any way
        raise SceneError(
            f"{file} is truncated or not a NumPy file of numbers: copy or export it again."
        ) from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        shape = " x ".join(map(str, rows.shape)) or "nothing"
        raise SceneError(
            f"{file} has shape {shape} instead of N x 17, one row per photograph: export it again."
        )
    if rows.dtype.kind not in "fiu":
        raise SceneError(
            f"{file} holds {rows.dtype} values instead of real numbers: export it again."
        )
    if len(files) != len(rows):
        raise SceneError(
            f"{file} has {len(rows)} poses but {folder} has {len(files)} photographs: restore "
            "missing photographs, or remove those without a pose."
        )
    frames = [_frame(file, path, row) for path, row in zip(files, rows, strict=True)]
    near, far = 0.9 * float(rows[:, 15].min()), float(rows[:, 16].max())
    return {"near": near, "far": far}, frames


def _frame(file: pathlib.Path, photograph: pathlib.Path, row: np.ndarray) -> Frame:
    label = f"{file}: row of {photograph.name}"
    height, width, focal = row[4:15:5].tolist()
    size = image_side(label, "width", width), image_side(label, "height", height)
    focal = number(label, "focal length", focal, above=0)
    near, far = (
        number(label, name, value, above=0)
        for name, value in zip(("near bound", "far bound"), row[15:].tolist(), strict=True)
    )
    if near >= far:
        raise SceneError(
            f"{label}: near bound {near:.4g} is not less than far bound {far:.4g}: correct them."
        )
    down, right, backward, position = row[:15].reshape(3, 5)[:, :4].T.astype(np.float64)
    pose = np.column_stack([right, down, -backward, position])
    return Frame(
        source=file,
        listed=photograph.name,
        file=photograph,
        mask=None,
        camtoworld=rigid_transform(label, "pose", pose),
        size=size,
        lens=({"fl_x": focal}, {}),
    )
