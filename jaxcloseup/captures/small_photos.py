"""Read photographs small and fast, for what needs no more than features."""

from jaxcloseup.captures.distortion import undistort, undistortion_map
from jaxcloseup.captures.photo import Photo, Reading, whole_size
from jaxcloseup.captures.photo_files import read_file
from jaxcloseup.captures.photo_reading import make_photo
from jaxcloseup.captures.world_frames import Frame


def read_small(frame: Frame, reading: Reading, side: int) -> Photo:
    """Read a photograph whole, with its longer side divided to about `side` pixels.

    The lens is undistorted after the photograph is reduced, which is fast, and fine for features.

    Raises:
      SceneError: the photograph or its mask cannot be read, or their sizes differ.
    """
    largest = max(whole_size(frame) or (side,))
    reading = reading._replace(downscale=max(1, round(largest / side)), zoom=1)
    picture, mask = read_file(frame.file), read_file(frame.mask) if frame.mask else None
    plain = frame._replace(distortion=None, reduced=None)
    (photo,) = make_photo(plain, False, picture, mask, reading, undistortion_map)
    if frame.distortion:
        lens = tuple(photo.intrinsics(reading.half_pixel).tolist())
        remap = undistortion_map(frame.distortion, lens, *photo.size)
        rgb, mask = undistort(photo.rgb, photo.mask, remap)
        photo = photo._replace(rgb=rgb, mask=mask)
    return photo._replace(frame=frame)
