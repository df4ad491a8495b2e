"""Score a folder of rendered images against a folder of true images, whatever made them.

    jaxcloseup evaluate --renders=renders/rgb --truth=capture/test --output=metrics.json

The program pairs images by file name, ignoring the ending. It computes the image metrics of
jaxcloseup run on 8-bit colors, and writes the means over images and the metrics of each image.
"""

import pathlib

from absl import flags

from jaxcloseup.app.cli.flags import COMPUTERS
from jaxcloseup.app.cli.output_folder import check_writable
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
share(COMPUTERS)
flags.DEFINE_string("renders", None, "folder of rendered images to score")
flags.DEFINE_string("truth", None, "folder of true images with the same names")
flags.DEFINE_string(
    "masks", None, "folder of masks, white where pixels count; default: all pixels count"
)
flags.DEFINE_string("output", "metrics.json", "JSON file to write; it must not exist yet")


def main(_: list[str]) -> None:
    """Score the folders that the flags name."""
    with loading():
        from rich.console import Console
        from rich.table import Table

        from jaxcloseup.app import progress
        from jaxcloseup.app.score.folders import evaluate_folders
        from jaxcloseup.app.score.metrics_text import COLUMNS, format_metric
        from jaxcloseup.app.score.scores import find_perceptual
        from jaxcloseup.io.files import write_json
        from jaxcloseup.photos.scene import SceneError
    set_up()
    output = pathlib.Path(FLAGS.output)
    with in_one_sentence("evaluate", SceneError, OSError, ValueError):
        if output.exists():
            raise ValueError(f"--output={output} already exists: name a new file, or remove it")
        check_writable(output, "output")
        perceptual = find_perceptual(FLAGS.lpips_weights)
        with progress.showing():
            results = evaluate_folders(FLAGS.renders, FLAGS.truth, FLAGS.masks, perceptual)
        write_json(output, results)
    table = Table(f"{len(results['views'])} images", "mean")
    for key, name in COLUMNS.items():
        if key in results:
            table.add_row(name, format_metric(key, results[key]))
    Console().print(table)
    for key in ("lpips_vgg", "lpips_alex"):
        if results[key] is None:
            print(f"no {key}: {results[f'{key}_reason']}")
    print(f"metrics: {output}")
