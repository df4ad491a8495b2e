"""A page that shows a scene as splats with its close-ups, from any disk, without a server.

Browsers let a page that was opened from a disk load scripts and images, and nothing else. So the
scene and all that is said of it are a script too.
"""

import base64
import json
import pathlib
import urllib.parse
from collections.abc import Sequence
from typing import Any

import cv2
import jinja2
import numpy as np

from jaxcloseup.app.share.closeups import CloseUp
from jaxcloseup.app.view.camera_paths import OPENGL
from jaxcloseup.app.view.picking import vertical_fov
from jaxcloseup.artifacts.images import color_errors, webp_data_uri
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.files import write_file


_ASSETS = pathlib.Path(__file__).parent / "assets"
_ERROR = 1600  # longest side in pixels of a map of errors, which are smooth
_QUALITY = 92  # of WebP
_THUMBNAIL = 152  # height in pixels, for screens with two pixels to a unit of length


def write_page(
    folder: pathlib.Path,
    closeups: Sequence[CloseUp],
    *,
    title: str,
    splats: bytes,
    overview: Camera,
    distance: float,
    up: np.ndarray,
    single_file: bool = False,
) -> pathlib.Path:
    """Write `index.html` and what it needs into a folder, and return its path.

    Args:
      folder: folder to write.
      closeups: what is pinned to the scene.
      title: of the page.
      splats: the scene as SPZ, in the coordinates of the cameras.
      overview: camera of the first view.
      distance: from this camera to the middle of what it sees.
      up: `[3]` up direction of the world.
      single_file: whether `index.html` holds everything else.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    data = {
        "title": title,
        "said": "Drag to turn, scroll to come nearer; a number leads to a close-up.",
        "up": (OPENGL @ up).tolist(),
        "overview": _camera(overview, distance) | {"distance": distance},
        "closeups": [_describe(folder, one, single_file) for one in closeups],
        "legend": webp_data_uri(color_errors(np.zeros((1, 1)))[1], quality=100),
        "splats": base64.b64encode(splats).decode(),
    }
    texts = {name: (_ASSETS / name).read_text() for name in ("page.css", "viewer.js", "page.js")}
    # Within a page, `<!--<script` of a photograph's name would hide the script's end.
    encoded = json.dumps(data).replace("<", "\\u003c")
    texts["data.js"] = f"const DATA = {encoded};\n"
    scripts = [(name, texts[name]) for name in ("viewer.js", "data.js", "page.js")]
    environment = jinja2.Environment(autoescape=True)
    page = environment.from_string((_ASSETS / "index.html").read_text()).render(
        title=title,
        single=single_file,
        css=jinja2.utils.markupsafe.Markup(texts["page.css"]),
        scripts=[(name, _inline(text)) for name, text in scripts],
    )
    if not single_file:
        for name, text in texts.items():
            write_file(folder / name, text.encode())
    write_file(folder / "licenses.txt", (_ASSETS / "licenses.txt").read_bytes())
    write_file(folder / "index.html", page.encode())
    return folder / "index.html"


def _inline(script: str) -> Any:
    """Mark a script as HTML that it cannot end."""
    return jinja2.utils.markupsafe.Markup(script.replace("</script", "<\\/script"))


def _describe(folder: pathlib.Path, closeup: CloseUp, single_file: bool) -> dict[str, Any]:
    """Return what the page knows of a close-up; write its pictures unless they are part of it."""
    height, width = closeup.picture.shape[:2]
    small = cv2.resize(
        closeup.picture,
        (round(_THUMBNAIL * width / height), _THUMBNAIL),
        interpolation=cv2.INTER_AREA,
    )
    forward = np.asarray(closeup.camera.rotation)[:, 2]
    ahead = float((closeup.point - np.asarray(closeup.camera.position)) @ forward)
    shrink = min(1.0, _ERROR / max(height, width))
    size = round(shrink * width), round(shrink * height)
    error = cv2.resize(closeup.error, size, interpolation=cv2.INTER_NEAREST)
    kinds = {"picture": closeup.picture, "error": error}
    return {
        "name": closeup.name,
        "said": closeup.said,
        "said_of_error": closeup.said_of_error,
        "point": (OPENGL @ closeup.point).tolist(),
        "thumbnail": webp_data_uri(small),
        **_camera(closeup.camera, ahead),
        **{
            kind: _picture(folder, f"{closeup.name}_{kind}", image, single_file)
            for kind, image in kinds.items()
        },
    }


def _picture(folder: pathlib.Path, name: str, image: np.ndarray, single_file: bool) -> str:
    """Return the address of an image on the page."""
    uri = webp_data_uri(image, quality=_QUALITY)
    if single_file:
        return uri
    file = f"{name}.webp"
    write_file(folder / "closeups" / file, base64.b64decode(uri.split(",", 1)[1]))
    return f"closeups/{urllib.parse.quote(file)}"  # photographs may be named "a#1"


def _camera(camera: Camera, ahead: float) -> dict[str, Any]:
    """Return a camera as three.js has it, and the point `ahead` of it that it turns around."""
    rotation, position = (np.asarray(a, np.float64) for a in (camera.rotation, camera.position))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = OPENGL @ rotation @ OPENGL, OPENGL @ position
    return {
        "matrix": matrix.T.ravel().tolist(),
        "fov": float(np.degrees(vertical_fov(camera))),
        "aspect": camera.width / camera.height,
        "target": (OPENGL @ (position + ahead * rotation[:, 2])).tolist(),
    }
