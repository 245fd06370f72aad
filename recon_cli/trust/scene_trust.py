"""The trust of a model: the support of its Gaussians, the calibrated errors, and both on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import ManifestError, StageError
from recon_cli.evaluation.reference_views import RenderedModel, load_reference_views
from recon_cli.io.views import ReferenceView, evenly_spread
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.trust.agreement import ause, reliability
from recon_cli.trust.error_model import calibrate, gaussian_terms, picture_terms
from recon_cli.trust.heat_map import FULL
from recon_cli.trust.neighbors import (
    pose_distances,
    rendered_count,
    spread_views,
    support_of_all,
)
from recon_cli.trust.records import (
    FOLDER,
    Agreement,
    ErrorModel,
    ModelTrust,
    SurfaceShares,
    TrustRecord,
)
from recon_cli.trust.support import (
    MAX_VIEWS,
    ViewingGeometry,
    ViewSupport,
    error_image,
    measure_support,
)
from recon_cli.workspace.records import ImportRecord, need_views

_AT_ONCE = 16  # training photos in memory
_CALIBRATION = 12  # views that the errors are calibrated on, at most
_PIXELS = 25_000  # of each view whose agreement is measured, about: sorting takes most time


@dataclass(frozen=True, eq=False)
class Trust:
    """The trust of a model, ready to be rendered."""

    support: ViewSupport
    error: ErrorModel
    sh_degree: int

    def expected_error(
        self, splats: Splats, camera: Camera, backend: str
    ) -> NDArray[np.float32]:
        """Returns the expected absolute error of a view's pixels, [H, W] of 0 to 1."""
        picture = picture_terms(
            RenderedModel(splats, self.sh_degree, backend), self.support, camera)
        return self.error.expect(picture.terms)

    def expect_gaussians(self, sight: ViewingGeometry) -> NDArray[np.float32]:
        """Returns the expected error [N] of Gaussians as seen from one place.

        What only a picture tells (holes, edges, spreads) is as in the mean.
        """
        means = {name: np.full(1, value, np.float32) for name, value in self.error.means.items()}
        return self.error.expect(means | gaussian_terms(self.support, sight))

    def describe_pictures(self) -> dict[str, Any]:
        """Returns the meaning of a 16-bit picture of it, for readers and as its fingerprint."""
        return {"unit": "expected mean absolute error of the channels, full range = 1",
                "error_per_step": 1 / FULL, "views": len(self.support.rows),
                "model": self.error.to_json()}

    def save(self, evaluate: Path, model: str) -> None:
        """Writes the support of a model; the rest stands in trust.json."""
        (evaluate / FOLDER).mkdir(exist_ok=True)
        self.support.save(evaluate / FOLDER / f"{model}.safetensors")

    @staticmethod
    def load(evaluate: Path, model: str, digest: str, sh_degree: int) -> Trust | None:
        """Returns the trust of the Gaussians of a digest; None if evaluate has that of others."""
        try:
            record = TrustRecord.read(evaluate)
        except ManifestError:  # of another version
            return None
        stored = record and record.model_trust(model)
        if not stored:
            return None
        support = ViewSupport.load(evaluate / FOLDER / f"{model}.safetensors")
        return Trust(support, stored.error, sh_degree) if support.digest == digest else None


def digest_of(splats: Splats) -> str:
    """Returns the SHA-256 of the parameters; the file may have been replaced since it was read."""
    digest = hashlib.sha256()
    for name, value in splats.parameters().items():
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.cpu().numpy().tobytes())
    return digest.hexdigest()


def why_none(record: ImportRecord | None) -> str:
    """Returns why a scene has no trust, as a sentence; empty where it has."""
    if record is not None and not record.views:
        return "The scene was imported without views, so nothing tells where it is right."
    if record is not None and record.doubt:
        return f"Trust is measured against views of the scene, but {record.doubt}."
    return ""


def refuse_without(record: ImportRecord | None) -> None:
    """Raises StageError where a scene has no trust."""
    reason = why_none(record)
    if reason:
        raise StageError(reason, hint=need_views())


def views_looked_at(scene: Scene) -> int:
    """Returns how many views `measure_trust` renders."""
    calibration = scene.validation or scene.train
    return rendered_count(len(evenly_spread(scene.train, MAX_VIEWS))) + len(
        evenly_spread(calibration, _CALIBRATION))


def measure_trust(
    model: RenderedModel, scene: Scene, config: RunConfig, max_size: int, ctx: StageContext,
    on_view: Callable[[], None] = lambda: None,
) -> Trust:
    """Returns the trust of a model: a pass over training views, then the validation views.

    `max_size` is the longest side in pixels at which errors are compared.
    """
    gains = config.has_gains
    every = evenly_spread(scene.train, MAX_VIEWS)
    cameras = [view.camera for view in every]
    apart = pose_distances(cameras, model.splats)
    chosen = [every[number] for number in spread_views(apart, rendered_count(len(every)))]
    names: list[str] = []  # of those that were rendered: masks may leave too little of some

    def photos() -> Iterator[ReferenceView]:
        for view in _in_turn(chosen, max_size, ctx.threads):
            names.append(view.name)
            yield view

    support = measure_support(
        model.splats, photos(), sh_degree=model.sh_degree, backend=model.backend, gains=gains,
        on_view=on_view, digest=digest_of(model.splats))
    numbers = {view.name: number for number, view in enumerate(every)}
    rendered = [numbers[name] for name in names]
    support = support_of_all(support, model.splats, cameras, apart, rendered)
    validation = load_reference_views(evenly_spread(scene.validation, _CALIBRATION), max_size)
    train = [] if validation else load_reference_views(
        evenly_spread(scene.train, _CALIBRATION), max_size)
    error = calibrate(model, support, validation, train, gains=gains, on_view=on_view)
    return Trust(support, error, model.sh_degree)


def _in_turn(views: Sequence[View], max_size: int, threads: int) -> Iterator[ReferenceView]:
    """Yields views with their photos, few of them in memory at once."""
    for begin in range(0, len(views), _AT_ONCE):
        yield from load_reference_views(views[begin:begin + _AT_ONCE], max_size, threads=threads)


def model_trust(
    trust: Trust, model: RenderedModel, surface: SurfaceShares, views: Sequence[ReferenceView], *,
    gains: bool,
    on_view: Callable[[ReferenceView, NDArray[np.float32]], None] = lambda _view, _error: None,
) -> ModelTrust:
    """Returns the record of a model's trust, checked on views that did not calibrate it.

    `on_view` gets each of the `views` and its expected error [H, W].
    """
    areas: list[tuple[float, ...]] = []
    actual_error, expected_error = [], []
    for view in views:
        picture = picture_terms(model, trust.support, view.camera)
        expected = trust.error.expect(picture.terms)
        on_view(view, expected)
        error, counts = error_image(picture.rgb, view, gains=gains)
        used = counts > 0
        pixels = slice(None, None, max(1, int(used.sum()) // _PIXELS))
        errors, own, *others = (
            np.asarray(image[used][pixels], np.float64)
            for image in (error, expected, 1 - picture.alpha, picture.depth))
        areas.append(ause(errors, own, *others))
        actual_error.append(errors)
        expected_error.append(own)
    agreement = None
    if views:
        bins, means = reliability(actual_error, expected_error), np.mean(areas, axis=0)
        agreement = Agreement(
            views=len(views), ause=round(float(means[0]), 4),
            ause_opacity=round(float(means[1]), 4), ause_depth=round(float(means[2]), 4),
            expected=tuple(round(value, 6) for value in bins.expected),
            real=tuple(round(value, 6) for value in bins.real), gap=round(bins.gap, 4))
    return ModelTrust(views=len(trust.support.rows), error=trust.error, agreement=agreement,
                      surface=surface)
