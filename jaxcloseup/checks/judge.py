"""Judge a capture by its evidence: do poses, lenses and points fit the photographs?"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcloseup.checks.epipolar import Fit, capture_parallax, fit
from jaxcloseup.checks.evidence import SIDE, Evidence
from jaxcloseup.checks.looks import describe_looks, exposures
from jaxcloseup.checks.mistakes import find_mistake
from jaxcloseup.checks.order import find_order
from jaxcloseup.checks.point_patches import coverage, find_points_mistake, fit_points


FITS, LOOSE, MISFIT, UNKNOWN = "fits", "loose", "misfit", "unknown"
_FEWEST = 60  # matches, below which nothing is said of poses
_MOST_WRONG = 0.5  # share of matches that do not fit, from which the capture is refused
_BLURRED = 0.8  # pixels of median error from which close-ups are blurred
_SHOWN = 0.3  # share of points with texture in two photographs, below which a turn may show more
_OUT_OF_VIEW = 0.05  # share of points in two views, below which they are of no use
_FEW_VIEWS = 3  # of photographs that depth needs; most that see a point may be hidden from it
_LEAST_PARALLAX = 3.0  # degrees, with which half a pixel of 800 is 1 or 2 percent of depth
_BAD = 0.3  # share of a photograph's fitting matches below which its pose is wrong


@dataclasses.dataclass(frozen=True)
class Checked:
    """What a check found. All of it is plain JSON."""

    verdict: str  # whether poses fit: `FITS`, `LOOSE`, `MISFIT` or `UNKNOWN`
    sentence: str  # what is said first
    notes: tuple[str, ...]  # further sentences
    corrections: tuple[str, ...]  # of the known mistake that was found, if one was
    # what to read in place of points that do not fit: `points=none` or a turn; none where they fit
    points: tuple[str, ...]
    figures: dict[str, Any]  # numbers behind the sentences
    worst: tuple[tuple[str, float], ...]  # photographs with the smallest shares of fitting matches


def judge(evidence: Evidence, points: np.ndarray, *, opengl: bool, ordered: bool = True) -> Checked:
    """Judge a capture.

    Args:
      evidence: what its photographs show.
      points: `[P, 3]` its world points.
      opengl: whether the file's matrices have OpenGL's axes, as transforms.json has.
      ordered: whether the evidence is of all photographs, so that an order can be corrected.
    """
    names, matches, cameras = evidence.names, evidence.matches, evidence.cameras
    count = len(matches.views)
    figures: dict[str, Any] = {"photographs": len(names), "matches": count, "points": len(points)}
    found = fit(matches, cameras) if count >= _FEWEST else None
    corrections: tuple[str, ...] = ()
    if found is None:
        verdict = UNKNOWN
        photographs = f"{len(names)} photograph{'s' * (len(names) != 1)}"
        sentence = f"{photographs}, poses are not checked: only {count} features match between them"
    else:
        figures |= {"share": found.share, "median": found.median}
        verdict, sentence, corrections = _judge_poses(
            evidence, found, names, opengl=opengl, ordered=ordered
        )
    about, instead = _judge_points(evidence, points, figures, trusted=verdict in (FITS, LOOSE))
    notes = [*describe_looks(evidence.looks, names), *exposures(matches, names)]
    if verdict in (FITS, LOOSE):
        notes += _coverage(evidence, points, figures)
    worst = sorted(
        (float(share), name)
        for share, name in zip(found.by_view if found else (), names, strict=False)
        if np.isfinite(share)
    )
    return Checked(
        verdict=verdict,
        sentence=sentence + about,
        notes=tuple(notes),
        corrections=corrections,
        points=instead,
        figures=figures,
        worst=tuple((name, share) for share, name in worst[:12]),
    )


def _judge_poses(
    evidence: Evidence, found: Fit, names: Sequence[str], *, opengl: bool, ordered: bool
) -> tuple[str, str, tuple[str, ...]]:
    """Return verdict, sentence and corrections for poses and lenses."""
    count = len(evidence.matches.views)
    wrong = (found.by_best < _BAD) & ~found.precise
    bad = [name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong]
    fits = f"{len(names)} photographs, poses fit: {found.median:.1f} px"
    most = found.share >= 1 - _MOST_WRONG
    if most and not bad and found.median <= _BLURRED:
        return FITS, fits, ()
    if not most and found.all_precise:
        others = "in some matches of each; the others are far off, as where a pattern repeats"
        return FITS, f"{len(names)} photographs, poses fit: {found.fitting:.1f} px {others}", ()
    said = (
        f"{round(found.share * count):,} of {count:,} features that match between photographs fit "
        f"their poses (median error {found.median:.0f} px of {SIDE})"
    )
    mistake = find_mistake(evidence.matches, evidence.cameras, opengl=opengl)
    if mistake:
        return MISFIT, f"{said}: {mistake.sentence}", mistake.corrections
    order = find_order(evidence.matches, evidence.cameras)
    if order is not None:
        corrections = ("order=" + ",".join(map(str, order)),) if ordered else ()
        return MISFIT, f"{said}: {_describe_order(order, names)}", corrections
    if most and not bad:
        off = (
            f"{len(names)} photographs, poses are off by {found.median:.1f} px of {SIDE} in the "
            "median: close-ups will be blurred by as much"
        )
        return LOOSE, off, ()
    if most:
        some = f"{len(bad)} photographs, such as " if len(bad) > 3 else ""
        return LOOSE, f"{fits}, but not those of {some}{', '.join(bad[:3])}", ()
    return MISFIT, f"{said}, and no known mistake explains it", ()


def _describe_order(order: np.ndarray, names: Sequence[str]) -> str:
    """Say how the order of poses differs from that of photographs."""
    count = len(order)
    moved = np.flatnonzero(order != np.arange(count))
    if (order == np.arange(count)[::-1]).all():
        return "poses are listed in the reverse order of the photographs"
    if len(np.unique((order - np.arange(count)) % count)) == 1:
        return f"poses are listed {order[0]} places off the photographs"
    if len(moved) == 2:
        return f"the poses of {names[moved[0]]} and {names[moved[1]]} are exchanged"
    return f"{len(moved)} of {count} poses belong to another photograph than the one listed"


def _judge_points(
    evidence: Evidence, points: np.ndarray, figures: dict[str, Any], *, trusted: bool
) -> tuple[str, tuple[str, ...]]:
    """Return what is said of points, and what to read instead of them."""
    if not trusted:
        return "", ()
    if not len(points):
        return "; no points", ()
    found = fit_points(points, evidence.gray, evidence.cameras)
    figures |= {"points_share": found.share, "points_moved": found.moved}
    if found.known and found.fits and found.textured >= _SHOWN * found.tried:
        return f"; {len(points):,} points fit", ()
    axes = find_points_mistake(points, evidence.gray, evidence.cameras)
    if axes:
        return (
            f"; {len(points):,} points lie in another world than the cameras, turned to ({axes})",
            (f"points={axes}",),
        )
    if found.shown < _OUT_OF_VIEW:
        return (
            f"; only {100 * found.shown:.0f} % of {len(points):,} points are in view of two "
            "photographs"
        ), ("points=none",)
    if not found.known:
        return f"; {len(points):,} points are not checked: photographs show too few of them", ()
    if found.fits:
        return f"; {len(points):,} points fit", ()
    return (
        f"; {len(points):,} points do not lie on what photographs show ({100 * found.share:.0f} % "
        f"look alike in two of them, {100 * found.moved:.0f} % by chance)"
    ), ("points=none",)


def _coverage(evidence: Evidence, points: np.ndarray, figures: dict[str, Any]) -> list[str]:
    """Measure from how many directions and how near surfaces are seen; note what is poor."""
    cameras, views = evidence.cameras, evidence.matches.views
    pairs = np.unique(views, axis=0)
    alone = len(cameras.intrinsics) - len(np.unique(views))
    axes = cameras.camtoworld[:, :, 2]
    cosine = np.sum(axes[pairs[:, 0]] * axes[pairs[:, 1]], -1)
    angle = float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))
    parallax = capture_parallax(evidence.matches, cameras)
    figures |= {"neighbor_degrees": angle, "without_matches": int(alone), "parallax": parallax}
    notes = []
    if parallax < _LEAST_PARALLAX:
        notes.append(
            f"half of the features move by at most {parallax:.1f} degrees between the two cameras "
            "that are farthest apart, so depth is uncertain: take photographs from more places"
        )
    if alone:
        share = "shares" if alone == 1 else "share"
        notes.append(f"{alone} of {len(axes)} photographs {share} no features with others")
    if len(points):
        count, degrees, nearest = coverage(points, cameras)
        figures |= {"views": count, "degrees": degrees, "nearest": nearest}
        if count < _FEW_VIEWS:
            notes.append(f"half of the points lie in the views of at most {count:.0f} photographs")
    return notes
