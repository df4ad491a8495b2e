"""Tables of a sweep: means, gains over control, and intervals."""

import numpy as np
import pytest

from jaxcloseup.app.report.pictures import comparisons
from jaxcloseup.app.report.sweep_tables import paired_bootstrap, rows


def result(values):
    views = {str(i): {"psnr": v, "ssim": 0.5} for i, v in enumerate(values)}
    return {"skipped": 1, "splits": {"test": {"views": views}}}


def test_rows_are_means_over_everything_and_gains_are_paired():
    scenes = {
        "a": {
            "control": {"0": result([10.0, 30.0]), "1": result([12.0, 32.0])},
            "better": {"0": result([11.0, 31.0]), "1": result([13.0, 33.0])},
        },
        "b": {
            "control": {"0": result([20.0, None]), "1": result([20.0, None])},
            "better": {"0": result([23.0, 5.0]), "1": result([23.0, 5.0])},
        },
    }
    control, better = rows(scenes)
    assert control.psnr == pytest.approx((10 + 30 + 12 + 32 + 20 + 20) / 6)
    assert control.spread == pytest.approx(np.std([20, 64 / 3], ddof=1))
    assert control.gain is None
    # Views of which control knows nothing do not count: 1, 1 and 3 dB.
    assert better.gain == pytest.approx(5 / 3)
    assert better.low == pytest.approx(1)
    assert better.high == pytest.approx(3)
    assert better.skipped == 4
    assert (control.count, better.count) == (6, 8)
    # A seed that lacks a view is no other seed's equal.
    del scenes["a"]["better"]["1"]["splits"]["test"]["views"]["1"]
    assert rows(scenes)[1].spread is None


def test_an_arm_with_a_control_of_its_own_gains_over_that():
    scenes = {
        "a": {
            "control": {"0": result([10.0, 30.0])},
            "test_time": {"0": result([13.0, 33.0])},
            "test_time_control": {"0": result([12.0, 32.0])},
        }
    }
    assert [row.gain for row in rows(scenes)] == [None, pytest.approx(1), None]


def test_a_sweep_whose_arms_all_failed_has_no_pictures(tmp_path):
    assert comparisons(tmp_path, {"test": [None]}, {}) == []


def test_a_single_view_has_no_interval():
    assert paired_bootstrap([np.array([0.3, 0.4])]) == (None, None)


def test_the_interval_is_that_of_the_mean():
    noise = np.random.default_rng(1).normal(0.3, 1.0, 400)
    low, high = paired_bootstrap([np.array([x]) for x in noise])
    half = 1.96 * noise.std() / np.sqrt(400)
    assert low == pytest.approx(noise.mean() - half, abs=0.03)
    assert high == pytest.approx(noise.mean() + half, abs=0.03)
