"""Detail: weights that evidence teaches, renders that come nearer to the truth, a kept file."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import KEPT

from jaxcloseup.app.methods.method import TargetConfig
from jaxcloseup.app.run import fine_tuning, gate, kept_detail
from jaxcloseup.app.run.fine_tuning import fine_tune, tuned_detail
from jaxcloseup.app.run.kept_detail import detail_getter, detail_path, detailed, find_detail
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.labels import label_closeups, label_target_views, start_labels
from jaxcloseup.app.run.residuals import enlarge
from jaxcloseup.app.score.targets import targets_by_split
from jaxcloseup.app.store.stored_run import load_run_scene, read_run, restore
from jaxcloseup.captures.load import DRAWN_SCENES, SceneError, load_scene
from jaxcloseup.detail import weights as detail_weights
from jaxcloseup.detail.features import FEATURES
from jaxcloseup.detail.holes import find_empty
from jaxcloseup.detail.learn import Evidence, learn_weights
from jaxcloseup.detail.weights import CONTRAST, blend, expected_errors, known_weights, write_known
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.io.cache import Stored, load, save
from jaxcloseup.photos.depth_maps import join_maps
from jaxcloseup.photos.pyramids import scene_pyramid
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.photos.windows import view_windows


# Made-up evidence is simple, so few steps teach it.
learn_quickly = functools.partial(learn_weights, steps=(250, 300))


def made_up(share, count=20_000, seed=0):
    """Evidence whose true share of the gathered residual is `share(feature)`, plus noise."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1, count)
    features = np.stack([np.ones(count), x, x**2], axis=-1)
    gathered = rng.normal(0, 0.1, (count, 3))
    own = share(x)[:, None] * gathered + (0.01 + 0.03 * x)[:, None] * rng.normal(0, 1, (count, 3))
    images = features, gathered / CONTRAST, rng.normal(0, 0.1, (count, 3)), own, np.ones(count)
    return Evidence(*(image.astype(np.float32) for image in images)), x


@pytest.mark.parametrize(
    "share", [lambda x: 0.2 + 0.6 * x, lambda x: 1 / (1 + np.exp(12 * (x - 0.5)))]
)
def test_weights_are_the_share_that_is_there(share):
    weights = learn_quickly({f"scene {seed}": [made_up(share, seed=seed)[0]] for seed in range(3)})
    other, x = made_up(share, seed=3)
    mixed, predicted = map(np.asarray, blend(weights, *other[:3]))
    added = predicted[:, None] * mixed
    expected = share(x)[:, None] * CONTRAST * other.residual
    # Colors are noise here: what is added is the share of the residual.
    assert np.abs(added - expected).mean() < 0.1 * np.abs(expected).mean()

    # The mean of |z| is sqrt(2 / pi) of the deviation: of the noise, and of what the render lacks.
    noise = 0.01 + 0.03 * x
    deviations = np.hypot(0.1 * share(x), noise), noise
    guesses = np.asarray(expected_errors(weights, other[0])).T
    for guess, deviation in zip(guesses, deviations, strict=True):
        assert guess == pytest.approx(np.sqrt(2 / np.pi) * deviation, rel=0.25)
        assert guess.mean() == pytest.approx(np.sqrt(2 / np.pi) * deviation.mean(), rel=0.03)


def test_colors_are_taken_where_they_are_right_and_the_residual_elsewhere():
    rng, count = np.random.default_rng(0), 40_000
    exact = rng.uniform(size=count) < 0.5
    own, noise = rng.normal(0, 0.1, (2, count, 3))
    colors = np.where(exact[:, None], own, noise)
    residual = np.where(exact[:, None], noise, own) / CONTRAST
    images = exact[:, None] * 1.0, residual, colors, own, np.ones(count)
    found = Evidence(*(image.astype(np.float32) for image in images))
    weights = learn_quickly({"scene": [found]})
    mixed, share = blend(weights, *found[:3])
    assert np.abs(np.asarray(mixed) - own).mean() < 0.1 * np.abs(own).mean()
    assert float(share.min()) > 0.9


def test_weights_stay_in_their_range_and_need_evidence():
    found, _ = made_up(lambda x: 3 * x - 1)
    _, predicted = blend(learn_quickly({"scene": [found]}), *found[:3])
    assert 0 <= float(predicted.min()) < 0.05 and 0.95 < float(predicted.max()) <= 1
    none = found._replace(weight=0 * found.weight)
    with pytest.raises(ValueError, match="no photograph shows anything of the scenes other than b"):
        learn_quickly({"a": [none], "b": [found]})


def test_what_points_away_from_the_truth_is_not_added():
    def share(x):
        return np.where(x < 0.4, -0.3, 0.8)

    found = {}
    for seed in range(3):
        one, x = made_up(share, seed=seed)
        found[f"scene {seed}"] = [one._replace(colors=CONTRAST * one.residual)]
    _, predicted = map(np.asarray, blend(learn_quickly(found), *found["scene 2"][0][:3]))
    assert predicted[x < 0.35].max() < 0.05 and predicted[x > 0.45].min() > 0.6


def test_a_scene_is_judged_by_a_network_that_never_saw_it(tmp_path, monkeypatch):
    """Two scenes have all of the residual, a third has none, and one pixel counts as much there."""
    shares = {"a": 1.0, "b": 1.0, "none": 0.0}
    found = {
        name: [made_up(lambda x, share=share: share + 0 * x, seed=seed)[0]]
        for seed, (name, share) in enumerate(shares.items())
    }
    path = tmp_path / "weights.npz"
    write_known(path, list(found), learn_quickly(found))
    monkeypatch.setattr(detail_weights, "KNOWN", path)
    detail_weights._read_known.cache_clear()

    def share(unseen):
        rows = found["a"][0][:3]
        return float(np.mean(blend(known_weights(unseen), *rows)[1]))

    try:
        assert share("none") > 0.97 and share("a") < 0.9 and share("b") < 0.9
        assert share("another") == share(None) and share("a") < share(None) < share("none")
    finally:
        detail_weights._read_known.cache_clear()


def test_built_in_scenes_taught_the_weights_that_come_with_the_package():
    """All but the statue did, which all networks therefore judge."""
    names, weights = detail_weights._read_known()
    assert sorted(names) == sorted(set(DRAWN_SCENES) - {"statue"})
    assert known_weights("statue") is weights
    for networks in (weights.mixing, weights.errors):
        assert networks.center.shape == networks.scale.shape == (len(names), FEATURES)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(networks))
    own = known_weights(names[2])
    np.testing.assert_array_equal(own.errors.center, weights.errors.center[2:3])


@pytest.fixture(scope="module")
def rendered(kept, tmp_path_factory):
    """The run's programs, its state blurred, and where its detail is kept."""
    with jax.numpy_dtype_promotion("standard"):
        record = read_run(kept)
        scene = load_run_scene(record)
        programs, state = restore(record, scene, "closeup")
    wide = state.params.replace(log_scales=state.params.log_scales + 0.4)
    return (
        programs,
        state.replace(params=wide),
        detail_path(tmp_path_factory.mktemp("run"), "closeup"),
    )


@pytest.fixture(scope="module")
def found(rendered):
    programs, state, path = rendered
    return find_detail(programs, state, path)


def test_renders_with_detail_come_nearer_to_the_truth(rendered, found):
    programs, state, _ = rendered
    detail, about = found
    assert about == {"divisor": 1, "sizes": list(map(list, detail.shown.sizes))}
    for views in (programs.scene.test, programs.scene.test_far):
        camera, truth = camera_at(views.cameras, 0), to_float(views.rgb[0])
        seen = programs.render(state, camera)
        sharper = detailed(programs, detail, camera, seen)
        solid = np.asarray(seen.alpha) > 0.9
        before, after = (
            np.abs(np.asarray(rgb) - np.asarray(truth))[solid].mean()
            for rgb in (seen.rgb, sharper.rgb)
        )
        assert after < 0.9 * before
        weight = np.asarray(sharper.weight)
        assert weight.min() >= 0 and weight.max() <= 1
        error, seen_by = np.asarray(sharper.error), np.isfinite(sharper.footprint)
        np.testing.assert_array_equal(np.isfinite(error), seen_by)
        assert error[seen_by].min() > 0 and error[seen_by].max() < 1
        # Nothing is added where nothing was rendered, not even trust; colors around it fill it.
        for missing in (np.ones(solid.shape, bool), np.arange(solid.shape[1])[None] >= 20):
            there = jnp.asarray(~np.broadcast_to(missing, solid.shape))
            hole = seen._replace(
                rgb=jnp.where(there[..., None], seen.rgb, 0),
                alpha=jnp.where(there, seen.alpha, 0),
                depth=jnp.where(there, seen.depth, 0),
            )
            alone = detailed(programs, detail, camera, hole)
            unseen = ~np.asarray(there)
            assert not np.asarray(alone.weight)[unseen].any()
            assert np.isnan(np.asarray(alone.error)[unseen]).all()
            if unseen.all():
                np.testing.assert_array_equal(alone.rgb, 0)
            else:
                # Photographs look past the plane through many places on these rays, so the colors
                # around fill them as far as they are not empty.
                pixels = pixel_grid(camera.height, camera.width)
                empty = np.asarray(find_empty(camera, pixels, detail.sources))[:, 20]
                rows = empty < 0.75
                assert rows.mean() > 0.2
                column = np.asarray(alone.rgb)[rows].mean(0)
                filled = (1 - empty[rows].mean()) * column[19]
                assert np.abs(column[20] - filled).max() < 0.3 * column[19].max()


def test_target_views_may_be_labeled_by_their_detail(rendered, found, monkeypatch):
    programs, state, path = rendered
    by_detail = dataclasses.replace(KEPT.labels, label="residual")
    # Its weights replace the gate of warps.
    targets = TargetConfig("residual", KEPT.labels.label_loss_weight, KEPT.labels.lr_scale)
    gated = dataclasses.replace(programs.preset, gated=True, targets=targets)
    monkeypatch.setattr(programs, "preset", gated)
    monkeypatch.setattr(gate, "weigh_labels", lambda *_: pytest.fail("asked the gate"))
    monkeypatch.setattr(kept_detail, "make_detail", lambda *_: pytest.fail("made again"))
    views, start = programs.scene.test, start_labels(programs, state, run_keys(0))
    find = detail_getter(programs, state, path)
    labels = label_target_views(programs, start, views.cameras, by_detail, None, find)
    truth = np.asarray(to_float(views.rgb))
    render = functools.partial(programs.render, state)

    def error(rgb):
        return np.average(np.abs(np.asarray(rgb) - truth).mean(-1), weights=labels.weight)

    seen = [render(camera_at(views.cameras, i)).rgb for i in range(len(views))]
    assert error(labels.rgb) < 0.9 * error(np.stack(seen))
    monkeypatch.setattr(programs, "run", lambda *data, count: (data, {"skipped": 0}))
    begun, data = fine_tune(programs, start, views.cameras, find, most=1)
    assert (begun, data.views) == (state, programs.scene.train)
    jax.tree.map(np.testing.assert_array_equal, data.labels, labels)

    # Of views larger than the windows of photographs, windows as large as these are learned.
    train, size = programs.scene.train, (views.cameras.height - 2, views.cameras.width - 3)
    windows = view_windows(train, *size)
    monkeypatch.setitem(vars(programs), "photographs", windows)
    learned = fine_tune(programs, start, views.cameras, find, most=1)[1].labels
    assert learned.size == size
    for view, weight in enumerate(labels.weight):
        shown = to_float(learned.pyramid.image(view, 0))[..., 3]
        np.testing.assert_allclose(shown, weight, atol=0.002)

    near = label_closeups(programs, start, by_detail, run_keys(0), find)
    assert len(near) == gated.closeup_steps and 0.1 < near.weight.mean() < 1
    far = np.asarray(programs.scene.train.cameras.position)

    others = label_closeups(programs, start, by_detail, run_keys(1), find)
    drawn = [np.asarray(views.cameras.position)[:, None] for views in (near, others)]
    assert all(np.linalg.norm(far - one, axis=-1).min() > 0 for one in drawn)
    assert not np.any(drawn[0] == drawn[1])


def test_a_tuned_state_has_the_detail_of_photographs_that_see_the_view(rendered, found):
    """Its own residuals, of these photographs alone; what others show changes nothing."""
    programs, state, _ = rendered
    detail, _ = found
    view = camera_at(programs.scene.test.cameras, 0)
    cameras = jax.tree.map(lambda leaf: leaf[None], view)
    seen = programs.render(state, view)
    same = tuned_detail(programs, state, cameras, detail)
    whole, part = (detailed(programs, one, view, seen) for one in (detail, same))
    np.testing.assert_allclose(part.rgb, whole.rgb, atol=1e-6)

    # One photograph shows nothing any more, and the other four are a multiple of two.
    trust = detail.sources.trust.at[1].set(0)
    sources = join_maps(detail.sources.cameras, detail.sources.inverse_depth, trust)
    blind = detail.replace(sources=sources)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fine_tuning, "_TOGETHER", 2)
        others = tuned_detail(programs, state, cameras, blind)
    left = np.array([i for i in range(len(programs.scene.train)) if i != 1])
    assert len(left) == 4
    kept = np.split(np.asarray(detail.shown.values), 5)
    np.testing.assert_array_equal(others.shown.values, np.concatenate([kept[i] for i in left]))

    # A state that blurs more has its own residuals: with those of the first it stays further away.
    wide = state.params.replace(log_scales=state.params.log_scales + 0.4)
    blurred = state.replace(params=wide)
    tuned = tuned_detail(programs, blurred, cameras, detail)
    truth, seen = to_float(programs.scene.test.rgb[0]), programs.render(blurred, view)
    errors = [
        np.abs(np.asarray(detailed(programs, one, view, seen).rgb) - np.asarray(truth)).mean()
        for one in (tuned, detail)
    ]
    assert errors[0] < 0.98 * errors[1], errors


def test_detail_is_kept_with_its_state_and_made_again_for_another(rendered, found, monkeypatch):
    programs, state, path = rendered
    monkeypatch.setattr(kept_detail, "make_detail", lambda *_: pytest.fail("made again"))
    again, about = find_detail(programs, state, path)
    assert about == found[1]
    jax.tree.map(np.testing.assert_array_equal, again, found[0])

    made = []
    monkeypatch.setattr(kept_detail, "make_detail", lambda *_: made.append(1) or found)
    other = state.replace(params=state.params.replace(sh=0.9 * state.params.sh))
    find_detail(programs, other, path)
    find_detail(programs, other, path)
    assert len(made) == 1
    path.write_bytes(path.read_bytes()[:100])
    find_detail(programs, other, path)
    assert len(made) == 2


def test_damaged_detail_is_made_again(rendered, found, monkeypatch, capsys):
    programs, state, path = rendered
    path.unlink()
    made = []
    monkeypatch.setattr(kept_detail, "make_detail", lambda *_: made.append(1) or found)
    find_detail(programs, state, path)
    whole = path.read_bytes()
    assert "damaged" not in capsys.readouterr().out
    key = kept_detail._hash(programs, state)
    arrays, about = load(path, key)

    def changed(about=about, **changes):
        kept = {name: array for name, array in (arrays | changes).items() if array is not None}
        save(path, key, Stored(kept, about))
        return path.read_bytes()

    middle = len(whole) // 2
    damages = [b"", whole[:100], whole[:-9], b"x" * 100]
    damages += [whole[:middle] + bytes(9) + whole[middle + 9 :], changed(finer=None)]
    damages += [changed(trust=arrays["trust"][:, 1:]), changed(values=arrays["values"] * 1.0)]
    damages += [changed(finer=arrays["finer"][None]), changed(about={})]
    damages += [changed(intrinsics=arrays["intrinsics"][1:]), changed(inverse_depth=None)]
    damages += [changed(about=about | {"sizes": [3]}), changed(other=np.zeros(3))]
    for count, damaged in enumerate(damages, 2):
        path.write_bytes(damaged)
        again, _ = find_detail(programs, state, path)
        assert len(made) == count and capsys.readouterr().out.count("is damaged") == 1
        jax.tree.map(np.testing.assert_array_equal, again, found[0])
    find_detail(programs, state, path)
    assert len(made) == count
    path.unlink()
    path.mkdir()
    find_detail(programs, state, path)
    out = capsys.readouterr().out
    assert len(made) == count + 1 and out.count("is damaged") == out.count("made again next") == 1
    path.rmdir()


def test_an_enlarged_render_stays_in_its_place():
    pose = jnp.eye(3, 4)
    coarse = Camera(pose, jnp.array([20.0, 20.5, 15, 12]), 24, 30)
    fine = Camera(pose, jnp.array([61.0, 59.5, 45.5, 36.2]), 72, 91)

    def image(camera):
        x, y = np.moveaxis(np.asarray(pixel_grid(camera.height, camera.width)), -1, 0)
        fx, fy, cx, cy = np.asarray(camera.intrinsics)
        wave = 0.5 + 0.4 * np.sin(4 * (x - cx) / fx) * np.cos(3 * (y - cy) / fy)
        return np.stack([wave, wave**2, 1 - wave], axis=-1).astype(np.float32)

    rgb = enlarge(image(coarse), coarse, fine)
    inner = np.s_[6:-6, 6:-6]
    assert np.abs(rgb - image(fine))[inner].max() < 0.006  # a tenth of a coarse pixel


def test_a_scene_is_read_at_the_finest_size_that_fits(capture_folder):
    scene = load_scene(str(capture_folder), downscale=4)
    assert scene.train.rgb.shape[1:3] == (6, 8)
    pyramid, divisor = scene_pyramid(scene)
    assert divisor == 1 and pyramid.sizes == ((24, 32), (12, 16), (6, 8))
    whole = load_scene(str(capture_folder))
    finest = np.stack([pyramid.image(view, 0) for view in range(len(pyramid))])
    np.testing.assert_array_equal(finest[..., :3], whole.train.rgb)
    np.testing.assert_array_equal(pyramid.intrinsics[:, 0], whole.train.cameras.intrinsics)
    size = 5 * 24 * 32 * 4 * 4 / 3
    assert scene_pyramid(scene, budget=int(size) - 1)[1] == 2
    assert scene_pyramid(scene, budget=int(size / 4) - 1)[1] == 3
    assert scene_pyramid(scene, budget=1)[1] == 4  # what training reads anyway


def test_held_out_parts_of_photographs_are_not_read(capture_folder):
    scene = load_scene(str(capture_folder), split="zoom", zoom=2)
    assert scene.photographs_at is None
    assert scene_pyramid(scene)[0].sizes[0] == scene.train.rgb.shape[1:3]


def test_views_are_scored_at_their_own_size_only_where_finer_photographs_are_kept(
    capture_folder, capsys
):
    scene = load_scene(str(capture_folder), downscale=4)
    depths = jnp.ones(scene.train.weight.shape)

    def score(scene):
        flat = lambda camera: SimpleNamespace(depth=jnp.ones((camera.height, camera.width)))  # noqa: E731
        targets = targets_by_split(scene, depths, None, flat, divisor=2)
        return {split: views[0].rgb.shape[:2] for split, views in targets.items()}

    sizes = score(scene)
    assert set(sizes.values()) == {(6, 8), (12, 16)}
    assert all(
        sizes[split] == ((6, 8) if split.endswith("_reduced") else (12, 16)) for split in sizes
    )

    def gone(factor, split):
        raise SceneError("images/000.png is not there")

    kept = score(dataclasses.replace(scene, photographs_at=gone))
    assert kept == {split: (6, 8) for split, size in sizes.items() if size == (12, 16)}
    assert "size of training alone: images/000.png is not there" in capsys.readouterr().out
