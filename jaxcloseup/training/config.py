"""How much a training step looks at; no JAX is imported."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How much one step looks at.

    Attributes:
      num_rays: pixels of photographs in a step; None takes one whole photograph.
      num_label_rays: labeled pixels in a step; None takes the whole virtual image.
      label_rule: a name in `LABEL_RULES`. Whole virtual images always add both losses.
      num_windows: how often a step draws all this: photographs or their windows, and labels. The
        mean gradient of the draws moves the parameters.
    """

    num_rays: int | None = 1024
    num_label_rays: int | None = 1024
    label_rule: str = "paper"
    num_windows: int = 1
