"""Make a capture with poses from photographs or a video, by structure from motion with COLMAP.

    python -m experiments.process --images=photographs --output_dir=capture
    python -m experiments.process --video=walk.mp4 --count=100 --output_dir=capture

The capture, a COLMAP model and its photographs, is what `experiments.run --scene=capture` reads.
The same command continues a process that was cut off after its last finished stage. The same
photographs give the same poses on the same machine.
"""

from absl import flags

from jaxcloseup.app.cli.start import job
from jaxcloseup.app.process.choices import COUNT, FEWEST, LENSES, MOST_EXHAUSTIVE, PAIRINGS


flags.declare_key_flag("output_dir")
flags.DEFINE_string("images", None, "folder of photographs")
flags.DEFINE_string("video", None, "a video, instead of photographs")
flags.DEFINE_integer(
    "count",
    None,
    f"largest number of frames to take from the video; default: {COUNT}",
    lower_bound=FEWEST,
)
flags.DEFINE_enum(
    "lens",
    "perspective",
    list(LENSES),
    "kind of lens; its distortion is measured, and undone when the capture is read",
)
flags.DEFINE_enum(
    "pairs",
    "auto",
    ["auto", *PAIRINGS],
    "which photographs are matched: exhaustive, all; sequential, neighbors and similar ones; "
    "retrieval, similar ones; auto, sequential for a video, exhaustive for up to "
    f"{MOST_EXHAUSTIVE} photographs, else retrieval",
)


def main(_: list[str]) -> None:
    """Make the capture that the flags describe."""
    job("process").main()
