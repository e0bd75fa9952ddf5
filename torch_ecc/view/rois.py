"""Files of ImageJ's regions as marks: one .roi, or the .zip of several that its ROI Manager saves."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from torch_ecc.view.marks import Mark, at_pixel_centres

LARGEST = 1 << 20  # bytes of one region
MOST = 500  # regions of a file


def read_rois(name: str, data: bytes) -> list[Mark]:
    """The marks of a file with these bytes, called ``name``. ValueError if it holds no area."""
    if not data.startswith(b"PK"):
        return [_mark(name, data)]
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            inside = [each for each in archive.infolist() if each.filename.lower().endswith(".roi")]
            if not 0 < len(inside) <= MOST or any(each.file_size > LARGEST for each in inside):
                raise ValueError(f"{name}: expected an archive of 1 to {MOST} .roi files of at most 1 MiB each")
            return [_mark(each.filename, archive.read(each)) for each in inside]
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(f"{name} is no archive that can be read ({error})") from error


def _mark(name: str, data: bytes) -> Mark:
    """A rectangle as a box, any other area as its outline."""
    try:
        from roifile import ROI_TYPE, ImagejRoi
    except ModuleNotFoundError as error:
        raise ValueError(f"{name}: .roi files need roifile: pip install 'torch-ecc[view]'") from error
    areas = ROI_TYPE.RECT, ROI_TYPE.OVAL, ROI_TYPE.POLYGON, ROI_TYPE.FREEHAND, ROI_TYPE.TRACED
    try:
        roi = ImagejRoi.frombytes(data)
        corners = np.asarray(roi.coordinates(), np.float64)
    except Exception as error:  # whatever it stumbles over in bytes that are no region
        raise ValueError(f"{name} is no region of ImageJ's ({error})") from error
    if roi.roitype not in areas or roi.composite or len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"{name} is no rectangle, oval or polygon, but {roi.roitype.name.lower()}")
    if roi.roitype == ROI_TYPE.RECT and roi.subpixel_coordinates is None and not roi.subpixelrect:
        (x, y), (w, h) = (roi.left, roi.top), (roi.right - roi.left, roi.bottom - roi.top)
        return {"x": x + (w - 1) / 2, "y": y + (h - 1) / 2, "w": w, "h": h}
    return at_pixel_centres(corners.tolist())
