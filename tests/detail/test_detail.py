"""Detail of a run's state: renders that come nearer to the truth, and a kept file."""

import dataclasses
import functools

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
from jaxcloseup.app.run.left_out import check_left_out
from jaxcloseup.app.store.stored_run import load_run_scene, read_run, restore
from jaxcloseup.detail.holes import find_empty
from jaxcloseup.detail.weights import with_larger_errors
from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.io.cache import Stored, load, save
from jaxcloseup.photos.depth_maps import join_maps
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.photos.windows import view_windows


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
    sizes = list(map(list, detail.shown.sizes))
    checked = {name: about[name] for name in ("error_scale", "confirmed")}
    assert about == {"divisor": 1, "sizes": sizes, **checked}
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
        # Nothing is added where nothing was rendered, not even trust; colors around fill half.
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
                # around fill half of them as far as they are not empty.
                pixels = pixel_grid(camera.height, camera.width)
                empty = np.asarray(find_empty(camera, pixels, detail.sources))[:, 20]
                rows = empty < 0.75
                assert rows.mean() > 0.2
                column = np.asarray(alone.rgb)[rows].mean(0)
                filled = 0.5 * (1 - empty[rows].mean()) * column[19]
                assert np.abs(column[20] - filled).max() < 0.15 * column[19].max()


def test_target_views_may_be_labeled_by_their_detail(rendered, found, monkeypatch):
    programs, state, path = rendered
    by_detail = dataclasses.replace(KEPT.labels, label="residual")
    # Its weights replace the gate of warps.
    targets = TargetConfig("residual", KEPT.labels.label_loss_weight, KEPT.labels.lr_scale)
    gated = dataclasses.replace(programs.preset, gated=True, targets=targets)
    monkeypatch.setattr(programs, "preset", gated)
    monkeypatch.setattr(gate, "weigh_labels", lambda *_: pytest.fail("asked the gate"))
    monkeypatch.setattr(kept_detail, "make_detail", lambda *_: pytest.fail("made again"))
    views, start = programs.scene.test, start_labels(programs, state)
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
    without = detailed(programs, others, view, programs.render(state, view))
    ignored = detailed(programs, blind, view, programs.render(state, view))
    assert np.abs(np.asarray(without.rgb - ignored.rgb)).mean() < 0.01

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


def test_errors_are_expected_as_large_as_at_photographs_left_out(rendered, found):
    """Networks that expect a tenth are corrected tenfold; those that expect too much are not."""
    programs, state, _ = rendered
    detail, about = found
    pyramid, _ = programs.pyramid()
    scales = []
    for factor in (0.1 / about["error_scale"], 0.05 / about["error_scale"], 100):
        other = detail.replace(weights=with_larger_errors(detail.weights, factor), confirmed=1.0)
        scales.append(check_left_out(programs, state, other, pyramid).error_scale)
    assert about["error_scale"] >= 1 and scales[2] == 1
    assert scales[1] == pytest.approx(2 * scales[0], rel=0.02) and scales[0] > 2
    camera = camera_at(programs.scene.test.cameras, 0)
    seen = programs.render(state, camera)
    larger = detail.replace(weights=with_larger_errors(detail.weights, 3))
    errors = [np.asarray(detailed(programs, one, camera, seen).error) for one in (detail, larger)]
    np.testing.assert_allclose(errors[1], 3 * errors[0], rtol=1e-4)


def test_detail_that_photographs_do_not_confirm_is_halved(rendered, found):
    """The others' residuals of a photograph are what it lacks, its opposite, or noise."""
    programs, state, _ = rendered
    detail, _ = found
    detail = detail.replace(confirmed=1.0)
    pyramid, _ = programs.pyramid()
    values = np.asarray(detail.shown.values)
    opposite = -np.maximum(values, -127)
    noise = np.random.default_rng(0).permutation(values)
    confirmed = [
        check_left_out(
            programs, state, detail.replace(shown=detail.shown.replace(values=shown)), pyramid
        ).confirmed
        for shown in (values, noise, opposite)
    ]
    assert 1 >= confirmed[0] > 0.8 and 0.5 <= confirmed[1] < confirmed[0] and confirmed[2] == 0.5
    camera = camera_at(programs.scene.test.cameras, 0)
    seen = programs.render(state, camera)
    half, whole = (
        detailed(programs, detail.replace(confirmed=part), camera, seen) for part in (0.5, 1.0)
    )
    np.testing.assert_allclose(half.weight, 0.5 * whole.weight, rtol=1e-6)


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
    changed = dataclasses.replace(programs.preset.field, background=1.0)
    changed = dataclasses.replace(programs.preset, field=changed)
    monkeypatch.setattr(programs, "preset", changed)  # as `--set` does to a rendering
    find_detail(programs, other, path)
    assert len(made) == 3


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
