"""A trial method: everything has one trained color, at the depth of the scene's middle."""

import dataclasses

from jaxcloseup.app.methods.method import Method, Preset
from jaxcloseup.labels.config import LabelConfig
from jaxcloseup.setting import setting
from jaxcloseup.training.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class ConstantConfig:
    lr: float = setting(0.1, "how fast the color is learned", high=2)


def make_field(config, scene, growth):
    import jax
    import jax.numpy as jnp

    from jaxcloseup.fields.contract import RadianceField, Rendering

    def render(params, buffers, camera, pixels, key):
        shape = (camera.height, camera.width) if pixels is None else pixels.shape[:-1]
        depth = jnp.full(shape, (scene.near + scene.far) / 2)
        return Rendering(jnp.broadcast_to(params, (*shape, 3)), depth, jnp.ones(shape))

    def loss(rendering, target, weight):
        squared = jnp.mean((rendering.rgb - target) ** 2, axis=-1)
        error = jnp.sum(weight * squared) / jnp.maximum(jnp.sum(weight), 1)
        return error, {"psnr": -10 * jnp.log10(error)}

    return RadianceField(lambda key, points, rgb: (jax.random.uniform(key, (3,)), ()), render, loss)


def make_optimizer(config, scene):
    import optax

    return optax.adam(config.lr)


METHOD = Method(
    help="one color for everything (Nobody et al. 2026)",
    presets={
        "quick": Preset(
            method="constant_color",
            field=ConstantConfig(),
            train=TrainConfig(num_rays=64, num_label_rays=64),
            labels=LabelConfig(),
            baseline_steps=9,
            closeup_steps=2,
        )
    },
    make_field=make_field,
    make_optimizer=make_optimizer,
    renders_pixels=True,
    target_steps=lambda config, count: 2,
)
