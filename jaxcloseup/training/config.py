"""How much a training step looks at; no JAX is imported."""

import dataclasses

from jaxcloseup.setting import setting


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How much one step looks at.

    Raises:
      ValueError: whole photographs and single labeled pixels would share a mean.
    """

    num_rays: int | None = setting(
        1024, "pixels of photographs in a step; none takes one whole photograph", low=1
    )
    num_label_rays: int | None = setting(
        1024, "labeled pixels in a step; none takes the whole virtual image", low=1
    )
    label_rule: str = setting(
        "paper",
        "how labels are made and their loss joins the photographs', see `LABEL_RULES`; whole "
        "virtual images always add both losses",
        choices=("paper", "pooled", "released"),
    )
    num_windows: int = setting(
        1,
        "draws of a step, each of photographs or their windows and of labels; the mean gradient "
        "of the draws moves the parameters",
        low=1,
    )

    def __post_init__(self) -> None:
        """Check that both losses can be joined."""
        single = self.num_rays is not None or self.num_label_rays is None
        if self.label_rule != "paper" and not single:
            raise ValueError(
                f"label_rule {self.label_rule} pools single pixels: give num_rays, or set "
                "num_label_rays=none"
            )
