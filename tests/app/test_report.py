"""The page of a run: what it says first, and where photographs show the same as a close-up."""

import math

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from browser import open_browser
from pages import Page

from jaxcloseup.app.report.headline import conclusion, print_results, run_tables
from jaxcloseup.app.report.page import Picture
from jaxcloseup.app.report.pictures import comparisons, enlarge
from jaxcloseup.app.report.run_report import write_report
from jaxcloseup.app.report.showcase import Exhibit, best_middle_worst, cut_out, find_place
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import side_by_side
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.pyramids import Pyramid


CONFIG = {"labels": {"label": "warp"}, "targets": None}


def results(psnr, *, weight=None, detail=None, **changes):
    """Results of stages with these PSNRs of close-ups; ordinary views have 10 dB more."""

    def score(value):
        return {"psnr": value, "ssim": 0.5, "cc_psnr": value + 1, "depth_error_median": 0.0123}

    gate = None if weight is None else {"weight": weight, "agreement": 0.08}
    return {
        "stages": {
            stage: {"test": score(value), "test_far": score(value + 10)}
            for stage, value in psnr.items()
        },
        "gate": gate,
        "config": CONFIG,
        "detail": detail and {"stage": detail},
        "history": {"closeup": [{"label_coverage": 0.254}]},
        "resolution": [120, 68],
        "scored_at": None,
        **changes,
    }


@pytest.mark.parametrize(
    ("found", "parts"),
    [
        (results({"baseline": 20.04}), ["Close-ups", "20.0 dB"]),
        (results({"control": 20.0, "closeup": 20.26}), ["20.3 dB", "25%", "0.26 dB better"]),
        (
            results({"control": 20.0, "closeup": 19.9, "detail": 22.0}, detail="closeup"),
            ["22.0 dB", "2.1 dB better", "25%", "0.10 dB worse"],
        ),
        (results({"control": 20.0, "closeup": 20.001}, weight=1.0), ["25%", "changed nothing"]),
        (results({"control": 20.0, "closeup": 20.0}, weight=0.0), ["not used", "8%"]),
        (results({"closeup": 20.0}), ["no control"]),
        (results({}), ["No view was held out"]),
    ],
)
def test_the_conclusion_has_the_numbers_that_decide(found, parts):
    said = conclusion(found)
    assert sorted(parts, key=said.index) == parts


def test_without_close_ups_the_ordinary_views_count():
    found = results({"baseline": 20.0})
    del found["stages"]["baseline"]["test"]
    assert conclusion(found) == "Ordinary views have a PSNR of 30.0 dB."
    assert [table.title for table in run_tables(found)] == ["Ordinary views"]


@pytest.mark.parametrize(
    ("weight", "labels", "targets", "stages"),
    [
        (0.0, "warp", None, ["baseline", "control, closeup", "test_time_control, test_time"]),
        (0.1, "warp", None, ["baseline", "control", "closeup", "test_time", "test_time_control"]),
        # Labels with detail have no gate.
        (
            *(0.0, "warp", {"label": "residual"}),
            ["baseline", "control, closeup", "test_time", "test_time_control"],
        ),
        (
            *(0.0, "residual", {"label": "warp"}),
            ["baseline", "control", "closeup", "test_time_control, test_time"],
        ),
    ],
)
def test_stages_without_labels_share_the_row_of_their_control(weight, labels, targets, stages):
    psnr = {"baseline": 19.0, "control": 20.0, "closeup": 20.0, "test_time": 20.5}
    config = {"labels": {"label": labels}, "targets": targets}
    found = results(psnr | {"test_time_control": 20.0}, weight=weight, config=config)
    table = run_tables(found)[0]
    assert table.header == ["stage", "PSNR (dB)", "SSIM", "color-corrected", "depth off by"]
    assert table.rows[1][1:] == ["20.00", "0.5000", "21.00", "1.23%"]
    assert [row[0] for row in table.rows] == stages
    assert ("not used" in conclusion(found)) == ("control, closeup" in stages)


def test_tables_show_the_reduced_size_and_perceptual_distances():
    found = results({"baseline": 20.0})
    splits = found["stages"]["baseline"]
    splits["test"]["lpips_vgg"] = 0.25
    splits["test"]["resolves"] = 7.46
    splits["test_reduced"] = {"psnr": 22.0}
    table = run_tables(found)[0]
    assert table.header[1:5] == ["PSNR (dB)", "SSIM", "resolves (px)", "LPIPS (VGG)"]
    assert table.rows == [["baseline", "20.00", "0.5000", "7.5", "0.2500", "1.23%", "22.00"]]
    assert table.header[5:] == ["depth off by", "at 120 x 68"]


def test_stages_are_never_cut_in_a_narrow_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    print_results(results({"test_time_control": 20.0}))
    assert "test_time_control" in capsys.readouterr().out


HOSTILE = "<script>alert('x')</script> \"&{{ 1 }}"


def test_a_page_without_held_out_views_has_no_empty_sections(tmp_path):
    found = results({}, scene="shelf", method="surfels", preset="quick", seed=0, versions={})
    found |= {"stages": {"baseline": {}, "detail": {}}, "labels": {}, "left_out": None}
    found["detail"] = {"stage": "baseline", "errors": [], "sizes": [[36, 48]]}
    write_report(tmp_path / "report.html", found, [], [])
    page = Page((tmp_path / "report.html").read_text())
    assert page.headings == ["shelf"] and not page.tables
    assert page.tags.count("details") == 1  # the configuration
    assert "No view was held out" in page.text and "scored at" not in page.text


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write a page with everything that a page can have; names in it are hostile."""
    found = results({"baseline": 19.0, "test_time_control": 20.0}, scene=HOSTILE, method=HOSTILE)
    found |= {"preset": "quick", "seed": 0, "resolution": [24, 18], "versions": {}}
    audit = {"error": 0.01, "kept": 0.5, "leaked": 0.1, "curve": None}
    tried = {"rgb_tolerance": 0.02, "depth_tolerance": 0.005, "coverage": 0.1}
    tried |= {"label_psnr": 30.0, "model_psnr": 31.0}
    found["gate"] = {"weight": 0.0, "agreement": 0.08, "left_out": [tried]}
    found |= {"labels": {"exact_depth": audit}, "left_out": None}
    found |= {"config": {**CONFIG, "name": "long " * 50}}
    errors = [{"expected": 0.1, "actual": 0.2}]
    found["detail"] = {"stage": "baseline", "errors": errors, "sizes": [[36, 48]]}
    found["detail"] |= {"ause": 0.123, "pearson": 0.456}
    for stage, splits in found["stages"].items():
        splits["zoom_2"] = {"psnr": {"baseline": 18.0, "test_time_control": 17.0}[stage]}
        for metrics in splits.values():
            metrics |= {"psnr_seen1": 1.0, "coverage_seen1": 0.5, "lpips_vgg": 0.3}
    noise = np.random.default_rng(0).integers(0, 255, (18, 24, 3), np.uint8)
    shown = [
        Exhibit(HOSTILE, 20.0, noise, noise, "b" * 40, cutout, pixel)
        for cutout, pixel in ((noise, 0.2), (noise, 1.3), (None, float("nan")))
    ]
    row = side_by_side([enlarge(noise)] * 5, labels=["a title"] * 5)
    pictures = [Picture(section, HOSTILE, row) for section in ("Close-ups", "Pseudo-labels")]
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(path, found, shown, pictures)
    return path, found


def test_a_page_shows_the_numbers_of_results_in_order(written):
    path, found = written
    page = Page(path.read_text())
    order = ["Close-ups beside photographs", "Close-ups", "Scores", "Pseudo-labels"]
    assert [heading for heading in page.headings if heading in order][:3] == order[:3]
    assert page.headings.index("Scores") < page.headings.index("Pseudo-labels")
    close_ups, ordinary, everything, labels, gate, detail = page.tables
    for split, (_, *body) in (("test", close_ups), ("test_far", ordinary)):
        psnr = {stage: splits[split]["psnr"] for stage, splits in found["stages"].items()}
        assert {stage: float(value) for stage, value, *_ in body} == psnr
    assert len(everything) == 1 + 4
    assert labels[1] == ["exact depth", "0.0100", "0.5000", "0.1000"]
    assert gate[1] == ["0.02", "0.005", "10%", "30.00", "31.00"]
    assert detail[1] == ["1", "25.5", "51.0"]
    assert "AUSE 0.12, correlation 0.46" in page.text
    assert page.tags.count("svg") == 1  # no control: no plot of gains
    assert page.tags.count("details") == 5


def test_a_page_needs_no_other_file_and_escapes_names(written):
    page = Page(written[0].read_text())
    # Two sliders of two images and a truth, a render and its truth, two rows of panels.
    assert [image.shape[:2] for image in page.pictures()[:8]] == [(18, 24)] * 8
    assert len(page.pictures()) == 10
    assert "script" not in page.tags and page.headings[0] == HOSTILE
    assert page.text.count(HOSTILE) >= 7
    finer, coarser = page.captions[0], page.captions[2]
    assert "5.0 times finer" in finer and "1.3 times as large" in coarser


def test_a_phone_shows_a_page_without_scrolling_it_sideways(written):
    """Wide tables, rows of panels and the configuration scroll in themselves."""
    with open_browser() as browser:
        size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(f"file://{written[0]}")
        widths = browser.execute_script(
            "for (const one of document.querySelectorAll('details')) one.open = true;"
            "const width = one => document.querySelector(one).getBoundingClientRect().width;"
            "return [document.documentElement.scrollWidth, width('.wide img'), width('.pair')]"
        )
    assert widths[0] == 390 and widths[1] > 800 and widths[2] < 390


def test_the_best_the_middle_and_the_worst_view_are_shown():
    assert best_middle_worst({"a": 1.0, "b": 5.0, "c": 3.0, "d": 2.0}) == ["b", "d", "a"]
    assert best_middle_worst({"a": 1.0, "b": 5.0}) == ["b", "a"]
    assert best_middle_worst({"a": 1.0}) == ["a"]
    assert best_middle_worst({}) == []


def camera(position, focal, height, width, roll=0.0):
    c, s = math.cos(roll), math.sin(roll)
    turn = [[c, -s, 0, position[0]], [s, c, 0, position[1]], [0, 0, 1, position[2]]]
    intrinsics = jnp.array([focal, focal, width / 2, height / 2])
    return Camera(jnp.array(turn), intrinsics, height=height, width=width)


def test_a_photograph_is_cut_out_where_it_shows_a_close_up():
    """Both cameras look at a wall at z = 2, on which colors are a smooth function of the place."""

    def wall(view, height, width):
        v, u = np.mgrid[:height, :width] + 0.5
        fx, fy, cx, cy = np.asarray(view.intrinsics, np.float64)
        pose = np.asarray(view.camtoworld, np.float64)
        depth = 2 - pose[2, 3]
        x, y = (u - cx) / fx * depth, (v - cy) / fy * depth
        x, y = (pose[i, 0] * x + pose[i, 1] * y + pose[i, 3] for i in (0, 1))
        return np.stack([np.sin(6 * x), np.cos(5 * y), np.sin(4 * (x + y))], axis=-1) / 2 + 0.5

    photograph = camera((0, 0, 0), 160.0, 96, 128)
    near = camera((0.1, -0.05, 1), 60.0, 36, 48, roll=0.3)
    depth = jnp.full((36, 48), 1.0).at[:4].set(0)  # undefined in some rows
    place = find_place(near, depth, photograph)
    # A pixel is 1/60 wide on the wall, and one of the photograph 2/160.
    assert math.sqrt(np.linalg.det(place[:, :2])) == pytest.approx(160 / 2 / 60, rel=1e-4)
    image = wall(photograph, 96, 128)
    coarse = cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA)
    values = np.concatenate([image.reshape(-1, 3), coarse.reshape(-1, 3)])
    intrinsics = jnp.stack([photograph.intrinsics, photograph.intrinsics / 2])[None]
    extents = jnp.array([[(96, 128), (48, 64)]])
    pyramid = Pyramid(jnp.asarray(values * 255, jnp.uint8), intrinsics, extents)
    for focal in (60.0, 25.0):  # the second reads the coarser level
        view = near.replace(intrinsics=jnp.array([focal, focal, 24.0, 18.0]))
        found = cut_out(pyramid, 0, find_place(view, depth, photograph), view)
        inside = (found > 0).any(axis=-1)
        error = np.abs(found / 255 - wall(view, 36, 48))[inside]
        assert inside.mean() > 0.5 and np.median(error) < 0.01
    assert find_place(near, jnp.zeros((36, 48)), photograph) is None


def test_the_page_shows_the_error_of_the_last_picture_that_it_shows(tmp_path):
    """The file has all stages, the last of them wrong everywhere; the page has the right one."""
    view = Target("view", None, jnp.zeros((8, 240, 3)), None, None)
    images = {(stage, "test"): {"view": view.rgb + error} for stage, error in [("a", 0), ("b", 1)]}
    (shown,) = comparisons(tmp_path, {"test": [view]}, images, in_report=["a"])
    assert shown.image.shape[1] == 3 * 240 + 2 * 8
    assert shown.image[-8:, -240:].max() < 10
    written = cv2.imread(str(tmp_path / "view.png"))
    assert written.shape[1] == 4 * 240 + 3 * 8 and written[-1, -1].max() > 200
