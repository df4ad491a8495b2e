"""Arms of sweeps by their names: settings that change, and names that are wrong."""

import dataclasses

import chex
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import TINY, TINY_SURFELS

from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.sweep.arm_training import order_arms
from jaxcloseup.app.sweep.named_arms import make_arm
from jaxcloseup.labels.config import pseudo_settings


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("warm", r"--arms=warm: warm is neither an arm \(baseline.* nor a setting of labels"),
        ("rgb_tolerance=high", "rgb_tolerance must be a number between 0 and inf"),
        ("sharpness=3", "sharpness=3 is neither an arm .*rgb_tolerance.*with --set"),
        ("capacity=300", "capacity=300 is neither an arm .*with --set"),
        ("magnification=3", "magnification must be two numbers between 1 and inf, as in 2:4"),
        ("pose=1", "pose=1 is neither"),
        ("replace=1", "replace=1 is neither"),
        ("rgb_tolerance=nan", "rgb_tolerance must be between 0 and inf"),
        ("magnification=8:2", "magnification must be two numbers .*, rising"),
        ("magnification=0:4", "magnification must be two numbers between 1 and inf"),
        ("label_loss_weight=1.5", "label_loss_weight must be between 0 and 1"),
        ("lr_scale=-1", "lr_scale must be between 0 and inf"),
        ("lr_scale=1+lr_scale=2", "sets lr_scale twice"),
        ("use_mask=perhaps", "use_mask must be true or false"),
        ("mask+", "is neither an arm"),
        ("baseline+lr_scale=2", "baseline has no fine-tuning"),
        ("oracle+depth_error=0.5", "oracle takes no other depth"),
        ("mask+label=residual", "mask has one kind of labels"),
        ("label=residual+depth_error=0.5", r"label=residual has its own depth: add \+label=warp"),
        ("test_time+label=exact", "label must be warp or residual"),
    ],
)
def test_a_name_that_is_no_arm_is_one_sentence(name, message):
    with pytest.raises(ValueError, match=message):
        make_arm(name, TINY)


def test_names_change_settings():
    settings = make_arm("rgb_tolerance=0.5+magnification=2:3", TINY).settings
    assert float(settings.rgb_tolerance) == 0.5
    np.testing.assert_array_equal(settings.pose.magnification, [2, 3])
    assert float(settings.label_loss_weight) == 0.5
    assert float(make_arm("control", TINY).settings.label_loss_weight) == 0
    arm = make_arm("expected_depth=1+look_at=1+num_sources=3", TINY_SURFELS)
    assert arm.labels.expected_depth is True
    assert (arm.settings.pose.look_at, arm.settings.num_sources) == (1, 3)
    ours, theirs = make_arm("diverse", TINY).settings, pseudo_settings(TINY.labels)
    chex.assert_trees_all_equal(ours, theirs)
    assert make_arm("diverse", TINY).labels.expected_depth is None
    assert make_arm("depth_error=0", TINY).in_turn
    arm = make_arm("resolved+magnification=2:3", TINY)
    assert arm.in_turn and arm.kind == "resolved"
    assert arm.settings.pose.magnification.tolist() == [2, 3]
    both = make_arm("mask+lr_scale=2", TINY).settings
    mask = make_arm("mask", TINY).settings
    chex.assert_trees_all_equal(both, mask.replace(lr_scale=jnp.float32(2)))


def test_labels_without_a_mask_need_no_agreement_of_depth_either():
    quick = METHODS["ngp"].presets["quick"]
    names = ("labels", "mask", "labels+depth_tolerance=0.05")
    arms = [make_arm(name, quick).labels for name in names]
    assert [arm.depth_tolerance for arm in arms] == [np.inf, 0.02, 0.05]
    assert [arm.use_mask for arm in arms] == [False, True, False]


def test_labels_with_detail_are_made_before_the_first_step():
    """The paper's rows and the control keep warps, which all arms of one program share."""
    preset = dataclasses.replace(
        TINY_SURFELS, labels=dataclasses.replace(TINY_SURFELS.labels, label="residual")
    )
    arms = [make_arm(name, preset) for name in ("control", "labels", "mask", "diverse")]
    assert [arm.labels.label for arm in arms] == ["warp", "warp", "warp", "residual"]
    together, in_turn = order_arms(arms, seeds=1)
    assert [arm.name for arm, _ in in_turn] == ["diverse"] and len(together) == 3
    assert make_arm("label=residual", TINY_SURFELS).in_turn
