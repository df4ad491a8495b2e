"""Training steps for any radiance field."""

from jaxcloseup.lazy import lazy_names


__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "arms": "arm_state run_arms stack_arms stack_states",
        "config": "TrainConfig",
        "loss": "judge rendered_loss",
        "parallel": "in_a_loop in_threads over_devices",
        "sampling": ("CloseupDraw DrawKeys draw_keys sample_batch sample_closeup sample_labels"),
        "state": "TrainState init_state",
        "steps": "closeup_step labeled_step pseudo_step run_steps train_step",
    },
)
