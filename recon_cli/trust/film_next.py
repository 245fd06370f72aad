"""Where to film next: standing places and headings that would show the most badly seen surface.

Every candidate is rendered small. Its score is the mean error to expect in that picture: high where
it shows holes, surface that few views show, or surface that they show from elsewhere. The best one
then counts as filmed, and the others are scored again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render import render
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.scene import View
from recon_cli.scene.splats import Splats
from recon_cli.trust.error_model import ErrorModel
from recon_cli.trust.standing_places import StandingPlaces
from recon_cli.trust.support import CARRIES, Sight, Support
from recon_cli.workspace.summaries import JsonRecord

SUGGESTIONS = 5
MAX_PLACES = 24
_HEADINGS = 8
_PITCHES_DEG = (0.0, -30.0)
_SIDE = 96  # pixels of the longer side
_VIEWS = 60  # training views that directions are compared with
_FEW = 2  # views
_SAME_DEG = 12  # turns that go without saying
_ASIDE = np.radians(25)  # from which a surface counts as seen from another side
_FADE = 1.0  # eye heights over which a hole counts as filmed from one place
_TOO_NEAR = 0.35  # share of a picture that a surface closer than a third of the eye height may fill

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Suggestion(JsonRecord):
    """A place to film from."""

    position: tuple[float, ...]  # [3] of the eyes, world units
    forward: tuple[float, ...]  # [3] unit vector of the view
    near: str  # name of the frame that was taken nearest to it
    distance: float  # from there, world units
    turn_deg: float  # from that frame's heading, to the right
    expected_error: float  # mean over the picture, 0 to 1
    reason: str

    def describe(self, unit: str) -> str:
        """Returns the suggestion in words; `unit` is m or units."""
        turn = round(abs(self.turn_deg))
        side = "right" if self.turn_deg > 0 else "left"
        heading = f"turned {turn} degrees to the {side}"
        if not _SAME_DEG < turn < 180 - _SAME_DEG:
            heading = "facing the same way" if turn < 90 else "facing the other way"
        x, y, z = self.position
        return (f"at {x:.2f} {y:.2f} {z:.2f} ({self.distance:.2g} {unit} from {self.near}, "
                f"{heading}): {self.reason}")


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose and what it shows, at low resolution."""

    place: int
    camera: Camera
    rows: torch.Tensor  # [K] Gaussians
    shares: Array  # [K] of the picture
    hole: float  # share of the picture


def suggest(
    splats: Splats, support: Support, model: ErrorModel, places: StandingPlaces,
    views: Sequence[View], *, backend: str, on_view: Callable[[], None] = lambda: None,
) -> list[Suggestion]:
    """Returns the best places, the best one first; none without standing places.

    `views` are those with a photo, for their lens and as landmarks.
    """
    support = support.thinned(_VIEWS)
    candidates = _render_candidates(splats, places, views[0].camera, backend, on_view)
    sights = [support.seen_from(splats.means, eye) for eye in places.eyes]
    heights = (splats.means.detach().cpu().double().numpy() @ places.up - places.floor) / places.eye
    chosen: list[_Candidate] = []
    suggestions: list[Suggestion] = []
    while candidates and len(suggestions) < SUGGESTIONS:
        errors = [model.expect_gaussians(support, sight) for sight in sights]
        scores = [_score(each, errors[each.place], model, chosen, places) for each in candidates]
        best = int(np.argmax(scores))
        pick = candidates[best]
        reason = _reason(pick, errors[pick.place], model.expect_hole(), support,
                         sights[pick.place], heights)
        suggestions.append(_describe(pick, scores[best], reason, places.up, views))
        chosen.append(pick)
        candidates = [each for each in candidates if each is not pick]
        support = support.with_view(pick.rows, pick.camera.center)
        sights = [_updated(sight, splats, pick, eye)
                  for sight, eye in zip(sights, places.eyes, strict=True)]
    return suggestions


def _render_candidates(
    splats: Splats, places: StandingPlaces, lens: Camera, backend: str, on_view: Callable[[], None]
) -> list[_Candidate]:
    scale = _SIDE / max(lens.width, lens.height)
    width, height = (max(16, round(side * scale)) for side in (lens.width, lens.height))
    plain = Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities,
                   splats.sh_dc, splats.sh_rest[:0, :0])
    black = torch.zeros(3, dtype=splats.means.dtype, device=splats.means.device)
    candidates = []
    for number, eye in enumerate(places.eyes):
        for forward in _directions(places.up):
            viewmat = looking_at(eye, eye + forward, places.up)
            camera = Camera(width, height, lens.fx * scale, lens.fy * scale, width / 2, height / 2,
                            viewmat)
            with torch.no_grad():
                output = render(plain, camera, black, 0, backend=backend, scores=True)
            on_view()
            depth = output.depth / output.alpha.clamp_min(1e-3)
            blocked = float(((depth < places.eye / 3) & (output.alpha > 0.5)).float().mean())
            if blocked > _TOO_NEAR:
                continue
            rows = torch.nonzero(output.statistics.blend_max >= CARRIES)[:, 0]
            shares = output.statistics.blend_sum[rows].cpu().double().numpy() / (width * height)
            candidates.append(_Candidate(
                number, camera, rows, shares, float(1 - output.alpha.mean())))
    return candidates


def _directions(up: Array) -> list[Array]:
    """Returns the unit vectors [3] of all headings and pitches."""
    right = np.linalg.svd(up[None])[2][1]
    ahead = np.cross(up, right)
    return [np.cos(pitch) * (np.cos(angle) * ahead + np.sin(angle) * right) + np.sin(pitch) * up
            for pitch in np.radians(_PITCHES_DEG)
            for angle in 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS]


def _score(
    each: _Candidate, errors: NDArray[np.float32], model: ErrorModel,
    chosen: Sequence[_Candidate], places: StandingPlaces,
) -> float:
    """Returns the mean error to expect in a picture."""
    shown = float((each.shares * errors[each.rows.cpu().numpy()]).sum())
    left = 1.0
    for other in chosen:
        apart = np.linalg.norm(other.camera.center - each.camera.center) / (_FADE * places.eye)
        facing = max(0.0, float(other.camera.viewmat[2, :3] @ each.camera.viewmat[2, :3]))
        left = min(left, 1 - facing * float(np.exp(-apart**2)))
    return shown + each.hole * model.expect_hole() * left


def _updated(sight: Sight, splats: Splats, pick: _Candidate, eye: Array) -> Sight:
    """Returns how Gaussians look from a place once the picked view is filmed."""
    rows, means = pick.rows, splats.means[pick.rows]
    one = Support.of([torch.arange(len(rows), device=rows.device)], pick.camera.center[None],
                     torch.zeros(len(rows), dtype=means.dtype, device=means.device))
    new = one.seen_from(means, eye)
    angle, nearer = sight.angle.clone(), sight.nearer.clone()
    unseen = angle[rows] >= np.pi - 1e-3
    nearer[rows] = torch.where(unseen, new.nearer, torch.minimum(nearer[rows], new.nearer))
    angle[rows] = torch.minimum(angle[rows], new.angle)
    return Sight(angle, nearer)


def _reason(
    pick: _Candidate, errors: NDArray[np.float32], hole: float, support: Support, sight: Sight,
    heights: Array,
) -> str:
    """Returns why a picture is worth taking; `heights` [N] are in eye heights over the floor."""
    rows = pick.rows.cpu().numpy()
    parts, count = pick.shares * errors[rows], support.count.cpu().numpy()[rows]
    angle = sight.angle.cpu().numpy()[rows]
    is_few = count <= _FEW
    is_aside = ~is_few & (angle > _ASIDE)
    few, aside = float(parts[is_few].sum()), float(parts[is_aside].sum())
    if hole * pick.hole >= max(few, aside):
        return "no view shows what lies there"
    kind = is_few if few >= aside else is_aside
    order = np.argsort(heights[rows][kind])
    sums = np.cumsum(parts[kind][order])
    where = _height_words(float(heights[rows][kind][order][np.searchsorted(sums, sums[-1] / 2)]))
    if few >= aside:
        return f"{where}: at most {_FEW} views show them"
    return f"{where}: filmed so far from {np.degrees(np.median(angle[kind])):.0f} degrees aside"


def _describe(
    pick: _Candidate, score: float, reason: str, up: Array, views: Sequence[View]
) -> Suggestion:
    centers = np.stack([view.camera.center for view in views])
    apart = np.linalg.norm(centers - pick.camera.center, axis=1)
    near, forward = views[int(apart.argmin())], pick.camera.viewmat[2, :3]
    return Suggestion(
        position=tuple(pick.camera.center.round(4).tolist()),
        forward=tuple(forward.round(4).tolist()), near=near.name,
        distance=round(float(apart.min()), 4),
        turn_deg=round(_turn_deg(near.camera.viewmat[2, :3], forward, up), 1),
        expected_error=round(score, 5), reason=reason)


def _height_words(height: float) -> str:
    """Returns what lies at a height, in eye heights over the floor."""
    if height < 0.1:
        return "parts of the floor"
    if height < 0.45:  # of 1.6 m: 72 cm, a table
        return "low surfaces, as under a table"
    return "surfaces of furniture and walls" if height < 1.2 else "surfaces high up"


def _turn_deg(before: Array, after: Array, up: Array) -> float:
    """Returns the level angle in degrees from one direction to another, to the right as seen."""
    one, other = before - (before @ up) * up, after - (after @ up) * up
    return float(np.degrees(np.arctan2(np.cross(other, one) @ up, one @ other)))
