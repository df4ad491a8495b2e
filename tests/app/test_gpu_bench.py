"""`bench --suite=gpu` at toy sizes: every part finishes and every field is there."""

import dataclasses
import json

import constant_color
import jax

from experiments.benchmarks import gpu, gpu_splats
from experiments.benchmarks.nerf import SMALL
from jaxcloseup.app.methods.registry import METHODS


TOY = gpu.Size(
    cases=((300, (16, 24)),),
    side=64,
    numbers=256,
    nerf=dataclasses.replace(SMALL, depth=2, width=16, num_coarse=4, num_fine=4),
    rays=16,
    preset=constant_color.METHOD.presets["quick"],
    stages=("control",),
    training_seconds=1,
    arms=(constant_color.METHOD.presets["quick"],),
    warmup=1,
)


def test_every_part_finishes_and_fills_its_fields(tmp_path, capture_folder, monkeypatch):
    def broken(case):
        raise RuntimeError("no such library")

    monkeypatch.setattr(gpu_splats, "peer", broken)
    monkeypatch.setitem(METHODS, "constant_color", constant_color.METHOD)
    with jax.numpy_dtype_promotion("standard"):
        size = dataclasses.replace(TOY, scene=str(capture_folder))
        found = gpu.run(size, tmp_path / "gpu.json")
    assert json.loads((tmp_path / "gpu.json").read_text()) == found
    assert set(found["about"]) == {"jaxcloseup", "jax", "python", "backend", "devices"}
    # A part that fails is recorded, and stops nothing.
    assert found["peer"]["error"] == "RuntimeError: no such library"
    parts = {name: part["found"] for name, part in found.items() if name not in ("about", "peer")}
    assert set(parts) == {"ceilings", "correctness", "splats", "nerf", "training", "sweep"}
    assert all(rate > 0 for rate in parts["ceilings"].values())
    assert parts["correctness"]["agree"]
    (row,) = parts["splats"]
    assert row["compositor"] == "loops" and "error" not in row and row["pairs"] > 0
    for name in ("forward", "both"):
        assert row[f"{name}_ms"] > 0 and row[f"{name}_share_of_arithmetic"] > 0
    assert set(parts["nerf"]) == {"float32", "bfloat16"}
    assert parts["training"]["target_view_s"] > 0
    assert set(parts["training"]["psnr"]) == {"baseline", "control"}
    assert parts["sweep"]["constant_color"]["over_eight_alone"] > 0


def test_no_part_begins_after_its_time(tmp_path):
    found = gpu.run(dataclasses.replace(TOY, most_seconds=-1), tmp_path / "gpu.json")
    assert all("not begun" in found[name]["error"] for name in ("ceilings", "peer"))
