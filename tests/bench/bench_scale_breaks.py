"""Are breaks of a walk's scale found? `python tests/bench/bench_scale_breaks.py DATA OUT [NAME..]`

DATA is the folder of test data, and OUT that of `bench_verdict`, whose captures are mapped where
they are not yet. Each good walk is cut where the relative scale of both sides is known least: as it
is, and made a turn in a narrow place by leaving across the cut only matches of frames up to 2
apart, or of neighbours, and of those the FEW that show what is furthest away. One side is scaled by
3, 10 and 30%, and all is triangulated and adjusted again, as sfm does. A line shows what scale is
left (a good one mends itself), how well it is said to be known, which share of the matches across
the cameras explain, what the floor says, the open loops, and the verdict. A model is broken from
BROKEN on, and good up to SOUND; others count as neither.

Drifts: only matches of frames up to 2 apart are left, and the scale grows by 2, 5 and 10% along the
walk; what is left between its ends is compared with the interval of 95% that is said.

Behind it: the share of explained matches that decides the most models of every second capture, and
how it decides those of the others.

--walk MODEL DATABASE TRUTH adds a model with its database, whose frames are numbered by the lines
of TRUTH, camera to world: as mapped, it is good or broken by the scales of its stretches.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pycolmap
from numpy.typing import NDArray
from pose_errors import similarity
from verdict_captures import CAPTURES, MODEL, Capture, prepare
from verdict_variants import ordered_poses
from workbench import FOLDER, print_head, print_row

from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.merge_models import build_posed_model, drop_outliers
from recon_cli.sfm.verdict.evidence import gather_evidence
from recon_cli.sfm.verdict.scale_drift import (
    MAX_FLOOR_STEP,
    MAX_SCALE_ERROR,
    MAX_SCALE_INTERVAL,
    MIN_SURE_EXPLAINED,
    ScaleCut,
    find_weakest_scale,
    is_scale_known,
)
from recon_cli.sfm.verdict.verdict import ModelVerdict, examine, find_order

FACTORS = (1.03, 1.10, 1.30)
DRIFTS = (1.02, 1.05, 1.10)  # from the first frame of a walk to the last
SIGMAS = 1.96  # of an interval of 95%
# Across the cut: frames up to so far apart, None for all, and matches of each pair of them.
FEW = 40
TIES = ((None, None), (2, None), (1, FEW), (1, FEW // 2))
BROKEN, SOUND = 0.10, 0.03  # of a relative scale that is left
STRETCH = 20  # cameras on either side of a cut that its scale is taken from
DEFAULT = ("fox", "living", "office", "living_noisy", "office_noisy", "study_walk",
           "lobby_walk", "loop")
HEADS = ("capture", "made", "cameras", "scale left", "known to", "explained", "floor", "drift said",
         "loops", "label", "verdict", "")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """A model and what was found about it."""

    capture: str
    made: str
    cameras: str
    left: float  # of the relative scale, as a share
    label: str
    error: float  # how well the scale is said to be known; 0 where nothing tells
    explained: float  # share of the matches across that the cameras explain
    off: float  # by the floor
    drift: float  # said, of the ends of the walk
    loops: int  # that are open
    trusted: bool
    otherwise: bool  # anything but how well the scale is known speaks against the model

    @classmethod
    def from_verdict(
        cls, capture: str, made: str, cameras: str, left: float, label: str, verdict: ModelVerdict
    ) -> Row:
        """The row of a model."""
        cut = verdict.scale or ScaleCut(0.0, "", "", ((), ()))
        by_scale = not verdict.open_loops and not is_scale_known(cut)
        return cls(capture, made, cameras, left, label, cut.error, cut.explained, cut.off,
                   cut.drift, len(verdict.open_loops), verdict.trusted,
                   len(verdict.problems) > by_scale)

    def is_wrong(self, explained: float = MIN_SURE_EXPLAINED) -> bool:
        """Whether it is decided wrongly, by a bound of the explained matches within the interval.

        A drift is, where it is more than the interval that is said.
        """
        if self.label == "drift":
            return self.trusted and self.left > SIGMAS * max(self.drift, self.error)
        known = self.error <= MAX_SCALE_ERROR or (
            self.error <= MAX_SCALE_INTERVAL and self.off <= MAX_FLOOR_STEP
            and self.explained >= explained)
        refused = self.otherwise or self.loops > 0 or not known
        return {"good": refused and self.error <= MAX_SCALE_INTERVAL,
                "broken": not refused}.get(self.label, False)

    def cells(self) -> tuple[str, ...]:
        """Its cells of the table."""
        return (self.capture, self.made, self.cameras, f"{self.left:.3f}", f"{self.error:.3f}",
                f"{self.explained:.2f}", f"{self.off:.3f}", f"{self.drift:.3f}", str(self.loops),
                self.label or "-", "trusted" if self.trusted else "refused",
                "WRONG" if self.is_wrong() else "")


def relative_scale(before: Array, after: Array, place: int | None) -> float:
    """How the scale behind a place changed against that before it, as a share; both [F, 3].

    Of the last frames against the first without a place.
    """
    def scale(rows: slice) -> float:
        return similarity(before[rows], after[rows])[0]

    sides = (slice(STRETCH), slice(-STRETCH, None)) if place is None else (
        slice(max(0, place - STRETCH), place), slice(place, place + STRETCH))
    change = scale(sides[1]) / scale(sides[0])
    return abs(float(np.expm1(abs(np.log(change)))))


def thin_ties(
    path: Path, base: pycolmap.Reconstruction, order: Sequence[str], place: int | None,
    ties: tuple[int | None, int | None],
) -> None:
    """Deletes matches across a place in the order: of frames far apart, and of what is near.

    Of all frames without a place.
    """
    reach, few = ties
    if reach is None:
        return
    rows = {name: row for row, name in enumerate(order)}
    with pycolmap.Database.open(path) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        for number, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            pair = pycolmap.pair_id_to_image_pair(number)
            low, high = sorted(rows.get(names[image], -1) for image in pair)
            if place is not None and not low < place <= high:
                continue
            opened.delete_two_view_geometry(*pair)
            opened.delete_matches(*pair)
            if low < 0 or high - low > reach:
                continue
            image = base.find_image_with_name(names[pair[0]])
            inliers = geometry.inlier_matches
            if few is not None:
                inliers = inliers[np.argsort(-depths(base, image, inliers[:, 0]))[:few]]
            geometry.inlier_matches = inliers
            opened.write_matches(*pair, inliers)
            opened.write_two_view_geometry(*pair, geometry)


def depths(
    model: pycolmap.Reconstruction, image: pycolmap.Image, keypoints: NDArray[np.uint32]
) -> Array:  # [K]
    """Depths of what keypoints of an image show; 0 where they show no point."""
    spots = [image.points2D[int(row)] for row in keypoints]
    return np.array([
        (image.cam_from_world() * model.point3D(spot.point3D_id).xyz)[2]
        if spot.has_point3D() else 0.0 for spot in spots])


def scaled(
    job: MappingJob, base: pycolmap.Reconstruction, place: int | None, factor: float,
    ties: tuple[int | None, int | None],
) -> tuple[pycolmap.Reconstruction, MappingJob]:
    """A model whose cameras from a place on are scaled about the first of them, adjusted again.

    Without a place the scale grows from frame to frame.
    """
    own = dataclasses.replace(job, out=job.out / "scaled")
    shutil.rmtree(own.out, ignore_errors=True)
    own.attempts.mkdir(parents=True)
    shutil.copyfile(job.database, own.database)
    poses = ordered_poses(job, base)
    names = list(poses)
    thin_ties(own.database, base, names, place, ties)
    places = range(1, len(names)) if place is None else (place,)
    motion, moved = pycolmap.Sim3d(), {names[0]: poses[names[0]]}
    for row, name in enumerate(names[1:], 1):
        if row in places:  # about where the walk has come to
            each = factor ** (1 / len(places))
            pivot = motion * poses[name].inverse().translation
            motion = pycolmap.Sim3d(each, pycolmap.Rotation3d(), (1 - each) * pivot) * motion
        moved[name] = motion.transform_camera_world(poses[name])
    model = mapper.triangulate(own, build_posed_model(own.database, base, moved))
    mapper.refine(own, model)
    return model, own


def rows_of(capture: Capture, data: Path, out: Path) -> Iterator[Row]:
    """The lines of a capture."""
    job = prepare(capture, data, out)
    if not (job.out / "mapped0").exists() or (job.out / MODEL).read_text("utf-8") == "[]":
        return
    base = mapper.sharpen(pycolmap.Reconstruction(job.out / "mapped0"))
    poses = ordered_poses(job, base)
    names = list(poses)
    centers = np.array([pose.inverse().translation for pose in poses.values()])
    own = examine(base, job.database, job.names, times=job.times)
    yield Row.from_verdict(
        capture.name, "mapped", f"{own.registered}/{own.images}", 0.0, "good", own)
    evidence = gather_evidence(base, job.database, job.names)
    cut = find_weakest_scale(base, evidence, find_order(evidence, job.times),
                             between=(names[0], names[-1]))
    place = len(names) // 2 if cut is None else names.index(cut.after)
    made: list[tuple[float, int | None, tuple[int | None, int | None]]] = [
        *((factor, place, ties) for ties in TIES for factor in FACTORS),
        *((factor, None, TIES[1]) for factor in DRIFTS)]
    for factor, at, ties in made:
        model, kept = scaled(job, base, at, factor, ties)
        candidate = drop_outliers(kept, mapper.sharpen(model))
        found = {image.name: image.projection_center() for image in map(
            candidate.model.image, candidate.model.reg_image_ids())}
        rows = [row for row, name in enumerate(names) if name in found]
        left = relative_scale(
            centers[rows], np.array([found[names[row]] for row in rows]),
            None if at is None else sum(row < at for row in rows))
        label = "broken" if left >= BROKEN else "good" if left <= SOUND else ""
        what = "all matches" if ties == TIES[0] else (
            f"up to {ties[0]} apart" + (f", {ties[1]} far" if ties[1] else ""))
        yield Row.from_verdict(
            capture.name, f"x {factor:g}{' on the way' if at is None else ''}, {what}",
            f"{len(rows)}/{len(names)}", left, "drift" if at is None else label, candidate.verdict)


def read_or_make(capture: Capture, data: Path, out: Path) -> Iterator[Row]:
    """The lines of a capture, from its folder where an earlier run has left them."""
    kept = out / capture.name / "scale_breaks.json"
    if kept.exists():
        yield from (Row(**row) for row in json.loads(kept.read_text(encoding="utf-8")))
        return
    rows = []
    for row in rows_of(capture, data, out):
        rows.append(row)
        yield row
    kept.write_text(json.dumps([dataclasses.asdict(row) for row in rows]), encoding="utf-8")


def walk_row(model_folder: Path, path: Path, truth: Path) -> Row:
    """The line of a model as it was mapped, judged by the scales of its stretches."""
    model = pycolmap.Reconstruction(model_folder)
    with pycolmap.Database.open(path) as opened:
        names = sorted(image.name for image in opened.read_all_images())
    verdict = examine(model, path, names)
    held = sorted(model.image(number).name for number in model.reg_image_ids())
    centers = np.array([model.find_image_with_name(name).projection_center() for name in held])
    known = np.loadtxt(truth).reshape(-1, 4, 4)[[int(Path(name).stem) for name in held], :3, 3]
    scales = [similarity(centers[start:start + STRETCH], known[start:start + STRETCH])[0]
              for start in range(0, len(held) - STRETCH, STRETCH // 2)]
    left = float(np.quantile(scales, 0.9) / np.quantile(scales, 0.1)) - 1
    label = "broken" if left >= BROKEN else "drift"
    return Row.from_verdict(model_folder.resolve().name, "as mapped", f"{len(held)}/{len(names)}",
                            left, label, verdict)


def held_out(rows: Sequence[Row]) -> Iterator[str]:
    """What the best bound of explained matches from half of the captures decides on the others."""
    captures = sorted({row.capture for row in rows})
    for half in (0, 1):
        chosen = set(captures[half::2])
        bounds = np.arange(0.5, 1.0, 0.01)
        wrong = [sum(row.is_wrong(bound) for row in rows if row.capture in chosen)
                 for bound in bounds]
        bound = float(np.median(bounds[np.array(wrong) == min(wrong)]))
        others = [row for row in rows if row.capture not in chosen]
        yield (f"by {', '.join(sorted(chosen))}: {bound:.2f} of the matches explained "
               f"({min(wrong)} wrong); {sum(row.is_wrong(bound) for row in others)} of "
               f"{len(others)} others wrong")


@click.command()
@click.argument("data", type=FOLDER)
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", nargs=-1)
@click.option("--walk", nargs=3, multiple=True, type=click.Path(exists=True, path_type=Path))
def main(data: Path, out: Path, names: tuple[str, ...], walk: tuple[tuple[Path, ...], ...]) -> None:
    """Prints the table, and what bounds from some captures decide on others."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pycolmap.logging.minloglevel = 2
    print_head(*HEADS)
    rows = []
    for paths in walk:
        rows.append(walk_row(*paths))
        print_row(*rows[-1].cells())
    for capture in CAPTURES:
        if capture.name in (names or DEFAULT):
            for row in read_or_make(capture, data, out):
                rows.append(row)
                print_row(*row.cells())
    for label in ("good", "broken", "drift"):
        own = [row for row in rows if row.label == label]
        between = [row for row in own if MAX_SCALE_ERROR < row.error <= MAX_SCALE_INTERVAL]
        click.echo(f"{label}: {len(own)} models, {sum(row.is_wrong() for row in own)} decided "
                   f"wrongly; {len(between)} known to {MAX_SCALE_ERROR:.0%} to "
                   f"{MAX_SCALE_INTERVAL:.0%}, {sum(row.trusted for row in between)} trusted")
    for line in held_out(rows):
        click.echo(line)


if __name__ == "__main__":
    main()
