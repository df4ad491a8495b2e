"""Names of stages and arms that flags accept; importing them imports no JAX."""

STAGES = ("baseline", "control", "closeup", "detail", "test_time")
ARMS = ("baseline", "control", "labels", "mask", "diverse", "oracle", "resolved", "test_time")
