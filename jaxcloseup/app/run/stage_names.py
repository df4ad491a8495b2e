"""Names of stages and arms that flags accept; importing them imports no JAX."""

STAGES = ("baseline", "control", "closeup", "detail", "test_time")
OWN_CONTROL = "_control"  # after the name of an arm or stage, that of its own control
ARMS = ("baseline", "control", "labels", "mask", "diverse", "oracle", "resolved", "test_time")
