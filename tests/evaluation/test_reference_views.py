"""Scores of views do not depend on how many threads take them."""

import numpy as np
import torch

from recon_cli.evaluation.reference_views import mean_psnr, score_views
from recon_cli.io.views import ReferenceView
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


def test_any_number_of_threads_gives_the_same_scores_in_the_order_of_the_views():
    generator = torch.Generator().manual_seed(0)
    count = 40
    splats = Splats(
        means=torch.rand(count, 3, generator=generator) * 2 + torch.tensor([-1.0, -1.0, 2.0]),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), -2.0), logit_opacities=torch.zeros(count),
        sh_dc=torch.randn(count, 3, generator=generator), sh_rest=torch.zeros(count, 0, 3))
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
