"""Scores of a sweep's arms on the held-out views."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.exposed import render_exposed
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.scoring import HeldOut
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.app.score.scores import Perceptual, evaluate
from jaxcloseup.app.score.targets import Target
from jaxcloseup.app.sweep.named_arms import Arm
from jaxcloseup.training.state import TrainState


SHOWN = 2  # views of a split


class SweepOutcome(NamedTuple):
    """The results of a sweep on one scene."""

    # For each arm, then seed, `skipped` steps and the metrics of each split in `splits`.
    scores: dict[str, dict[str, Any]]
    shown: dict[str, Sequence[Target]]  # the first held-out views of each split
    # The first seed's renders of these, by arm and split, then by name.
    images: dict[tuple[str, str], dict[str, np.ndarray]]


class ArmScorer:
    """Scores arms on the held-out views.

    Attributes:
      programs: what is compiled.
      held_out: the views.
      scores: see `SweepOutcome`.
    """

    def __init__(
        self, programs: Programs, held_out: HeldOut, arms: Sequence[Arm], perceptual: Perceptual
    ) -> None:
        """Score nothing yet."""
        self.programs, self.held_out, self._perceptual = programs, held_out, perceptual
        targets = held_out.targets
        self._shown = {split: targets[split][:SHOWN] for split in SPLIT_TITLES if split in targets}
        self.scores: dict[str, dict[str, Any]] = {arm.name: {} for arm in arms}
        self._images: dict[tuple[str, str], dict[str, np.ndarray]] = {}

    def score(self, arm: str, seed: int, state: TrainState, skipped: int) -> None:
        """Render and score one arm of one seed."""
        render, splits = functools.partial(render_exposed, self.programs, state), {}
        with progress.part(f"{arm}_{seed}_evaluation"):
            for split, targets in self.held_out.all.items():
                splits[split], seen = evaluate(render, targets, self._perceptual)
                if seed == 0 and split in self._shown:
                    self._images[arm, split] = {
                        view.name: np.asarray(seen[view.name].rgb) for view in self._shown[split]
                    }
        self.scores.setdefault(arm, {})[str(seed)] = {"skipped": skipped, "splits": splits}

    def outcome(self) -> SweepOutcome:
        """Return all scores, with arms in the order in which the user named them."""
        order = {arm: i for i, arm in enumerate(self.scores)}
        pairs = sorted(self._images.items(), key=lambda pair: order[pair[0][0]])
        return SweepOutcome(self.scores, self._shown, dict(pairs))
