"""Scores of views by any number of threads, and images that are not rendered twice."""

import numpy as np
import pytest
import torch

from recon_cli.evaluation import reference_views
from recon_cli.evaluation.reference_views import RenderedModel, mean_psnr, score_views
from recon_cli.io.views import ReferenceView
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


def scatter(count=40) -> Splats:
    generator = torch.Generator().manual_seed(0)
    return Splats(
        means=torch.rand(count, 3, generator=generator) * 2 + torch.tensor([-1.0, -1.0, 2.0]),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), -2.0), logit_opacities=torch.zeros(count),
        sh_dc=torch.randn(count, 3, generator=generator), sh_rest=torch.zeros(count, 0, 3))


@pytest.mark.integration
def test_any_number_of_threads_gives_the_same_scores_in_the_order_of_the_views():
    splats = scatter()
    rng = np.random.default_rng(0)
    views = [ReferenceView(
        Camera(24, 16, 20.0, 20.0, 12.0, 8.0, np.eye(4)),
        rng.integers(0, 256, (16, 24, 3), dtype=np.uint8), None, name=f"{index}.png")
        for index in range(11)]  # more than two threads hold at once
    saved: list[str] = []
    one = score_views(splats, views, 0, "torch")
    two = score_views(
        splats, views, 0, "torch", threads=2, on_view=lambda view, _: saved.append(view.name))
    assert [score.name for score in one.views] == [view.name for view in views]
    assert one.views == two.views
    assert all(each.gain_psnr_db >= each.psnr_db for each in one.views), one.views
    assert sorted(saved) == sorted(view.name for view in views)
    assert mean_psnr(splats, views, 0, "torch") == mean_psnr(splats, views, 0, "torch", threads=2)


def test_images_are_kept_by_camera_as_far_as_there_is_room(monkeypatch):
    camera = Camera(24, 16, 20.0, 20.0, 12.0, 8.0, np.eye(4))
    moved = np.eye(4)
    moved[0, 3] = 0.1
    other = Camera(24, 16, 20.0, 20.0, 12.0, 8.0, moved)
    size = 24 * 16 * 5 * 4  # bytes of colour, alpha and depth
    model = RenderedModel(scatter(), 0, "torch", room=size)
    seen, beside = model.images(camera), model.images(other)
    model.keep(camera, seen)
    model.keep(other, beside)  # no room is left
    rendered = []
    render_view = reference_views.render_view

    def count(splats, camera, *arguments):
        rendered.append(camera)
        return render_view(splats, camera, *arguments)

    monkeypatch.setattr(reference_views, "render_view", count)
    same = Camera(24, 16, 20.0, 20.0, 12.0, 8.0, np.eye(4))
    assert model.images(same) is seen
    assert rendered == []
    np.testing.assert_array_equal(model.images(other).rgb, beside.rgb)
    assert rendered == [other]
    assert np.abs(beside.rgb - seen.rgb).max() > 0.01
