import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from recon_cli.capture.xmp import PanoramaArea, is_panorama, panorama_area, read_xmp

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


def test_the_area_of_a_cropped_panorama_is_read():
    xmp = (b'<r GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="6000" '
           b'GPano:CroppedAreaImageHeightPixels="2000" GPano:FullPanoWidthPixels="8000" '
           b'GPano:FullPanoHeightPixels="4000" GPano:CroppedAreaLeftPixels="1000" '
           b'GPano:CroppedAreaTopPixels="500"/>')
    assert panorama_area(xmp, 6000, 2000) == PanoramaArea(1000, 500, 6000, 2000, 8000, 4000)
    assert panorama_area(xmp, 3000, 1000) == PanoramaArea(500, 250, 3000, 1000, 4000, 2000)
    assert panorama_area(xmp, 3000, 3000) is None


def test_a_panorama_without_sizes_is_that_of_the_sphere():
    area = panorama_area(ELEMENT, 4000, 2000)
    assert area == PanoramaArea(0, 0, 4000, 2000, 4000, 2000)
    assert area.is_full
    assert panorama_area(CROPPED, 4500, 1000) is None  # a cylinder
