"""A sweep of two arms that compile in seconds, as a function, and as one of two hosts:

python tests/color_sweep.py FOLDER PORT HOST
"""

import json
import pathlib
import sys

import constant_color
import jax

from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.sweep.arm_training import run_sweep
from jaxcloseup.captures.load import load_scene


def sweep_colors(scene, folder):
    """Return the scores of the arms."""
    METHODS["constant_color"] = constant_color.METHOD
    names = {"method": "constant_color", "preset": "quick"}
    arms = "control", "diverse"
    try:
        with jax.numpy_dtype_promotion("standard"):
            preset = constant_color.METHOD.presets["quick"]
            return run_sweep(scene, preset, arms, 1, folder, names=names, max_parallel=3).scores
    finally:
        del METHODS["constant_color"]


def main(folder, port, host):
    """Sweep the capture in a folder together with the other host; leave what this one returned."""
    jax.distributed.initialize(f"127.0.0.1:{port}", 2, int(host))
    assert len(jax.devices()) == 2 * len(jax.local_devices())
    folder = pathlib.Path(folder)
    found = sweep_colors(load_scene(str(folder / "capture")), folder / "sweep")
    (folder / f"host{host}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
