"""Read from a photograph's EXIF how its camera exposed it."""

import math
import pathlib
import warnings

import PIL.Image
from PIL.ExifTags import IFD, Base

from jaxcloseup.photos.stated_exposures import StatedExposure


def read_exposure(path: pathlib.Path) -> StatedExposure | None:
    """Return camera and exposure of a photograph; None where its file does not say them.

    Files without f-number, as of a fixed aperture, count as f/1 and as those of another camera.
    """
    try:
        with warnings.catch_warnings(), PIL.Image.open(path) as image:
            warnings.simplefilter("ignore")  # Pillow warns of damaged EXIF and of many pixels
            exif = image.getexif()
            detail = exif.get_ifd(IFD.Exif)
            seconds = float(detail[Base.ExposureTime])
            sensitivity = detail[Base.ISOSpeedRatings]
            iso = float(sensitivity[0] if isinstance(sensitivity, tuple) else sensitivity)
            aperture = float(detail.get(Base.FNumber, 1))
            known = "" if Base.FNumber in detail else ", f-number unknown"
            log_exposure = math.log(seconds * iso / aperture**2)
            camera = " ".join(str(exif.get(tag, "")).strip() for tag in (Base.Make, Base.Model))
            camera += known
    except Exception:  # no EXIF, damaged EXIF, or numbers without a logarithm
        return None
    return StatedExposure(camera, log_exposure) if math.isfinite(log_exposure) else None
