"""The table of density controls: a function for each config."""

from collections.abc import Callable, Hashable

import jax

from jaxcloseup.fields.splats.adaptive import adaptive_control
from jaxcloseup.fields.splats.config import AdaptiveConfig, McmcConfig
from jaxcloseup.fields.splats.control import DensityControl
from jaxcloseup.fields.splats.mcmc import mcmc_control


__all__ = ["DensityControl", "density_control"]

# To add a scheme, write a module like `mcmc` and add its config and its function here.
_CONTROLS: dict[type, Callable[..., DensityControl]] = {
    McmcConfig: mcmc_control,
    AdaptiveConfig: adaptive_control,
}


def density_control(
    config: Hashable | None, *, extent: float, means_lr: Callable[[jax.Array], jax.Array]
) -> DensityControl:
    """Return the density control of a config; None never changes the number of surfels.

    Args:
      config: None, a `McmcConfig` or an `AdaptiveConfig`; static.
      extent: size of the capture in world units.
      means_lr: `(step []) -> []`, the learning rate of the means in world units.

    Raises:
      TypeError: no density control has such a config.
    """
    if config is None:
        return DensityControl()
    if type(config) not in _CONTROLS:
        known = ", ".join(kind.__name__ for kind in _CONTROLS)
        raise TypeError(
            f"SurfelConfig.density must be None or one of {known}, not {type(config).__name__}"
        )
    return _CONTROLS[type(config)](config, extent=extent, means_lr=means_lr)
