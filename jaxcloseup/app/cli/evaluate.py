"""Score a folder of rendered images against a folder of true images, whatever made them.

    python -m experiments.evaluate --renders=renders/rgb --truth=capture/test --output=metrics.json

The program pairs images by file name, ignoring the ending. It computes the image metrics of
experiments.run on 8-bit colors, and writes the means over images and the metrics of each image.
"""

from absl import flags

from jaxcloseup.app.cli.start import job


for _name in ("lpips_weights", "compilation_cache"):
    flags.declare_key_flag(_name)
flags.DEFINE_string("renders", None, "folder of rendered images to score")
flags.DEFINE_string("truth", None, "folder of true images with the same names")
flags.DEFINE_string(
    "masks", None, "folder of masks, white where pixels count; default: all pixels count"
)
flags.DEFINE_string("output", "metrics.json", "JSON file to write; it must not exist yet")


def main(_: list[str]) -> None:
    """Score the folders that the flags name."""
    job("evaluate").main()
