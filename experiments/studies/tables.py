"""Read finished runs, compare their views, and print tables in Markdown."""

import pathlib
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxcloseup.app.report.record_table import Table, markdown
from jaxcloseup.app.report.sweep_tables import paired_bootstrap
from jaxcloseup.io.files import read_object


SCENES = ["bench", "counter", "room", "stairs", "table"]
CLOSEUPS, ORDINARY = "test", "test_far"  # the splits
TITLES = {CLOSEUPS: "close-ups", ORDINARY: "ordinary"}
Results = Mapping[str, Any]  # content of a run's `results.json`


def finished_runs(
    folders: Sequence[str], root: pathlib.Path, scenes: Iterable[str], *arguments: str
) -> dict[str, Results]:
    """Return the results of runs by the name of their scene.

    Without `folders`, read `root/<scene>` of each scene; make or resume runs that are not finished
    there, with `arguments` as further flags of `experiments.run`.

    Raises:
      CalledProcessError: a run fails.
      ValueError: two runs have scenes of one name.
    """
    paths = [pathlib.Path(folder) for folder in folders]
    for scene in () if folders else scenes:
        paths.append(folder := root / pathlib.Path(scene).name)
        if not (folder / "results.json").exists():
            resume = ["--resume"] if (folder / "checkpoints").is_dir() else []
            given = [f"--scene={scene}", "--seed=0", f"--output_dir={folder}", *arguments, *resume]
            subprocess.run([sys.executable, "-m", "experiments.run", *given], check=True)
    found = [read_object(path / "results.json") for path in paths]
    if len({pathlib.Path(results["scene"]).name for results in found}) < len(found):
        raise ValueError("two runs are of scenes of one name: print them one at a time")
    return {pathlib.Path(results["scene"]).name: results for results in found}


def field_and_detail(results: Results) -> tuple[str, str]:
    """Return the stage of the field alone that has detail, and that with detail."""
    of = (results.get("detail") or {}).get("stage")
    return of or ("control" if "control" in results["stages"] else "baseline"), "detail"


def score(results: Results, stage: str, split: str, metric: str = "psnr") -> float | None:
    """Return the mean score of a stage, or None if the run has none."""
    return results["stages"].get(stage, {}).get(split, {}).get(metric)


def gains(
    results: Results, split: str, stage: str, over: str, *, of: Results | None = None
) -> list[float]:
    """Return by how many dB each view of a stage is better than that of another one, `of` a run."""
    views = results["stages"][stage][split]["views"]
    others = (of or results)["stages"][over][split]["views"]
    return [view["psnr"] - others[name]["psnr"] for name, view in views.items()]


def format_gain(values: Sequence[float], digits: int = 2) -> str:
    """Format the mean of gains with its 95 % interval by a bootstrap over views."""
    low, high = paired_bootstrap([np.array([value]) for value in values])
    mean = f"{np.mean(values):+.{digits}f}"
    return mean if low is None else f"{mean} ({low:+.{digits}f} to {high:+.{digits}f})"


def format_mean_gain(by_scene: Sequence[Sequence[float]]) -> str:
    """Format the mean of scenes that count alike, with an interval that resamples their views."""
    generator = np.random.default_rng(0)
    means = []
    for values in map(np.asarray, by_scene):
        chosen = generator.integers(0, len(values), (10_000, len(values)))
        means.append(values[chosen].mean(axis=1))
    low, high = np.quantile(np.mean(means, axis=0), [0.025, 0.975])
    return f"{np.mean([np.mean(v) for v in by_scene]):+.2f} ({low:+.2f} to {high:+.2f})"


def pair(
    results: Results, stages: Sequence[str], split: str, metric: str = "psnr", digits: int = 2
) -> str:
    """Format the scores of stages beside each other."""
    scores = (score(results, stage, split, metric) for stage in stages)
    return " / ".join("-" if value is None else f"{value:.{digits}f}" for value in scores)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown under its title."""
    print(f"{title}\n\n{markdown(Table(title, header, rows))}", flush=True)
