import pytest

from recon_cli.capture.picture_names import picture_kind


@pytest.mark.parametrize(("name", "kind"), [
    ("depth", "depth maps"), ("rtabmap_depth", "depth maps"), ("depth_00001", "depth maps"),
    ("IMG_1_mask", "masks"), ("Masks", "masks"), ("operator_masks", "masks"),
    ("confidence", "confidence maps"), ("thumbnails", "small copies"),
    ("normal-maps", "normal maps"),
    ("images", ""), ("depthless", ""), ("unmasked", ""), ("IMG_0001", ""), ("conference", "")])
def test_names_tell_what_pictures_show(name, kind):
    assert picture_kind(name) == kind
