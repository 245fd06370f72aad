import pytest
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.scene.camera import MODELS, Lens, make_lens, panorama_lens


def test_a_resized_image_keeps_its_rays_and_its_distortion():
    lens = Lens("OPENCV", 600, 340, (300.0, 310.0, 299.0, 171.0, 0.1, -0.2, 0.001, 0.002))
    half = lens.resized(300, 170)
    assert (half.width, half.height) == (300, 170)
    assert half.params == (150.0, 155.0, 149.5, 85.5, 0.1, -0.2, 0.001, 0.002)
    assert lens.resized(300, 340).params[:4] == (150.0, 310.0, 149.5, 171.0)


def test_a_single_focal_length_takes_the_mean_of_both_scales():
    assert Lens("SIMPLE_RADIAL", 100, 50, (80.0, 50.0, 25.0, 0.3)).resized(50, 26).params == (
        pytest.approx(80 * 0.51), 25.0, 13.0, 0.3)


def test_an_unknown_model_and_a_wrong_number_of_parameters_are_refused():
    with raises(ValueError, "FISH"):
        Lens("FISH", 4, 4, ())
    with raises(ValueError, 4, 3):
        Lens("PINHOLE", 4, 4, (1.0, 2.0, 2.0))


def test_every_model_can_be_resized():
    for model, (_, count) in MODELS.items():
        assert len(Lens(model, 8, 6, (1.0,) * count).resized(4, 3).params) == count


def test_a_panorama_has_its_size_alone():
    lens = panorama_lens(1536, 768)
    assert lens.is_panorama
    assert lens.params == (1536.0, 768.0)
    assert lens.resized(1024, 512) == panorama_lens(1024, 512)
    with raises(FormatError, "panorama") as error:
        make_lens("EQUIRECTANGULAR", 1536, 768, (1536, 768), "cameras.txt")
    assert "as photos" in error.value.hint
