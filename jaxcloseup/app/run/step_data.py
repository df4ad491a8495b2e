"""The kinds of training steps: each record holds what its step learns from, and calls that step."""

from typing import Any

import jax
from flax import struct

from jaxcloseup.labels.make import LabelSources, PseudoSettings
from jaxcloseup.photos.views import Views
from jaxcloseup.photos.windows import Windows
from jaxcloseup.training.state import Metrics, TrainState
from jaxcloseup.training.steps import closeup_step, labeled_step, train_step


@struct.dataclass
class TrainData:
    """Photographs alone, for `train_step`."""

    views: Views | Windows  # training photographs, or windows of finer ones
    lr_scale: jax.Array | None = None  # `[]` factor on the learning rates; None: 1

    def step(self, state: TrainState, **static: Any) -> tuple[TrainState, Metrics]:
        """Take one step; `static` are the static arguments of `train_step`."""
        return train_step(state, self.views, self.lr_scale, **static)


@struct.dataclass
class CloseupData:
    """Photographs and random close-ups that each step labels anew, for `closeup_step`."""

    views: Views | Windows  # training photographs, or windows of finer ones
    sources: LabelSources  # what labels are made from
    settings: PseudoSettings  # how close-ups are drawn and labeled

    def step(self, state: TrainState, **static: Any) -> tuple[TrainState, Metrics]:
        """Take one step; `static` are the static arguments of `closeup_step`."""
        return closeup_step(state, self.views, self.sources, self.settings, **static)


@struct.dataclass
class LabeledData:
    """Photographs and views that were labeled once, such as target views, for `labeled_step`."""

    views: Views | Windows  # training photographs, or windows of finer ones
    labels: Views | Windows  # the labeled views, or windows of them
    settings: PseudoSettings  # the weight of labels and the learning rates

    def step(self, state: TrainState, **static: Any) -> tuple[TrainState, Metrics]:
        """Take one step; `static` are the static arguments of `labeled_step`."""
        return labeled_step(state, self.views, self.labels, self.settings, **static)


@struct.dataclass
class ArmsData:
    """What all arms of a sweep learn from together, as `run_arms` takes it."""

    views: Views | Windows  # training photographs, which all arms share
    sources: LabelSources  # as in `CloseupData`; depths and blocks have a leading axis of arms
    settings: PseudoSettings  # as in `CloseupData`, with a leading axis of arms


StepData = TrainData | CloseupData | LabeledData
