"""Write a run's splats and cameras as files that other programs read.

    jaxcloseup export --run=outputs/table/surfels/...
    jaxcloseup export --run=... --files=spz,cameras

Splats are written as plain PLY, as compressed PLY (PlayCanvas, SuperSplat), as SPZ, and as GLB
with KHR_gaussian_splatting; cameras as a COLMAP model and as transforms.json (nerfstudio,
Instant-NGP), beside the photographs without distortion. All are in the capture's coordinates; in
SPZ and GLB these are turned by 180 degrees around x, so that y is up.
"""

from absl import flags

from jaxcloseup.app.cli.flags import OUTPUT, STORED_RUN, run_from_flags
from jaxcloseup.app.cli.output_folder import check_unused, dated, prepare_to_stop
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
share(STORED_RUN, OUTPUT)
_SPLATS = {
    "ply": "splats.ply",
    "compressed": "splats.compressed.ply",
    "spz": "splats.spz",
    "glb": "splats.glb",
}
_CAMERAS = "cameras"
flags.DEFINE_list(
    "files",
    None,
    f"what to write, of {', '.join(_SPLATS)} and {_CAMERAS}, which come with their photographs; "
    "default: the splats, or the cameras of a field without",
)


def main(_: list[str]) -> None:
    """Write the files that the flags name."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.methods.registry import METHODS
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.store.stored_run import RunError, load_run_scene
        from jaxcloseup.app.view.exporting import export_cameras, export_splats
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    expected = (RunError, SceneError, CheckpointError, TrainingError, ValueError, OSError)
    with in_one_sentence("export", *expected), progress.showing():
        asked = _asked()
        record, stage = run_from_flags()
        if not asked:
            has_splats = METHODS[record.preset.method].splats is not None
            asked = list(_SPLATS) if has_splats else [_CAMERAS]
        output_dir = check_unused(FLAGS.output_dir or dated(record.folder / "exports"))
        prepare_to_stop(output_dir)
        scene = load_run_scene(record, FLAGS.data)
        if splats := [_SPLATS[name] for name in asked if name in _SPLATS]:
            export_splats(output_dir, record, scene, stage, splats)
        if _CAMERAS in asked:
            export_cameras(output_dir, scene)


def _asked() -> list[str]:
    every = [*_SPLATS, _CAMERAS]
    if FLAGS.files is None:
        return []
    if not FLAGS.files or any(name not in every for name in FLAGS.files):
        said = ",".join(FLAGS.files)
        raise ValueError(f"--files={said} must be some of {', '.join(every)}")
    return list(dict.fromkeys(FLAGS.files))
