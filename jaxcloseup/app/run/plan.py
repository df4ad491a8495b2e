"""The parts of a run in their order, and how long they take relative to each other."""

from collections.abc import Sequence

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.corrected_poses import corrects_poses
from jaxcloseup.photos.scene import Scene


# Seconds of a step, or of a whole part, of a default run of `table` on two cores.
_STEP = {
    "coarse_baseline": 0.014,
    "baseline": 0.03,
    "control": 0.045,
    "closeup": 0.13,
    "test_time_control": 0.05,
    "test_time": 0.09,
}
_PIXEL = 6e-7  # seconds that each pixel adds to a step that renders whole photographs
_PART = {
    "stereo": 20,
    "poses": 5,
    "refine_baseline": 9,
    "depths": 27,
    "gate": 3,
    "closeup_labels": 30,
    "detail": 20,
    "test_time_labels": 2,
    "audit": 5,
    "dolly": 11,
    "report": 6,
    "baseline_evaluation": 8,
    "detail_evaluation": 20,
}
_EVALUATION = 7  # seconds of any other
_RAYS = 8  # times as long for images of a field that renders single rays
_WORDS = {
    "stereo": "matching photographs",
    "poses": "moving cameras to where their photographs fit",
    "depths": "rendering depths of the photographs, and what is scored",
    "gate": "comparing labels with left-out photographs",
    "audit": "comparing labels with the truth",
    "detail": "making the detail of the photographs",
    "dolly": "rendering a dolly",
    "report": "writing the report",
}


def plan_run(preset: Preset, scene: Scene, to_run: Sequence[str]) -> dict[str, float]:
    """Return typical seconds of the parts of a run by name, in order."""
    method = METHODS[preset.method]
    steps = {"baseline": preset.baseline_steps}
    parts = ["stereo"] if preset.stereo is not None and preset.stereo.pixels else []
    if preset.coarse is not None:
        steps["coarse_baseline"] = preset.coarse.steps
        moved = ["poses"] if corrects_poses(preset, scene) else []
        parts += ["coarse_baseline", *moved, "refine_baseline"]
    parts += ["baseline", "depths", "baseline_evaluation", "gate"]
    for stage in ("control", "closeup"):
        steps[stage] = preset.closeup_steps
    if "control" in to_run:
        parts += ["control", "control_evaluation"]
    if "closeup" in to_run:
        parts += ["closeup_labels"] if preset.labels.label == "residual" else []
        parts += ["closeup", "closeup_evaluation"]
    parts += ["detail", "detail_evaluation"] if "detail" in to_run else []
    if "test_time" in to_run and scene.test is not None:
        targets = method.target_steps(preset.field, len(scene.test))
        steps |= dict.fromkeys(("test_time", "test_time_control"), targets)
        parts += ["test_time_labels"]
        for stage in ("test_time_control",) * ("control" in to_run) + ("test_time",):
            parts += [stage, f"{stage}_evaluation"]
    parts += ["audit"] + ["dolly"] * (scene.test is not None) + ["report"]
    slower = _RAYS if method.renders_pixels else 1
    whole = preset.windows is None and not method.renders_pixels
    pixels = scene.train.cameras.height * scene.train.cameras.width if whole else 0

    def typical(name: str) -> float:
        if name not in steps:
            return (1 if name == "stereo" else slower) * _PART.get(name, _EVALUATION)
        images = 2 if name in ("closeup", "test_time") else 1  # of a step
        return (_STEP[name] + images * pixels * _PIXEL) * steps[name]

    return {name: typical(name) for name in parts}


def in_words(part: str) -> str:
    """Return in words what a part of a run does."""
    if part.endswith("_evaluation"):
        return f"scoring {part.removesuffix('_evaluation')}"
    if part.endswith("_labels"):
        return f"making labels for {part.removesuffix('_labels')}"
    if part.startswith("refine_"):
        return "adding surfels where photographs show more"
    return _WORDS.get(part, part)
