"""The tint of trust, without a browser."""

import numpy as np

from recon_cli.pipeline.plan import Job
from recon_cli.viewer.content import load_workspace
from recon_cli.viewer.trust_tint import TrustTint
from recon_cli.workspace.layout import Workspace


def test_colours_are_tinted_by_where_one_stands(room):
    job = Job(Workspace(room))
    content, tint = load_workspace(job, "auto"), TrustTint(job)
    for model, packed in content.models.items():
        tint.prepare(model)
        near, far = [0.0, 0.0, 0.0], [0.0, 0.0, 9.0]  # from the cameras' side, and from behind
        plain = packed.colors(near)
        tinted = tint.colors(model, packed, plain, near)
        assert (tinted.shape, tinted.dtype) == (plain.shape, np.uint8)
        assert (tinted != plain).any(axis=1).mean() > 0.9
        assert (tint.colors(model, packed, plain, far) != tinted).any()


def test_a_model_that_has_changed_keeps_its_colours(room):
    job = Job(Workspace(room))
    content, tint = load_workspace(job, "auto"), TrustTint(job)
    tint.prepare("pruned")
    other = content.models["base"]
    colors = other.colors(None)
    np.testing.assert_array_equal(tint.colors("pruned", other, colors, [0, 0, 0]), colors)
