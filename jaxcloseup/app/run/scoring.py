"""The views to score on, and the scores, renders and exports of a run's stages."""

import functools
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxcloseup.app.run.exposed import how_taken, render_exposed
from jaxcloseup.app.run.labels import LabelStart
from jaxcloseup.app.run.loop import Training
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.splat_files import write_splats
from jaxcloseup.app.run.timers import timed
from jaxcloseup.app.score.ladder import describe_ladder, ladder_targets
from jaxcloseup.app.score.metrics_text import REDUCED, describe_split
from jaxcloseup.app.score.renders import write_renders
from jaxcloseup.app.score.scores import Perceptual, RenderTaken, evaluate
from jaxcloseup.app.score.targets import Target, exact_depths, score_divisor, targets_by_split
from jaxcloseup.training.state import TrainState


class HeldOut(NamedTuple):
    """The views that stages are scored on."""

    targets: Mapping[str, Sequence[Target]]  # held-out views by split
    # Views of the zoom ladder by rung; none where it was not asked for, or the exact scene is not
    # known.
    ladder: Mapping[str, Sequence[Target]]
    exact: jax.Array | None  # `[V, H, W]` exact depths of the training views, or None

    @property
    def all(self) -> dict[str, Sequence[Target]]:
        """Return targets and ladder together."""
        return {**self.targets, **self.ladder}

    def reduced(self, split: str) -> Sequence[Target]:
        """Return the views of a split at the size of training; none if the split has none."""
        return self.targets.get(split + REDUCED, self.targets.get(split, ()))


def hold_out(programs: Programs, start: LabelStart, *, ladder: bool = True) -> HeldOut:
    """Return the views to score on, with or without the zoom ladder, which takes long to draw.

    Coverage is that of `start`, so that all stages are scored alike.
    """
    scene, render = programs.scene, functools.partial(programs.render, start.state)
    exact = exact_depths(scene, scene.train.cameras) if scene.surface else None
    divisor = score_divisor(scene, programs.preset.score_width)
    targets = {
        split: [
            view._replace(taken=how_taken(programs, split.removesuffix(REDUCED), view.name))
            for view in views
        ]
        for split, views in targets_by_split(
            scene, start.sources.depths, exact, render, divisor=divisor
        ).items()
    }
    rungs = ladder_targets(scene, exact) if ladder and exact is not None else {}
    return HeldOut(targets, rungs, exact)


class Scorer:
    """Scores stages on the held-out views, and writes their renders and exports.

    Attributes:
      held_out: the views.
      scores: by stage and split.
      images: renders, uint8 `[H, W, 3]`, by stage and split, then by the view's name; without the
        zoom ladder's.
    """

    def __init__(
        self,
        training: Training,
        held_out: HeldOut,
        output_dir: pathlib.Path,
        perceptual: Perceptual,
    ) -> None:
        """Score nothing yet."""
        self._training, self.held_out = training, held_out
        self._folder, self._perceptual = output_dir, perceptual
        self.scores: dict[str, dict[str, Any]] = {}
        self.images: dict[tuple[str, str], Mapping[str, np.ndarray]] = {}

    def score(self, stage: str, state: TrainState, render: RenderTaken | None = None) -> None:
        """Render, score and keep one stage.

        By default the state renders, and is exported too.
        """
        programs = self._training.programs
        if render is None:
            render = functools.partial(render_exposed, programs, state)
            write_splats(self._folder / "splats", stage, programs, state)
        with timed(self._training.seconds, f"{stage}_evaluation"):
            scores: dict[str, Any] = {}
            for split, views in self.held_out.all.items():
                scores[split], seen = evaluate(render, views, self._perceptual)
                write_renders(self._folder / "renders" / stage / split, seen, programs.scene)
                if split in self.held_out.targets:
                    self.images[stage, split] = {
                        name: np.asarray(rendering.rgb) for name, rendering in seen.items()
                    }
            self._keep(stage, scores)

    def repeat(self, stage: str, of: str) -> None:
        """Keep a stage that ended with the state of another, without rendering it again."""
        renders, splats = self._folder / "renders", self._folder / "splats"
        with timed(self._training.seconds, f"{stage}_evaluation"):
            shutil.copytree(renders / of, renders / stage, dirs_exist_ok=True)
            if (exported := splats / f"{of}.ply").exists():
                shutil.copyfile(exported, splats / f"{stage}.ply")
            for split in self.held_out.targets:
                self.images[stage, split] = self.images[of, split]
            self._keep(stage, self.scores[of])

    def _keep(self, stage: str, scores: dict[str, Any]) -> None:
        """Keep, log and print the scores of a stage whose images are there."""
        self.scores[stage] = scores
        shown = {}
        for split in self.held_out.targets:
            name, first = next(iter(self.images[stage, split].items()))
            shown[f"{split}/{name}"] = first
            print(f"{stage:>9} {split}: {describe_split(scores[split])}", flush=True)
        if self._training.log is not None:
            self._training.log.evaluated(stage, scores, shown)
        if self.held_out.ladder:
            print(f"{stage:>9} {describe_ladder(scores)}", flush=True)
