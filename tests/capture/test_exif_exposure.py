"""The exposure of a photo by EXIF, and how the list of frames keeps it."""

import math

import numpy as np
import pytest
from PIL import ExifTags, Image

from recon_cli.capture.images import inspect_photo
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.records import LIST, Frame, FrameList, Group, read_frame_list

TAGS = ExifTags.Base


def photo(folder, values):
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update(values)
    path = folder / "a.jpg"
    Image.fromarray(np.full((12, 16, 3), 90, np.uint8)).save(path, exif=exif)
    return inspect_photo(path)


def test_exposure_is_light_by_time_sensitivity_and_aperture(tmp_path):
    found = photo(tmp_path, {TAGS.ExposureTime: 1 / 50, TAGS.ISOSpeedRatings: 400,
                             TAGS.FNumber: 2.0})
    assert found.exposure_ev == pytest.approx(math.log2(4 / 50) - 2, abs=1e-3)
    longer = photo(tmp_path, {TAGS.ExposureTime: 1 / 25, TAGS.ISOSpeedRatings: 400,
                              TAGS.FNumber: 2.0})
    assert longer.exposure_ev - found.exposure_ev == pytest.approx(1, abs=1e-3)


def test_a_lens_without_f_number_is_taken_to_keep_it(tmp_path):
    found = photo(tmp_path, {TAGS.ExposureTime: 0.5, TAGS.ISOSpeedRatings: 100})
    assert found.exposure_ev == pytest.approx(-1, abs=1e-3)


@pytest.mark.parametrize("values", [
    {}, {TAGS.ExposureTime: 0.1}, {TAGS.ISOSpeedRatings: 100},
    {TAGS.ExposureTime: 0.0, TAGS.ISOSpeedRatings: 100}])
def test_without_time_or_sensitivity_it_is_not_known(tmp_path, values):
    assert photo(tmp_path, values).exposure_ev is None


def test_the_list_of_frames_keeps_it_and_is_as_before_without(tmp_path):
    frames = (Frame("a.png", None, "a.jpg", None, held_out=False, exposure_ev=-1.5),
              Frame("b.png", None, "b.jpg", None, held_out=True))
    FrameList("photos", (Group("a", 16, 12),), frames).write(tmp_path)
    assert "exposure_ev" not in read_json(tmp_path / LIST, dict)["frames"][1]
    assert read_frame_list(tmp_path).frames == frames
