import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from recon_cli.capture.xmp import is_panorama, read_xmp

ELEMENT = b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
ATTRIBUTE = b'<rdf:Description GPano:ProjectionType="equirectangular" />'
CROPPED = (b'<r GPano:ProjectionType="cylindrical" GPano:CroppedAreaImageWidthPixels="9000" '
           b'GPano:CroppedAreaImageHeightPixels="2000"/>')


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
def test_xmp_is_read_from_every_format(tmp_path, name):
    options = {"tiffinfo": {700: ELEMENT}} if name == "a.tif" else {"xmp": ELEMENT}
    if name == "a.png":
        options = {"pnginfo": PngInfo()}
        options["pnginfo"].add_itxt("XML:com.adobe.xmp", ELEMENT.decode())
    Image.new("RGB", (8, 4)).save(tmp_path / name, **options)
    with Image.open(tmp_path / name) as image:
        assert ELEMENT in read_xmp(image)


@pytest.mark.parametrize(("xmp", "width", "height", "panorama"), [
    (ELEMENT, 4000, 2000, True), (ATTRIBUTE, 1920, 960, True), (b"", 4000, 2000, False),
    (ELEMENT, 1024, 1024, False),  # a face that was cut from a panorama, whose XMP it kept
    (CROPPED, 4500, 1000, True), (CROPPED, 4000, 3000, False),
    (b'<r GPano:ProjectionType="rectilinear"/>', 4000, 2000, False),
    (ELEMENT + b'<r GPano:CroppedAreaImageWidthPixels="0" GPano:CroppedAreaImageHeightPixels="0"/>',
     4000, 2000, True)])
def test_a_panorama_is_one_by_its_projection_and_its_shape(xmp, width, height, panorama):
    assert is_panorama(xmp, width, height) is panorama
