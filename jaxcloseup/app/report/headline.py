"""The result of a run: one sentence, a small table for each kind of view, and all scores."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from jaxcloseup.app.report.record_table import Table, print_tables
from jaxcloseup.app.score.metrics_text import (
    COLUMNS,
    DEPTH_ERRORS,
    REDUCED,
    SPLIT_TITLES,
    format_metric,
)


Splits = Mapping[str, Mapping[str, Any]]  # metrics by split

# Perceptual distances where their networks are available, else PSNR of corrected colors.
_LAST = ("lpips_vgg", "lpips_alex", "cc_psnr")
_CONTROLS = {"closeup": "control", "test_time": "test_time_control"}  # of stages with labels
_SHORT = {"cc_psnr": "color-corrected"} | dict.fromkeys(DEPTH_ERRORS, "depth off by")


def best_stage(stages: Iterable[str]) -> str:
    """Return the stage whose renders are shown first."""
    stages = list(stages)
    return "detail" if "detail" in stages else stages[-1]


def used_labels(results: Mapping[str, Any], stage: str = "closeup") -> bool:
    """Return True if `closeup` or `test_time` used labels; the gate can disable warped ones."""
    config, gate = results["config"], results["gate"]
    targets = config.get("targets") if stage == "test_time" else None
    labels = targets or config["labels"]
    return labels["label"] != "warp" or gate is None or gate["weight"] > 0


def conclusion(results: Mapping[str, Any]) -> str:
    """Return the result on close-ups, or on ordinary views if the run has no close-ups."""
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
            f"{compare_psnr(change, 1)} than the trained field alone."
        )
    else:
        stage = next(name for name in ("closeup", "control", "baseline", *psnr) if name in psnr)
        text = f"{views} have a PSNR of {psnr[stage]:.1f} dB."
    return f"{text} {_effect_of_labels(results, psnr)}".rstrip()


def _effect_of_labels(results: Mapping[str, Any], psnr: Mapping[str, float]) -> str:
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
    where = "" if coverage is None else f" found for {coverage:.0%} of the pixels of close-ups"
    if "control" not in psnr:
        return f"The field learned from labels{where}; no control tells what they changed."
    change = psnr["closeup"] - psnr["control"]
    if round(abs(change), 2) == 0:
        return f"Labels{where} changed nothing."
    return f"Labels{where} made the field {compare_psnr(change, 2)} than as many steps without."


def compare_psnr(change: float, digits: int) -> str:
    """Describe how much better or worse a PSNR is, in dB."""
    return f"{abs(change):.{digits}f} dB {'worse' if change < 0 else 'better'}"


def run_tables(results: Mapping[str, Any]) -> list[Table]:
    """Return `score_tables` of a run; stages that used no labels share a row with their control."""
    names = {stage: stage for stage in results["stages"]}
    for stage, control in _CONTROLS.items():
        if {stage, control} <= set(names) and not used_labels(results, stage):
            del names[stage]
            names[control] = f"{control}, {stage}"
    return score_tables(results["stages"], reduced_size=results["resolution"], names=names)


def score_tables(
    stages: Mapping[str, Splits],
    *,
    reduced_size: tuple[int, int] | None,
    names: Mapping[str, str] | None = None,
    row: str = "stage",
) -> list[Table]:
    """Return a table of at most seven columns for each kind of view.

    Args:
      stages: metrics by stage and split.
      reduced_size: width and height of reduced views, or None where rows differ in it.
      names: text of each stage that has a row; default: all stages, by their names.
      row: what a row is.
    """
    tables = []
    for split, title in SPLIT_TITLES.items():
        scores = {stage: splits[split] for stage, splits in stages.items() if split in splits}
        if not scores or split.endswith(REDUCED):
            continue
        reduced = {stage: stages[stage].get(split + REDUCED, {}) for stage in scores}
        columns = [(COLUMNS["psnr"], "psnr", scores), (COLUMNS["ssim"], "ssim", scores)]
        if _known(scores.values(), ["resolves"]):
            columns.append((COLUMNS["resolves"], "resolves", scores))
        for keys in (_LAST, DEPTH_ERRORS):
            known = _known(scores.values(), keys)[:1]
            columns += [(_SHORT.get(key, COLUMNS[key]), key, scores) for key in known]
        if reduced_size and _known(reduced.values(), ["psnr"]):
            columns.append((f"at {reduced_size[0]} x {reduced_size[1]}", "psnr", reduced))
        body = [
            [name, *(_cell(key, values[stage].get(key)) for _, key, values in columns)]
            for stage, name in (names or {stage: stage for stage in stages}).items()
            if stage in scores
        ]
        tables.append(Table(title, [row, *(column for column, _, _ in columns)], body))
    return tables


def all_scores(stages: Mapping[str, Splits]) -> Table:
    """Return all scores: a row for each split and stage."""
    scores = [scores for splits in stages.values() for scores in splits.values()]
    keys = _known(scores, COLUMNS)
    body = [
        [title, stage, *(format_metric(key, splits[split].get(key)) for key in keys)]
        for split, title in SPLIT_TITLES.items()
        for stage, splits in stages.items()
        if split in splits
    ]
    header = ["views", "stage", *(COLUMNS[key] for key in keys)]
    return Table("All scores", header, body, names=2)


def print_results(results: Mapping[str, Any]) -> None:
    """Print a run's table of each kind of view, and its conclusion."""
    print_tables(run_tables(results), conclusion(results))


def _known(scores: Collection[Mapping[str, Any]], keys: Iterable[str]) -> list[str]:
    """Return the metrics that any of the scores has."""
    return [key for key in keys if any(values.get(key) is not None for values in scores)]


def _cell(key: str, value: float | None) -> str:
    if key in DEPTH_ERRORS and value is not None:
        return f"{value:.2%}"
    return format_metric(key, value)
