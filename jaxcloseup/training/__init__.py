"""Training steps for any radiance field."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "config": "TrainConfig",
        "steps": (
            "TrainState init_state train_step pseudo_step closeup_step "
            "labeled_step run_steps render_depths"
        ),
        "loss": "judge rendered_loss",
        "sampling": (
            "DrawKeys draw_keys sample_batch sample_labels CloseupDraw sample_closeup "
            "in_a_loop in_threads over_devices"
        ),
    },
)
