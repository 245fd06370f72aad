"""Few photos far apart: what sfm trusts of them, against known poses.

    python tests/bench/bench_thinned.py DATA OUT

Each capture is thinned to every 4th, 8th, 12th and 16th of its photos, from three offsets on, and
goes through ingest and sfm as photos. A row says how many are placed, how far their centres are off
(RMS and the worst; in cm where the reference is metric, and in percent of the extent of those
cameras), what sfm decides, and which cameras it calls rough. Of several parts each is measured by
itself, and the worst one counts. The model that was decided on stays in OUT: --again decides on it
anew, without mapping. Bounds are chosen on one half of the captures and checked on the other.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import click
import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from pose_errors import Poses, reference_poses, similarity, trident_poses
from verdict_captures import quiet
from workbench import FOLDER, mapping_job, print_head, print_row, read_json

from recon_cli.config.stages import IngestConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ReconError
from recon_cli.io.colmap_library import write_model
from recon_cli.io.tracks import TRACKS
from recon_cli.progress import NullProgress
from recon_cli.sfm.features import xfeat_weights
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.mapping import fallbacks, trusted_part, worker
from recon_cli.sfm.mapping.merge_models import ModelCandidate
from recon_cli.sfm.verdict.camera_covariance import measure_rms
from recon_cli.sfm.verdict.verdict import ModelVerdict, examine
from recon_cli.stages import ingest
from recon_cli.stages.sfm import _times
from recon_cli.workspace import records

GAPS, OFFSETS = (16, 12, 8, 4), 3  # the quickest first
WRONG, RIGHT = 3.0, 1.0  # percent of the extent: RMS of a model that is wrong, or right
RESULT, CANDIDATE, MATCHES = "result.json", "candidate", "matches.db"


@dataclass(frozen=True)
class Capture:
    """A capture with a reference.

    Attributes:
        photos: all of them, in order, given DATA and a folder that they may be written to.
        truth: camera to world by the stem of a photo's name.
        metric: the reference is in metres.
        half: bounds are chosen on the captures of half 0 and checked on those of half 1.
    """

    photos: Callable[[Path, Path], Sequence[Path]]
    truth: Callable[[Path], Poses]
    metric: bool
    half: int


def room(name: str, half: int) -> Capture:
    """A rendered room: poses are exact."""
    def truth(data: Path) -> Poses:
        poses = reference_poses(data / "rooms" / name / "traj.txt")
        return {f"frame{Path(key).stem}": pose for key, pose in poses.items()}
    return Capture(
        lambda data, _: sorted((data / "rooms" / name / "results").glob("frame*.jpg")),
        truth, metric=True, half=half)


def by_stem(read: Callable[[Path], Poses]) -> Callable[[Path], Poses]:
    """The poses of a reference by the stems of its names."""
    return lambda data: {Path(name).stem: pose for name, pose in read(data).items()}


def filmed(path: str, stride: int) -> Callable[[Path, Path], Sequence[Path]]:
    """Every so many frames of a video as pictures, named by their place in it."""
    def write(data: Path, folder: Path) -> Sequence[Path]:
        if not folder.exists():
            partial = folder.with_suffix(".partial")
            partial.mkdir(parents=True, exist_ok=True)
            stream, index = cv2.VideoCapture(str(data / path)), 0
            while (found := stream.read())[0]:
                if index % stride == 0:
                    cv2.imwrite(str(partial / f"{index:06d}.png"), found[1])
                index += 1
            partial.rename(folder)
        return sorted(folder.iterdir())
    return write


CAPTURES = {
    "office": room("office", 1),
    "living": room("living", 0),
    "fox": Capture(lambda data, _: sorted((data / "fox" / "images").iterdir()),
                   by_stem(lambda data: reference_poses(data / "fox")), metric=False, half=0),
    # 492 frames: of every fourth one, every 4th to 16th
    "trident": Capture(filmed("walks/trident_desk/video.mp4", 4), by_stem(trident_poses),
                       metric=False, half=1),
    "hololens": Capture(
        filmed("walks/hololens_walk/video.mp4", 1),
        by_stem(lambda data: reference_poses(data / "walks" / "hololens_walk" / "poses.txt")),
        metric=True, half=0),
}


@dataclass(frozen=True)
class Errors:
    """How far the cameras of a model are off, centre by centre."""

    names: tuple[str, ...]
    off: NDArray[np.float64]  # [F], units of the reference
    extent: float  # diagonal of the box around the true centres
    verdict: ModelVerdict

    @property
    def rms(self) -> float:
        """Percent of the extent."""
        return 100 * float(np.sqrt((self.off**2).mean())) / self.extent

    @property
    def worst(self) -> float:
        """Percent of the extent."""
        return 100 * float(self.off.max()) / self.extent

    @property
    def ratios(self) -> NDArray[np.float64]:
        """How many times as far off the cameras are as the verdict thinks, [F]."""
        thought = np.array([self.verdict.camera_errors.get(name, np.nan) for name in self.names])
        return self.off / self.extent / thought


@dataclass(frozen=True)
class Row:
    """A thinned capture, and what became of it."""

    capture: str
    gap: int
    offset: int
    given: int
    parts: tuple[Errors, ...]  # that are delivered; of a refused one, its model
    refused: str  # why; empty where it is delivered
    seconds: float

    @property
    def judged(self) -> bool:
        """Whether there is a model to be right or wrong about."""
        return bool(self.parts)

    @property
    def rms(self) -> float:
        """Of the part that is off most, percent of its extent."""
        return max((part.rms for part in self.parts), default=float("nan"))

    @property
    def rough(self) -> int:
        """Cameras that are said to be rough."""
        return sum(len(part.verdict.rough) for part in self.parts)

    def cells(self, metric: bool) -> list[str]:
        """The cells of its row."""
        centres = " + ".join(
            f"{len(part.names)}: {part.rms:.2f} / {part.worst:.2f}" + (
                f" ({100 * np.sqrt((part.off**2).mean()):.2f} / {100 * part.off.max():.2f} cm)"
                if metric else "") for part in self.parts)
        thought = " + ".join(f"{100 * measure_rms(part.verdict.camera_errors):.2f}"
                             for part in self.parts)
        return [self.capture, str(self.gap), str(self.offset),
                f"{sum(len(part.names) for part in self.parts)} of {self.given}", centres or "-",
                thought or "-", "refused" if self.refused else "trusted", str(self.rough),
                f"{self.seconds:.0f}",
                self.refused[:90]]


HEADS = ("capture", "every", "from", "placed", "RMS / worst %", "thought %", "verdict", "rough",
         "CPU s", "why")


def measure(candidate: ModelCandidate, sources: dict[str, str], truth: Poses) -> Errors:
    """Returns the errors of a model's cameras after the similarity that fits best."""
    model = candidate.model
    found = {image.name: image.projection_center()
             for image in map(model.image, model.reg_image_ids())
             if Path(sources[image.name]).stem in truth}
    names = tuple(sorted(found))
    true = np.array([truth[Path(sources[name]).stem][:3, 3] for name in names])
    ours = np.array([found[name] for name in names])
    scale, motion = similarity(ours, true)
    off = np.linalg.norm(scale * ours @ motion[:3, :3].T + motion[:3, 3] - true, axis=1)
    return Errors(names, off, float(np.linalg.norm(np.ptp(true, axis=0))), candidate.verdict)


def prepare(photos: Sequence[Path], folder: Path) -> MappingJob:
    """Ingests photos as a user does; quick where that is done."""
    if not (folder / records.LIST).exists():
        shutil.rmtree(folder, ignore_errors=True)
        given = folder.parent / f"{folder.name}.photos"
        shutil.rmtree(given, ignore_errors=True)
        given.mkdir(parents=True)
        folder.mkdir()
        for photo in photos:
            (given / photo.name).symlink_to(photo.resolve())
        ingest.run(IngestConfig(), StageInputs(sources=(given,)), folder,
                   StageContext(threads=1, progress=NullProgress()))
        shutil.rmtree(given)
    tracks, frames = folder / TRACKS, records.read_frame_list(folder)
    return mapping_job(folder, folder / "sfm", partial=True, times=_times(frames, tracks),
                       tracks=tracks if tracks.exists() else None)


def keep_candidate(kept: Path) -> None:
    """Makes sfm keep the model that it decides on, and the matches behind it, in a folder."""
    def deliver(job: MappingJob, model: ModelCandidate, others: Sequence[
            pycolmap.Reconstruction] = ()) -> list[ModelCandidate]:
        for name, each in (("model", model.model), *(
                (f"others/{index}", other) for index, other in enumerate(others))):
            (kept / name).mkdir(parents=True, exist_ok=True)
            write_model(each, kept / name)
        shutil.copyfile(job.database, kept / MATCHES)
        (kept / "rejected.json").write_text(
            json.dumps(dict(model.rejected)), encoding="utf-8")
        return trusted_part.deliver_parts(job, model, others)

    fallbacks.deliver_parts = deliver


def map_photos(job: MappingJob, folder: Path, *, bridges: bool) -> None:
    """Maps a job and keeps what it found, and the time that it took."""
    shutil.rmtree(job.out, ignore_errors=True)
    shutil.rmtree(folder / CANDIDATE, ignore_errors=True)
    job.out.mkdir()
    keep_candidate(folder / CANDIDATE)
    start, refused = time.process_time(), ""
    try:
        with mock.patch.object(xfeat_weights, "are_installed", return_value=bridges):
            worker.work(job, quiet())
    except ReconError as error:
        refused = error.message
    (folder / RESULT).write_text(json.dumps(
        {"seconds": time.process_time() - start, "refused": refused}), encoding="utf-8")
    shutil.rmtree(job.out)


def decide(job: MappingJob, kept: Path) -> tuple[list[ModelCandidate], str]:
    """Returns the parts that sfm delivers of a kept model, or that and why it is refused."""
    job = dataclasses.replace(job, matches_db=kept / MATCHES)
    model = pycolmap.Reconstruction(kept / "model")
    others = [pycolmap.Reconstruction(path) for path in sorted((kept / "others").glob("*"))]
    verdict = examine(model, job.database, job.names, sharpness=job.sharpness, times=job.times,
                      lenses=job.unknown_lenses)
    held = [{each.image(i).name for i in each.reg_image_ids()} for each in (model, *others)]
    apart = tuple(tuple(sorted(names - held[0])) for names in held[1:])
    candidate = ModelCandidate(model, verdict, apart, read_json(kept / "rejected.json"))
    try:
        return trusted_part.deliver_parts(job, candidate, others), ""
    except ReconError as error:
        return [candidate], error.message


def run(
    name: str, gap: int, offset: int, data: Path, out: Path, *, bridges: bool = False
) -> Row:
    """Maps a thinned capture, or takes what an earlier run kept, and decides."""
    capture = CAPTURES[name]
    folder = (out / name / f"every{gap}_from{offset}{'_bridged' * bridges}").resolve()
    photos = capture.photos(data, out / name / "frames")[offset::gap]
    job = prepare(photos, folder)
    if not (folder / RESULT).exists():
        map_photos(job, folder, bridges=bridges)
    result = read_json(folder / RESULT)
    models, refused = decide(job, folder / CANDIDATE) if (
        folder / CANDIDATE).exists() else ([], result["refused"])
    frames = records.read_frame_list(folder).frames
    truth, sources = capture.truth(data), {frame.name: frame.source for frame in frames}
    return Row(name, gap, offset, len(photos),
               tuple(measure(model, sources, truth) for model in models), refused,
               result["seconds"])


def count(rows: Sequence[Row]) -> str:
    """Returns how many are trusted though wrong, and refused though right."""
    wrong = [row for row in rows if row.judged and row.rms > WRONG]
    right = [row for row in rows if row.judged and row.rms < RIGHT]
    trusted = [row for row in wrong if not row.refused]
    silent = [row for row in trusted if not row.rough]
    refused = [row for row in right if row.refused]
    ratios = np.concatenate([part.ratios for row in rows for part in row.parts] or [np.zeros(0)])
    known = ratios[np.isfinite(ratios)]
    shares = ", ".join(f"{np.percentile(known, share):.1f}" for share in (50, 75, 90)) if len(
        known) else "-"
    return (f"over {WRONG:g}% of the extent and trusted: {len(trusted)} of {len(wrong)}, "
            f"{len(silent)} of them without a rough camera; cameras off by times what is thought "
            f"(50, 75, 90%): {shares}; under {RIGHT:g}% and refused: {len(refused)} of "
            f"{len(right)}; without a model: "
            f"{sum(not row.judged for row in rows)} of {len(rows)}")


def count_placed(rows: Sequence[Row]) -> str:
    """Returns the share of the given photos that lie in trusted parts under RIGHT, by gap."""
    shares = []
    for gap in sorted({row.gap for row in rows}):
        own = [row for row in rows if row.gap == gap]
        placed = sum(len(part.names) for row in own for part in row.parts
                     if not row.refused and part.rms < RIGHT)
        shares.append(f"{gap}: {placed} of {sum(row.given for row in own)}")
    return ", ".join(shares)


@click.command(help=__doc__)
@click.argument("data", type=FOLDER)
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", nargs=-1)
@click.option("--gap", "gaps", type=int, multiple=True, default=GAPS, help="Every so many photos.")
@click.option("--bridge", "bridges", is_flag=True,
              help="Map with learned features as well, in further columns (`recon setup bridge`).")
@click.option("--again", is_flag=True, help="Decide on what is kept; map nothing.")
def main(data: Path, out: Path, names: tuple[str, ...], gaps: tuple[int, ...],
         bridges: bool, again: bool) -> None:
    """Prints the table and the counts."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pycolmap.logging.minloglevel = 2
    rows: dict[bool, list[Row]] = {False: [], True: []}
    print_head(*HEADS, *(f"bridged: {head}" for head in HEADS[3:] if bridges))
    for name in names or CAPTURES:
        for gap in gaps:
            for place in range(OFFSETS):
                offset = place * gap // OFFSETS
                if again and not (out / name / f"every{gap}_from{offset}" / RESULT).exists():
                    continue
                cells: list[str] = []
                for bridged in (False, True)[:1 + bridges]:
                    row = run(name, gap, offset, data, out, bridges=bridged)
                    rows[bridged].append(row)
                    cells += row.cells(CAPTURES[name].metric)[3 * bridged:]
                print_row(*cells)
    for bridged, found in rows.items():
        if not found:
            continue
        head = "with bridges, " * bridged
        for half in (0, 1):
            own = [row for row in found if CAPTURES[row.capture].half == half]
            click.echo(f"{head}half {half}: {count(own)}")
        click.echo(f"{head}all: {count(found)}")
        click.echo(f"{head}placed and right, by gap: {count_placed(found)}")


if __name__ == "__main__":
    main()
