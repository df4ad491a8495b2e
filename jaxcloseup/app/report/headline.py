"""What a run found, in a sentence, and in a small table of each kind of view."""

from collections.abc import Iterable, Mapping
from typing import Any

from jaxcloseup.app.score.metrics_text import COLUMNS, FINER, SPLIT_TITLES, format_metric


_DEPTH = ("depth_error_median", "point_depth_error_median")
# Perceptual distances where their networks are at hand, else colors that were corrected.
_LAST = ("lpips_vgg", "lpips_alex", "cc_psnr")
_SHORT = {"cc_psnr": "color-corrected"} | dict.fromkeys(_DEPTH, "depth off by")


def best_stage(stages: Iterable[str]) -> str:
    """The stage whose renders are shown first."""
    stages = list(stages)
    return "detail" if "detail" in stages else stages[-1]


def used_labels(results: Mapping[str, Any]) -> bool:
    """Whether the gate let labels in; there may be none."""
    return results["gate"] is None or results["gate"]["weight"] > 0


def conclusion(results: Mapping[str, Any]) -> str:
    """Return what the run found on its close-ups, or ordinary views if it has no close-ups."""
    stages = results["stages"]
    split = "test" if any("test" in splits for splits in stages.values()) else "test_far"
    views = SPLIT_TITLES[split]
    psnr = {stage: splits[split]["psnr"] for stage, splits in stages.items() if split in splits}
    psnr = {stage: value for stage, value in psnr.items() if value is not None}
    if not psnr:
        return "No view was held out, so nothing tells how good the renders are."
    if results["detail"] and {"detail", results["detail"]["stage"]} <= set(psnr):
        change = psnr["detail"] - psnr[results["detail"]["stage"]]
        text = (
            f"{views} have a PSNR of {psnr['detail']:.1f} dB with the photographs' detail, "
            f"{than(change, 1)} than the trained field alone."
        )
    else:
        stage = next(name for name in ("closeup", "control", "baseline", *psnr) if name in psnr)
        text = f"{views} have a PSNR of {psnr[stage]:.1f} dB."
    return f"{text} {_say_of_labels(results, psnr)}".rstrip()


def _say_of_labels(results, psnr):
    if "closeup" not in psnr:
        return ""
    if not used_labels(results):
        agreement = results["gate"]["agreement"]
        return (
            f"Labels were not used: on photographs that were left out, only {agreement:.0%} of "
            "their pixels agreed closely, too few to trust them."
        )
    history = results["history"].get("closeup") or [{}]
    coverage = history[-1].get("label_coverage")
    found = "" if coverage is None else f" found for {coverage:.0%} of the pixels of close-ups"
    if "control" not in psnr:
        return f"The field learned from labels{found}; no control tells what they changed."
    change = psnr["closeup"] - psnr["control"]
    if round(abs(change), 2) == 0:
        return f"Labels{found} changed nothing."
    return f"Labels{found} made the field {than(change, 2)} than as many steps without."


def than(change: float, digits: int) -> str:
    """Say how much better or worse a PSNR is, in dB."""
    return f"{abs(change):.{digits}f} dB {'worse' if change < 0 else 'better'}"


def tables(results: Mapping[str, Any]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Return a header and a row for each stage, by the title of the views; at most six columns.

    Stages that took no labels are one row with their control.
    """
    stages, found = results["stages"], {}
    names = {stage: stage for stage in stages}
    if not used_labels(results):
        targets = results["config"].get("targets")
        gated = {"closeup": "control"}
        if targets is None or targets["label"] == "warp":
            gated["test_time"] = "test_time_control"
        for stage, control in gated.items():
            if stage in names and control in names:
                del names[stage]
                names[control] = f"{control}, {stage}"
    for split, title in SPLIT_TITLES.items():
        scores = {stage: splits[split] for stage, splits in stages.items() if split in splits}
        if not scores or split.endswith(FINER):
            continue
        finer = {stage: splits.get(split + FINER, {}) for stage, splits in stages.items()}

        def first_known(keys, scores=scores):
            known = (k for k in keys if any(one.get(k) is not None for one in scores.values()))
            return next(known, None)

        columns = [(COLUMNS["psnr"], "psnr", scores)]
        if any(one.get("psnr") is not None for one in finer.values()):
            width, height = results["finer_resolution"]
            columns.append((f"at {width} x {height}", "psnr", finer))
        columns.append((COLUMNS["ssim"], "ssim", scores))
        for keys in (_LAST, _DEPTH):
            key = first_known(keys)
            if key is not None:
                columns.append((_SHORT.get(key) or COLUMNS[key], key, scores))
        body = [
            [name, *(_cell(key, values[stage].get(key)) for _, key, values in columns)]
            for stage, name in names.items()
            if stage in scores
        ]
        found[title] = ["stage", *(name for name, _, _ in columns)], body
    return found


def _cell(key, value):
    if key in _DEPTH and value is not None:
        return f"{value:.2%}"
    return format_metric(key, value)
