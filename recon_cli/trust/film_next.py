"""Where to film next: standing places and headings that would mend the most badly seen surface.

All places are rendered small, all around. That is what somebody sees who walks there; the model
says what error to expect in it. A picture from one of the places changes that for the surface that
it shows: there is one view more, and perhaps one from a nearer direction. Its score is how far the
expected error falls, on the mean over the pictures of all places. The best one then counts as
filmed, and the others are scored again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render import render
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.scene import View
from recon_cli.scene.splats import Splats
from recon_cli.trust.error_model import ErrorModel
from recon_cli.trust.standing_places import StandingPlaces
from recon_cli.trust.support import CARRIES, Support
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
_FADE = 1.0  # eye heights over which a picture fills a hole that other places show too
_SAMPLE = 4_000  # Gaussians that the surface is judged by
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

    origin: int  # which of the places, or of other cameras, it is taken from
    camera: Camera
    rows: torch.Tensor  # [K] Gaussians
    shares: Array  # [K] of the picture
    hole: float  # share of the picture
    blocked: float  # share that something very near fills


def suggest(
    splats: Splats, support: Support, model: ErrorModel, places: StandingPlaces,
    views: Sequence[View], *, backend: str, on_view: Callable[[], None] = lambda: None,
) -> list[Suggestion]:
    """Returns the best places, the best one first; none without standing places.

    `views` are those with a photo, for their lens and as landmarks.
    """
    if not len(places.eyes):
        return []
    candidates = _render_candidates(splats, places, views[0].camera, backend, on_view)
    if not candidates:
        return []
    walk = _Walk.of(splats, support, model, places, candidates, candidates)
    suggestions = []
    for best in walk.choose(SUGGESTIONS):
        suggestions.append(_describe(
            candidates[best], walk.error(best), walk.reason(best), places.up, views))
        walk.film(best)
    return suggestions


def choose_views(
    splats: Splats, support: Support, model: ErrorModel, places: StandingPlaces,
    cameras: Sequence[Camera], count: int, *, backend: str,
) -> list[int]:
    """Returns which of some cameras that nothing was trained on would help most, best first."""
    around = _render_candidates(splats, places, cameras[0], backend, lambda: None)
    own = [_render(splats, _reduced(camera), number, backend)
           for number, camera in enumerate(cameras)]
    if not around:
        return []
    walk, chosen = _Walk.of(splats, support, model, places, around, own), []
    for best in walk.choose(count):
        chosen.append(best)
        walk.film(best)
    return chosen


@dataclass(eq=False)
class _Walk:
    """What P places show of S sampled Gaussians, all around, and what C candidates would mend."""

    model: ErrorModel
    candidates: Sequence[_Candidate]
    rows: NDArray[np.int64]  # [S] of the Gaussians
    weights: Array  # [P, S] share of the pictures of a place that each stands for
    shown: Array  # [C, S] 1 where a candidate shows it
    rays: Array  # [P, S, 3] from the places
    distance: Array  # [P, S]
    origin_rays: Array  # [O, S, 3] from where candidates are taken
    origin_distance: Array  # [O, S]
    angle: Array  # [P, S] to the nearest ray of a view
    nearest: Array  # [P, S] distance of the nearest view; infinite without any
    count: Array  # [S] views
    residual: Array  # [S]
    heights: Array  # [S] over the floor, in eye heights
    holes: Array  # [C] share of the picture that is left
    beside: Array  # [C, C] how far filming one fills the holes of another

    @staticmethod
    def of(
        splats: Splats, support: Support, model: ErrorModel, places: StandingPlaces,
        around: Sequence[_Candidate], candidates: Sequence[_Candidate],
    ) -> _Walk:
        """Returns the state before anything is filmed; `around` are the pictures of the places."""
        total = np.zeros(len(splats))
        for each in around:
            total[each.rows.cpu().numpy()] += each.shares
        # each by its weight, and then counted the more the less likely it was
        kept = np.minimum(1, _SAMPLE * total / max(float(total.sum()), 1e-12))
        rows = np.flatnonzero(np.random.default_rng(0).random(len(kept)) < kept)
        at = np.full(len(splats), -1)
        at[rows] = np.arange(len(rows))
        weights = np.zeros((len(places.eyes), len(rows)))
        shown = np.zeros((len(candidates), len(rows)))
        pictures = np.bincount([each.origin for each in around], minlength=len(places.eyes))
        for each in around:
            own = at[each.rows.cpu().numpy()]
            weights[each.origin, own[own >= 0]] += each.shares[own >= 0] / pictures[each.origin]
        for number, each in enumerate(candidates):
            own = at[each.rows.cpu().numpy()]
            shown[number, own[own >= 0]] = 1
        origins = np.zeros((max(each.origin for each in candidates) + 1, 3))
        for each in candidates:
            origins[each.origin] = each.camera.center
        weights /= kept[rows]
        sample = torch.from_numpy(rows).to(splats.means.device)
        support = support.select(sample).thinned(_VIEWS)
        on_device = splats.means[sample].detach()
        means = on_device.cpu().double().numpy()
        rays, distance = _rays(places.eyes, means)
        sights = [support.seen_from(on_device, eye) for eye in places.eyes]
        angle, nearer = (
            np.stack([getattr(sight, name).cpu().double().numpy() for sight in sights])
            for name in ("angle", "nearer"))
        nearest = np.where(angle > np.pi - 1e-3, np.inf, distance * np.exp(nearer))
        centers = np.stack([each.camera.center for each in candidates])
        apart = np.linalg.norm(centers[:, None] - centers, axis=-1) / (_FADE * places.eye)
        forward = np.stack([each.camera.viewmat[2, :3] for each in candidates])
        return _Walk(
            model, candidates, rows, weights, shown, rays, distance, *_rays(origins, means), angle,
            nearest, support.count.cpu().double().numpy(),
            support.residual.cpu().double().numpy(),
            (means @ places.up - places.floor) / places.eye,
            np.array([each.hole for each in candidates]),
            np.exp(-apart**2) * np.maximum(forward @ forward.T, 0))

    def _expect(self, angle: Array, nearest: Array, count: Array) -> Array:
        """Returns expected errors [P, S]."""
        nearer = np.log(np.maximum(nearest / self.distance, 1))
        return self.model.expect_seen(
            count, angle, self.residual, np.where(np.isinf(nearest), 0, nearer))

    def _filmed_from(self, origin: int) -> tuple[Array, Array]:
        """Returns angle and nearest distance [P, S] once everything is filmed from an origin."""
        turn = np.arccos(np.clip((self.rays * self.origin_rays[origin]).sum(-1), -1, 1))
        return np.minimum(self.angle, turn), np.minimum(
            self.nearest, self.origin_distance[origin])

    def choose(self, most: int) -> Iterator[int]:
        """Yields the best candidate by and by; each is to be filmed before the next."""
        left = np.ones(len(self.candidates), bool)
        for _ in range(min(most, len(left))):
            best = int(np.argmax(np.where(left, self.scores(), -np.inf)))
            left[best] = False
            yield best

    def scores(self) -> Array:
        """Returns how far the mean expected error falls with each candidate, [C]."""
        before = self._expect(self.angle, self.nearest, self.count)
        gains = np.stack([
            (self.weights * (before - self._expect(*self._filmed_from(origin), self.count + 1))
             ).sum(0) for origin in range(len(self.origin_rays))])  # [O, S]
        origins = [each.origin for each in self.candidates]
        surface = (self.shown * gains[origins]).sum(1) / len(self.weights)
        hole = self.model.expect_hole() - float((self.weights * before).sum() / max(
            float(self.weights.sum()), 1e-12))
        filled = (self.beside * self.holes).sum(1) / len(self.candidates)
        return np.asarray(surface + filled * max(hole, 0.0))

    def film(self, number: int) -> None:
        """Counts a candidate as filmed."""
        shown = self.shown[number] > 0
        angle, nearest = self._filmed_from(self.candidates[number].origin)
        self.angle = np.where(shown, angle, self.angle)
        self.nearest = np.where(shown, nearest, self.nearest)
        self.count = self.count + shown
        self.holes = self.holes * (1 - self.beside[number])

    def error(self, number: int) -> float:
        """Returns the mean error to expect in the picture of a candidate."""
        each = self.candidates[number]
        errors = self._expect(self.angle, self.nearest, self.count)[each.origin]
        own = self.shown[number] * self.weights[each.origin]
        mean = float((own * errors).sum() / max(float(own.sum()), 1e-12))
        return (1 - each.hole) * mean + each.hole * self.model.expect_hole()

    def reason(self, number: int) -> str:
        """Returns why a picture is worth taking."""
        each = self.candidates[number]
        angle, own = self.angle[each.origin], self.shown[number] * self.weights[each.origin]
        parts = (1 - each.hole) * own / max(float(own.sum()), 1e-12) * (
            self._expect(self.angle, self.nearest, self.count)[each.origin])
        is_few = self.count <= _FEW
        is_aside = ~is_few & (angle > _ASIDE)
        few, aside = float(parts[is_few].sum()), float(parts[is_aside].sum())
        hole = each.hole * self.model.expect_hole()
        if hole > max(few, aside):
            return "no view shows what lies there"
        kind = is_few if few >= aside else is_aside
        if few + aside <= 0:
            return "it mends a little everywhere"
        order = np.argsort(self.heights[kind])
        sums = np.cumsum(parts[kind][order])
        where = _height_words(float(
            self.heights[kind][order][np.searchsorted(sums, sums[-1] / 2)]))
        if few >= aside:
            return f"{where}: at most {_FEW} views show them"
        seen = np.degrees(np.average(angle[kind], weights=parts[kind]))
        return f"{where}: filmed so far from {seen:.0f} degrees aside"


def _render_candidates(
    splats: Splats, places: StandingPlaces, lens: Camera, backend: str, on_view: Callable[[], None]
) -> list[_Candidate]:
    small, candidates = _reduced(lens), []
    for number, eye in enumerate(places.eyes):
        for forward in _directions(places.up):
            camera = replace(small, cx=small.width / 2, cy=small.height / 2,
                             viewmat=looking_at(eye, eye + forward, places.up))
            candidate = _render(splats, camera, number, backend, near=places.eye / 3)
            on_view()
            if candidate.blocked <= _TOO_NEAR:
                candidates.append(candidate)
    return candidates


def _reduced(camera: Camera) -> Camera:
    scale = _SIDE / max(camera.width, camera.height)
    return camera.resized(*(max(16, round(side * scale)) for side in (camera.width, camera.height)))


def _render(
    splats: Splats, camera: Camera, origin: int, backend: str, *, near: float = 0.0
) -> _Candidate:
    """Returns what a camera shows; what is closer than `near` blocks it."""
    plain = Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities,
                   splats.sh_dc, splats.sh_rest[:0, :0])
    black = torch.zeros(3, dtype=splats.means.dtype, device=splats.means.device)
    with torch.no_grad():
        output = render(plain, camera, black, 0, backend=backend, scores=True)
    depth = output.depth / output.alpha.clamp_min(1e-3)
    rows = torch.nonzero(output.statistics.blend_max >= CARRIES)[:, 0]
    shares = output.statistics.blend_sum[rows].cpu().double().numpy()
    return _Candidate(
        origin, camera, rows, shares / (camera.width * camera.height),
        float(1 - output.alpha.mean()),
        float(((depth < near) & (output.alpha > 0.5)).float().mean()))


def _rays(origins: Array, means: Array) -> tuple[Array, Array]:
    """Returns unit vectors [O, S, 3] from origins [O, 3] to means [S, 3], and distances [O, S]."""
    offsets = means - origins[:, None]
    distance = np.linalg.norm(offsets, axis=-1) + 1e-9
    return offsets / distance[..., None], distance


def _directions(up: Array) -> list[Array]:
    """Returns the unit vectors [3] of all headings and pitches."""
    right = np.linalg.svd(up[None])[2][1]
    ahead = np.cross(up, right)
    return [np.cos(pitch) * (np.cos(angle) * ahead + np.sin(angle) * right) + np.sin(pitch) * up
            for pitch in np.radians(_PITCHES_DEG)
            for angle in 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS]


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
