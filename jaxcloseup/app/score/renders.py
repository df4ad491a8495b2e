"""Write renders of held-out views, and their true images, to disk."""

import pathlib
from collections.abc import Mapping, Sequence

from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import colorize_depth, write_png
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.photos.scene import Scene


def write_renders(folder: pathlib.Path, renderings: Mapping[str, Rendering], scene: Scene) -> None:
    """Write `rgb/<name>.png` and `depth/<name>.png`; colors of depth span the scene's range."""
    for name, rendering in renderings.items():
        write_png(folder / "rgb" / f"{name}.png", rendering.rgb)
        depth = colorize_depth(rendering.depth, near=scene.near, far=scene.far)
        write_png(folder / "depth" / f"{name}.png", depth)


def write_truth(folder: pathlib.Path, targets: Mapping[str, Sequence[Target]]) -> None:
    """Write `<split>/rgb/<name>.png`, the true images, so that anyone can score the renders."""
    for split, views in targets.items():
        for target in views:
            write_png(folder / split / "rgb" / f"{target.name}.png", target.rgb)
