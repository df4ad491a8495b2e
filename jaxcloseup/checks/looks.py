"""Photographs that teach little: constant, blurred, wrongly exposed."""

from collections.abc import Sequence

import numpy as np

from jaxcloseup.checks.matches import Matches


_CONSTANT = 1.0  # gray levels of standard deviation
_BLURRED = 0.35  # sharpness as a share of the capture's median
_CLIPPED = 0.25  # share of black or white pixels, over the capture's median
_EXPOSED = 1.25  # ratio of brightness between photographs that is worth a note
_NAMED = 3  # photographs that a note names


def describe_looks(looks: np.ndarray, names: Sequence[str]) -> list[str]:
    """Return a note for each kind of photograph that teaches little.

    Args:
      looks: `[V, 4]` what `evidence.look` measures.
      names: names of the photographs.
    """
    contrast, sharpness, black, white = looks.T
    kinds = {
        "constant, or masked whole": contrast < _CONSTANT,
        "blurred beside the others": sharpness < _BLURRED * np.median(sharpness),
        "underexposed": black > np.median(black) + _CLIPPED,
        "overexposed": white > np.median(white) + _CLIPPED,
    }
    return [
        f"{chosen.sum()} of {len(names)} photographs are {kind}: {_some(names, chosen)}"
        for kind, chosen in kinds.items()
        if chosen.any()
    ]


def exposures(matches: Matches, names: Sequence[str]) -> list[str]:
    """Return a note if the same surfaces are much brighter in some photographs, or tinted.

    The brightness of each photograph and channel is what fits the ratios of matched features best,
    in the sense of least squares.

    Args:
      matches: matches of the photographs.
      names: names of the photographs.
    """
    pairs, place = np.unique(matches.views, axis=0, return_inverse=True)
    if not len(pairs):
        return []
    logs = np.log(matches.rgb.astype(np.float64) + 4)  # noise of dark pixels should not count
    differences = logs[:, 1] - logs[:, 0]
    ratios = np.array([np.median(differences[place == i], axis=0) for i in range(len(pairs))])
    rows = np.zeros((len(pairs), len(names)))
    rows[np.arange(len(pairs)), pairs[:, 0]] = -1
    rows[np.arange(len(pairs)), pairs[:, 1]] = 1
    gains = np.linalg.lstsq(rows, ratios, rcond=None)[0]  # [V, 3], 0 without matches
    bright, tint = gains.mean(1), gains - gains.mean(1, keepdims=True)
    notes = []
    if (ratio := np.exp(np.ptp(bright))) > _EXPOSED:
        dark, light = names[int(bright.argmin())], names[int(bright.argmax())]
        notes.append(
            f"exposure differs {ratio:.2g} times between photographs, from {dark} to {light}"
        )
    if (ratio := np.exp(np.ptp(tint, axis=0).max())) > _EXPOSED:
        notes.append(f"white balance differs {ratio:.2g} times between photographs")
    return notes


def _some(names: Sequence[str], chosen: np.ndarray) -> str:
    first = [name for name, one in zip(names, chosen, strict=True) if one]
    return ", ".join(first[:_NAMED]) + (", ..." if len(first) > _NAMED else "")
