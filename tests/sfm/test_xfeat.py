import cv2
import numpy as np
import pytest
import torch

from recon_cli.sfm.features import xfeat
from recon_cli.sfm.features.xfeat import (
    DESCRIPTOR_STEPS,
    Network,
    find_learned_features,
    parameter_shapes,
)


def random_weights(dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    weights = {}
    for name, shape in parameter_shapes().items():
        value = torch.randn(shape, generator=generator, dtype=torch.float64)
        if name.endswith("weight"):
            value /= np.sqrt(np.prod(shape[1:]))
        weights[name] = (value.abs() + 0.5 if name.endswith("var") else value).to(dtype)
    return weights


def textured(height=340, width=600, seed=0):
    """Rectangles of random colours, one over another: corners everywhere."""
    generator = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.uint8)
    for x, y, w, h in generator.integers([0, 0, 8, 8], [width, height, 60, 60], (400, 4)):
        cv2.rectangle(image, (x, y), (x + w, y + h), generator.integers(0, 256, 3).tolist(), -1)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def test_the_network_has_the_parameters_and_the_sizes_of_the_paper():
    assert sum(int(np.prod(shape)) for shape in parameter_shapes().values()) == 660_654
    with torch.inference_mode():
        features, logits, heat = Network(random_weights())(
            torch.rand(1, 1, 96, 160, dtype=torch.float64))
    assert features.shape == (1, 64, 12, 20)
    assert logits.shape == (1, 65, 12, 20)
    assert heat.shape == (1, 1, 12, 20)
    assert 0 <= heat.min() <= heat.max() <= 1


def test_the_network_in_float32_is_that_in_float64_but_for_rounding():
    gray = torch.rand(1, 1, 96, 160, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        fine = Network(random_weights())(gray.double())
        coarse = Network(random_weights(torch.float32))(gray)
    for exact, rounded in zip(fine, coarse, strict=True):
        # some 30 layers of sums of up to 1152 products, each within 6e-8 of its size
        torch.testing.assert_close(rounded.double(), exact, rtol=1e-3, atol=1e-4)


def test_a_shift_by_a_cell_moves_the_probabilities_of_the_keypoints_by_one():
    # The head of keypoints sees its cell of 8 x 8 pixels alone.
    gray = torch.rand(1, 1, 96, 160, generator=torch.Generator().manual_seed(2))
    network = Network(random_weights(torch.float32))
    with torch.inference_mode():
        there, moved = (network(image)[1] for image in (gray, gray.roll(8, dims=3)))
    torch.testing.assert_close(moved, there.roll(1, dims=3), rtol=1e-4, atol=1e-4)


def test_a_peak_between_pixels_is_found_by_a_parabola():
    y, x = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
    heat = torch.exp(-0.5 * ((x - 10.3) ** 2 + (y - 20.8) ** 2))
    found = xfeat._refine(heat, torch.tensor([10]), torch.tensor([21]))
    assert [float(value) for value in found] == pytest.approx([10.3, 20.8], abs=1e-3)


@pytest.mark.integration
def test_features_are_found_again_after_a_known_motion(learned_network):
    image = textured()
    motion = np.array([[0.9, -0.15, 50], [0.15, 0.9, 10]])
    middle = np.eye(3)
    middle[:2, 2] = 0.5  # OpenCV's middle of the first pixel is 0
    exact = middle @ np.vstack([motion, [0, 0, 1]]) @ np.linalg.inv(middle)
    first = find_learned_features(learned_network, image)
    second = find_learned_features(learned_network, cv2.warpAffine(image, motion, (600, 340)))
    assert len(first.xy) > 500
    similarity = first.descriptors @ second.descriptors.T
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == np.arange(len(best))
    sure = mutual & (similarity.max(1) > 0.82 * DESCRIPTOR_STEPS**2)
    assert sure.sum() > 500
    expected = (np.column_stack([first.xy, np.ones(len(best))]) @ exact.T)[:, :2]
    off = (expected - second.xy[best])[sure]
    near = np.linalg.norm(off, axis=1) < 3  # pixels
    assert near.mean() > 0.9
    assert np.abs(off[near].mean(axis=0)).max() < 0.25  # half a pixel is a wrong convention


@pytest.mark.integration
def test_features_are_the_same_bits_twice_and_with_any_number_of_threads(learned_network):
    found = []
    for threads in (1, 2, 1):
        torch.set_num_threads(threads)
        found.append(find_learned_features(learned_network, textured()))
        assert torch.get_num_threads() == threads
    for other in found[1:]:
        assert other.xy.tobytes() == found[0].xy.tobytes()
        assert other.descriptors.tobytes() == found[0].descriptors.tobytes()


@pytest.mark.integration
def test_descriptors_are_whole_numbers_whose_products_are_exact(learned_network):
    found = find_learned_features(learned_network, textured())
    assert (found.descriptors == np.rint(found.descriptors)).all()
    lengths = np.linalg.norm(found.descriptors.astype(np.float64), axis=1)
    assert lengths == pytest.approx(DESCRIPTOR_STEPS, rel=0.005)
    exact = found.descriptors.astype(np.int64) @ found.descriptors.astype(np.int64).T
    assert (found.descriptors @ found.descriptors.T == exact).all()


@pytest.mark.integration
def test_nothing_is_found_where_the_mask_is_not_white(learned_network):
    mask = np.full((340, 600), 255, np.uint8)
    mask[:, :300] = 0
    found = find_learned_features(learned_network, textured(), mask)
    assert len(found.xy) > 100
    assert found.xy[:, 0].min() >= 300
