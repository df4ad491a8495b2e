"""Flags and settings that override a preset, and one sentence for each that makes no sense."""

import json
import re

import pytest
from absl.testing import flagsaver

from jaxcloseup.app.cli import flags as shared
from jaxcloseup.app.cli import run as program
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import plain_config, settings_of
from jaxcloseup.app.run.stage_names import ARMS
from jaxcloseup.app.sweep.named_arms import KINDS
from jaxcloseup.fields.splats.config import AdaptiveConfig
from jaxcloseup.labels.rules import LABEL_RULES
from jaxcloseup.training.config import TrainConfig


def test_flags_override_the_preset(parsed_flags):
    settings = ["closeup_steps=7", "compute_dtype=bfloat16", "rgb_tolerance=0.1", "chunk=none"]
    with flagsaver.flagsaver(method="nerf", preset="paper", set=settings, downscale=3):
        preset = shared.preset_from_flags()
    assert preset.closeup_steps == 7 and preset.downscale == 3
    assert preset.field.compute_dtype == "bfloat16" and preset.labels.rgb_tolerance == 0.1
    before = METHODS["nerf"].presets["paper"]
    assert preset.baseline_steps == before.baseline_steps == 200_000
    assert before.labels.rgb_tolerance == 0.05
    assert plain_config(preset)["labels"]["depth_tolerance"] == "inf"
    json.dumps(plain_config(preset), allow_nan=False)
    settings = ["density.growth=1.2", "raster.tile=16", "capacity=300", "means_lr=0.1:0.01"]
    with flagsaver.flagsaver(method="surfels", set=settings):
        field = shared.preset_from_flags().field
    assert (field.density.growth, field.raster.tile, field.capacity) == (1.2, 16, 300)
    assert field.means_lr == (0.1, 0.01)
    with flagsaver.flagsaver(method="surfels", preset="quick_adaptive", set=["capacity=300"]):
        field = shared.preset_from_flags().field
    assert isinstance(field.density, AdaptiveConfig)
    assert field.capacity == 300 and field.opacity_weight == 0


@pytest.mark.parametrize(
    ("method", "text", "message"),
    [
        ("ngp", "compute_dtype=bfloat16", "has no setting compute_dtype: .*--set=help lists"),
        ("ngp", "grid.levels=0", "grid.levels must be between 1 and 64"),
        ("zipnerf", "points=0", "points must be between 1 and 2147483647"),
        ("zipnerf", "proposal_points=0", "proposal_points must be between 1 and 2147483647"),
        ("nerf", "depth_share=2", "depth_share must be between 0 and 1"),
        ("nerf", "capacity=500", "method nerf has no setting capacity: --set=help lists all"),
        ("surfels", "compute_dtype=bfloat16", "method surfels has no setting compute_dtype"),
        ("surfels", "num_rays=4", "method surfels has no setting num_rays"),
        ("surfels", "num_windows=0", "num_windows must be between 1 and 2147483647"),
        ("surfels", "capacity", "must be name=value"),
        ("surfels", "capacity=many", "capacity must be a whole number between 1 and 100000000"),
        ("surfels", "capacity=0", "capacity must be between 1 and 100000000"),
        ("surfels", "sh_degree=4", "sh_degree must be between 0 and 3"),
        ("surfels", "density.every=0", "density.every must be between 1 and 2147483647"),
        ("surfels", "depth=deep", "depth must be median or expected"),
        ("surfels", "means_lr=0.1", "means_lr must be two numbers between 0 and inf"),
        ("surfels", "color_ridge=much", "color_ridge must be a number between 0 and inf or none"),
        ("surfels", "gated=perhaps", "gated must be true or false"),
        ("surfels", "density=adaptive", "setting density: perhaps .*density.growth or .* is meant"),
    ],
)
def test_a_setting_that_makes_no_sense_is_one_sentence(parsed_flags, method, text, message):
    with (
        flagsaver.flagsaver(method=method, set=[text]),
        pytest.raises(ValueError, match=f"^--set={text}.*{message}") as error,
    ):
        shared.preset_from_flags()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("method", METHODS)
def test_any_method_lists_its_settings_and_takes_several_windows(parsed_flags, capsys, method):
    assert re.fullmatch(r".+ \(.+ et al\. 20\d\d\)", METHODS[method].help)
    with flagsaver.flagsaver(method=method, windows=3):
        assert shared.preset_from_flags().train.num_windows == 3
    given = flagsaver.flagsaver(method=method, preset="paper", set=["help"])
    with given, pytest.raises(SystemExit) as end:
        program.main(["run"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    known = settings_of(METHODS[method].presets["paper"])
    assert re.findall(r"^  (\S+)=", said, re.M) == list(known)
    words = " ".join(said.split())
    for setting in known.values():
        assert f"{setting.limits.help}; {setting.wanted}" in words
    assert "use_mask=true keep labels only where both warps agree in color; true or f" in words


def test_flags_know_all_names():
    """What flags and settings offer imports no JAX, so it repeats names of what does."""
    assert ARMS == KINDS
    assert TrainConfig.__dataclass_fields__["label_rule"].metadata["setting"].choices == tuple(
        LABEL_RULES
    )
