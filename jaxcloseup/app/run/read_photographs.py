"""What is made of a scene's photographs before any step: pyramids, and depth by stereo."""

import dataclasses

from jaxcloseup.app import progress
from jaxcloseup.app.methods.method import Preset, StereoTraining
from jaxcloseup.app.run.measured_exposures import measure_exposures
from jaxcloseup.app.run.photograph_sizes import finest_read
from jaxcloseup.app.run.stereo_depths import (
    StereoDepths,
    can_match,
    match_photographs,
    matched_divisor,
)
from jaxcloseup.io.memory import give_back_memory
from jaxcloseup.photos.exposures import Exposures
from jaxcloseup.photos.pyramids import Pyramid, scene_pyramid
from jaxcloseup.photos.scene import Scene, SceneError


class ReadPhotographs:
    """A scene's photographs as programs read them, each kind once."""

    def __init__(self, scene: Scene) -> None:
        """Read nothing yet."""
        self._scene = scene
        self._pyramids: dict[int, tuple[Pyramid, int]] = {}
        self._matched: dict[int, StereoDepths | None] = {}
        self._exposures: dict[bool, Exposures | None] = {}

    def pyramid(self, finest: int = 1) -> tuple[Pyramid, int]:
        """Return the training photographs from the finest size that fits, and its divisor.

        `finest` is the smallest divisor of their size.
        """
        if finest not in self._pyramids:
            scene = self._scene
            with progress.saying("reading photographs at their own size, or drawing them"):
                try:
                    read = scene_pyramid(scene, finest=finest)
                except SceneError as error:  # such as full-size photographs that were not kept
                    print(f"only the photographs reduced for training are read: {error}")
                    read = scene_pyramid(dataclasses.replace(scene, photographs_at=None))
            self._pyramids[finest] = read
            give_back_memory()  # of the photographs
        return self._pyramids[finest]

    def stereo(self, preset: Preset) -> StereoDepths | None:
        """Return depth of the photographs by stereo; None without, or with too few to confirm."""
        config = preset.stereo
        if config is None or not config.pixels:
            return None
        if config.pixels not in self._matched:
            self._matched[config.pixels] = self._match(preset, config)
        return self._matched[config.pixels]

    def exposures(self, preset: Preset) -> Exposures | None:
        """Return how exposures of the photographs differ; None where they agree, or are unknown."""
        wanted = preset.stereo is not None and preset.stereo.exposures
        if wanted not in self._exposures:
            stereo = self.stereo(preset) if wanted else None
            self._exposures[wanted] = (
                None if stereo is None else measure_exposures(stereo, self._scene)
            )
        return self._exposures[wanted]

    def keep_exposures(self, exposures: Exposures | None) -> None:
        """Take exposures that were measured before, such as those of a stored run."""
        self._exposures = dict.fromkeys((False, True), exposures)

    def moved(self, scene: Scene) -> "ReadPhotographs":
        """Return the same for a scene whose photographs have other poses; depth is matched anew."""
        moved = ReadPhotographs(scene)
        moved._pyramids, moved._exposures = self._pyramids, self._exposures
        return moved

    def _match(self, preset: Preset, config: StereoTraining) -> StereoDepths | None:
        if not can_match(self._scene):
            return None
        scene, finest = self._scene, finest_read(preset, self._scene)
        if scene.surface is not None:  # drawing costs by the pixel, reading by the file
            finest = matched_divisor(scene, config, finest)
        pyramid, _ = self.pyramid(finest)
        return match_photographs(scene, pyramid, config)
