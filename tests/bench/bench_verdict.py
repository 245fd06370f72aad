"""What the verdict finds in good and broken models: `python tests/bench/bench_verdict.py DATA OUT`.

DATA is the folder of test data. Each capture is mapped once, and good and broken models are made
from it (`verdict_captures`, `verdict_variants`); all stay in OUT, so that a second run only judges.
A line of the table: the capture, how the model was made, its cameras, the largest displacement of
one (share of the extent, after the similarity that fits most) and the share of cameras off by more
than a twentieth, both against the reference or the good model that it was made from; then what was
found, and the decision. A model is broken if a camera is off by more than DISPLACED, and good if
none is off by SOUND and nothing was done to it; others count as neither. Behind it, each bound as
it comes out of two thirds of the captures, tried on the third that was kept from the choice.

Name captures behind OUT to run only those; --map only maps.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
import zlib  # noqa: F401  # pycolmap must not be the first to load it
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pycolmap
from numpy.typing import NDArray
from pose_errors import reference_poses, similarity, trident_poses
from verdict_captures import CAPTURES, MODEL, ROOMS, Capture, prepare, quiet
from verdict_variants import BROKEN, GOOD, Variant, make, ordered_poses
from workbench import FOLDER

from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.merge_models import drop_outliers
from recon_cli.sfm.verdict.verdict import ModelVerdict, is_aliased, is_broken

SOUND = 0.02  # of the extent: no camera of a good model is further off
DISPLACED = 0.05  # of the extent: a model with a camera further off is broken
TRIALS = 2000  # samples of four cameras; with half of them right, one in 16 is good
PER_CAPTURE = 7  # broken models made of each capture, taken in turn from all kinds
MOST_CAMERAS = 120  # nothing is made of a larger model: each takes minutes
STEP = 5  # from one capture's first kind to the next one's
Centers = Mapping[str, NDArray[np.float64]]  # [3] by name


@dataclass(frozen=True)
class Row:
    """A model and what was found about it."""

    capture: str
    made: str
    farthest: float | None  # share of the extent; None where the truth is not known
    displaced: float | None  # share of the cameras
    label: str  # good, broken or "" for neither
    verdict: ModelVerdict
    angle: float  # median triangulation angle, degrees
    error: float  # reprojection, px
    seconds: float

    @property
    def shares(self) -> dict[str, float]:
        """The shares that a bound decides on; 1 where they are unknown."""
        cut = self.verdict.weakest_cut
        known = {"points": cut.share, "explained": cut.explained,
                 "overlap": self.verdict.aliasing.share}
        return {name: 1.0 if share is None else share for name, share in known.items()}

    @property
    def otherwise(self) -> bool:
        """Whether anything but the shares speaks against the model."""
        return len(self.verdict.problems) > (
            is_broken(self.verdict.weakest_cut) + is_aliased(self.verdict.aliasing))

    def cells(self) -> list[str]:
        """The cells of its line."""
        jumps = max((jump.ratio for jump in self.verdict.jumps), default=0.0)
        return [
            self.capture, self.made, f"{self.verdict.registered}/{self.verdict.images}",
            *("-" if value is None else f"{value:.3f}" for value in (
                self.farthest, self.displaced, self.verdict.weakest_cut.share,
                self.verdict.weakest_cut.explained, self.verdict.aliasing.share)),
            "-" if self.verdict.scale is None else f"{self.verdict.scale.error:.3f}",
            str(len(self.verdict.open_loops)),
            str(len(self.verdict.outliers)), str(len(self.verdict.model_parts)), f"{jumps:.0f}",
            f"{self.verdict.still:.2f}", f"{self.angle:.1f}", f"{self.error:.2f}",
            f"{self.seconds:.1f}", self.label or "-",
            "trusted" if self.verdict.trusted else "refused", self._remark()]

    def _remark(self) -> str:
        wrong = {"good": not self.verdict.trusted, "broken": self.verdict.trusted}
        return "WRONG" if wrong.get(self.label, False) else ""


HEADS = ("capture", "made", "cameras", "farthest", "displaced", "points", "explained", "overlap",
         "scale", "loops", "outliers", "parts", "jump", "still", "angle", "error", "s", "label",
         "verdict", "")


def reference(capture: Capture, data: Path) -> Centers:
    """True centres of a capture's cameras; empty where they are not known."""
    room = capture.name.split("_")[0]
    if room in ("living", "office"):
        return _places(reference_poses(data / "rooms" / room / "traj.txt"))
    if capture.name == "fox":
        return _places(reference_poses(data / "fox"))
    if capture.name == "trident":
        return _places(trident_poses(data))
    if capture.name.startswith("one_poster"):
        apart: dict[str, NDArray[np.float64]] = {}
        for offset, name in enumerate(ROOMS):
            poses = reference_poses(data / "rooms" / name / "traj.txt")
            apart |= {f"{1000 * offset + int(Path(key).stem):06d}.png":
                        pose[:3, 3] + [100 * offset, 0, 0] for key, pose in poses.items()}
        return apart
    return {}


def _places(poses: Mapping[str, NDArray[np.float64]]) -> Centers:
    return {name: pose[:3, 3] for name, pose in poses.items()}


def displacements(found: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each centre from the truth as a share of the extent, [F]; both [F, 3]."""
    extent = float(np.linalg.norm(np.ptp(truth, axis=0)))
    generator = np.random.default_rng(0)
    best = np.full(len(found), np.inf)
    for _ in range(TRIALS):
        some = generator.choice(len(found), 4, replace=False)
        scale, motion = similarity(found[some], truth[some])
        off = np.linalg.norm(
            scale * found @ motion[:3, :3].T + motion[:3, 3] - truth, axis=1) / extent
        if np.minimum(off, DISPLACED).sum() < np.minimum(best, DISPLACED).sum():
            best = off
    return best


def judge(
    capture: Capture, made: str, model: pycolmap.Reconstruction, job: MappingJob,
    truth: Centers, label: str = ""
) -> Row:
    """A line of the table, once the model is sharp and without outliers, as sfm makes it."""
    start = time.process_time()
    candidate = drop_outliers(job, mapper.sharpen(model))
    model, verdict = candidate.model, candidate.verdict
    seconds = time.process_time() - start
    centers = {image.name: image.projection_center()
               for image in map(model.image, model.reg_image_ids())}
    known = sorted(set(centers) & set(truth))
    farthest = displaced = None
    if len(known) > 5:
        off = displacements(np.array([centers[name] for name in known]),
                            np.array([truth[name] for name in known]))
        farthest, displaced = float(off.max()), float((off > DISPLACED).mean())
        if not label:
            label = "good" if farthest <= SOUND else "broken" if farthest > DISPLACED else ""
    return Row(
        capture.name, made, farthest, displaced, label, verdict,
        float(np.median(mapper.triangulation_angles(model))),
        model.compute_mean_reprojection_error(), seconds)


def rows_of(capture: Capture, number: int, data: Path, out: Path) -> Iterator[Row]:
    """The lines of a capture's own model and of those made from it."""
    job = prepare(capture, data, out)
    if not json.loads((job.out / MODEL).read_text(encoding="utf-8")):
        click.echo(f"{capture.name}: no model")
        return
    base, truth = pycolmap.Reconstruction(job.out / "mapped0"), reference(capture, data)
    own = judge(capture, "mapped", base, job, truth, capture.label)
    yield own
    if capture.thin:
        again = {"another seed": (mapper.map_incrementally, dataclasses.replace(job, seed=1)),
                 "relaxed": (mapper.map_relaxed, job)}
        for made, (find_models, changed) in again.items():
            models = find_models(changed, quiet())
            if models:
                yield judge(capture, made, max(models, key=mapper.model_size), job, truth)
        return
    if capture.name == "trident":
        known = {name: np.linalg.inv(pose) for name, pose in trident_poses(data).items()}
        poses = {name: pycolmap.Rigid3d(
            pycolmap.Rotation3d(known[name][:3, :3]), known[name][:3, 3]) for name in job.names}
        yield from _made(capture, Variant("true poses", lambda _: poses), job, base, truth)
    if own.label != "good":
        return
    poses = ordered_poses(job, base)
    found = {name: pose.inverse().translation for name, pose in poses.items()}
    if len(poses) > MOST_CAMERAS or capture.turning:
        return
    kinds = [BROKEN[(STEP * number + index) % len(BROKEN)] for index in range(PER_CAPTURE)]
    for variant in (*GOOD, *kinds):
        yield from _made(capture, variant, job, base, found)


def _made(
    capture: Capture, variant: Variant, job: MappingJob, base: pycolmap.Reconstruction,
    truth: Centers
) -> Iterator[Row]:
    folder = job.out / "variants" / variant.name.replace(" ", "_").replace("%", "").replace(",", "")
    model = make(job, base, variant, folder)
    if model is None or model.num_points3D() == 0:
        click.echo(f"{capture.name}, {variant.name}: no points are left")
        return
    row = judge(capture, variant.name, model, dataclasses.replace(job, out=folder), truth)
    # What the adjustment has moved back halfway is neither, nor are cameras of a good model that
    # nothing ties together once the others are gone.
    neither = variant in BROKEN or len(row.verdict.model_parts) > 1
    yield dataclasses.replace(row, label="") if neither and row.label == "good" else row


def choose_bounds(rows: Sequence[Row]) -> dict[str, float]:
    """For each share, the middle between the lowest of a good model and the next broken one.

    What one share or another check shows, those after it need not show again.
    """
    bounds: dict[str, float] = {}
    for name in ("points", "explained", "overlap"):
        lowest = min(row.shares[name] for row in rows if row.label == "good")
        below = [row.shares[name] for row in rows
                 if row.label == "broken" and not row.otherwise and row.shares[name] < lowest
                 and not any(row.shares[other] < bound for other, bound in bounds.items())]
        bounds[name] = (lowest + max(below, default=0.0)) / 2
    return bounds


def keep_thirds(rows: Sequence[Row]) -> Iterator[str]:
    """A line for each third of the captures: the bounds that the others give, and what is wrong."""
    captures = sorted({row.capture for row in rows})
    errors = 0
    for third in range(3):
        kept = captures[third::3]
        bounds = choose_bounds([row for row in rows if row.capture not in kept])
        own = [row for row in rows if row.capture in kept and row.label]
        wrong = [f"{row.capture} {row.made}" for row in own if (row.label == "broken") != (
            row.otherwise or any(row.shares[name] < bound for name, bound in bounds.items()))]
        errors += len(wrong)
        told = ", ".join(f"{name} {bound:.3f}" for name, bound in bounds.items())
        yield (f"without {', '.join(kept)}: {told}; {len(wrong)} of {len(own)} wrong "
               f"{', '.join(wrong)}")
    yield f"{errors} errors"


@click.command()
@click.argument("data", type=FOLDER)
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", nargs=-1)
@click.option("--map", "only_map", is_flag=True, help="Only map the captures.")
def main(data: Path, out: Path, names: tuple[str, ...], *, only_map: bool) -> None:
    """Prints the table, the bounds, and what they decide on captures that were kept from them."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pycolmap.logging.minloglevel = 2
    rows: list[Row] = []
    print_cells(HEADS)
    for number, capture in enumerate(CAPTURES):
        if names and capture.name not in names:
            continue
        if only_map:
            job = prepare(capture, data, out)
            click.echo(f"{capture.name} {(job.out / MODEL).read_text(encoding='utf-8')}")
            continue
        for row in rows_of(capture, number, data, out):
            rows.append(row)
            print_cells(row.cells())
    if not any(row.label == "good" for row in rows):
        return
    for label in ("good", "broken"):
        own = [row for row in rows if row.label == label]
        wrong = sum(row.verdict.trusted != (label == "good") for row in own)
        click.echo(f"{label}: {len(own)} models, {wrong} decided wrongly")
    click.echo("bounds from all captures: " + ", ".join(
        f"{name} {bound:.3f}" for name, bound in choose_bounds(rows).items()))
    if len({row.capture for row in rows if row.label == "good"}) > 2:
        for line in keep_thirds(rows):
            click.echo(line)


def print_cells(cells: Sequence[str]) -> None:
    """Prints one line of the table."""
    widths = (17, 21, 8, 9, 10, 7, 10, 8, 6, 6, 9, 6, 5, 6, 6, 6, 5, 7, 8, 5)
    click.echo(" ".join(
        f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip())


if __name__ == "__main__":
    main()
