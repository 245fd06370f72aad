"""Photos that follow each other, such as the frames of a video that somebody has dumped.

Names say in which order they may have been taken, and the pictures whether they were: where nearly
all neighbours show the same corners, the photos are a walk with steps of any size. It is scanned
and thinned by the means of videos. Photos that were taken one by one, on purpose, are left as they
are.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags

from recon_cli.capture.frame_measures import MotionMeter, measure_exposure, measure_sharpness
from recon_cli.capture.frame_selection import MIN_AUTOMATIC
from recon_cli.capture.images import Photo, open_image, read_gray
from recon_cli.capture.ingested_source import IngestContext
from recon_cli.capture.lens_border import BorderMeter
from recon_cli.capture.photos import group_photos
from recon_cli.capture.scan import Scan
from recon_cli.capture.strangers import find_strangers
from recon_cli.capture.tiff import WHITE
from recon_cli.capture.tracker import Tracker
from recon_cli.capture.unreadable import BROKEN
from recon_cli.errors import InputError
from recon_cli.io.tracks import merge_tracks
from recon_cli.progress import Bar
from recon_cli.workspace.json_record import JsonRecord, sha256_json
from recon_cli.workspace.steps import StepFolder, log_path

# A photo follows another where it still shows this share of the other's corners, and so do nearly
# all photos of a sequence. .94 to 1 of them do in every third and fifth frame of six walks, .56 in
# photos of lockers in the order of their names, .03 to .20 in any order.
FOLLOWED, SEQUENCE_SHARE = 0.1, 0.8
# The same of photos that a camera has named. It is .7 in the median of photos that were taken in
# small steps around a table, .85 to .95 in all frames of a video.
CAMERA_FOLLOWED = 0.8
# Photos in a row that may belong to another scene; more are a walk of their own.
MOST_ASTRAY = 3
FEW_SHARE = 0.1  # of the photos: at most so many are looked at as out of place
# Time from one photo to the next, of a walk and of one so dense that photos can be spared: bursts
# take three a second and more, interval timers and drones at most two. It is the median over many
# photos, as EXIF and many names count whole seconds.
MAX_SECONDS, DENSE_SECONDS, SPAN = 1.0, 0.4, 20
_NUMBER = re.compile(r"\d+")
# Names that cameras give to single photos (JEITA CP-3461, DCF): four characters and a number.
_CAMERA_NAME = re.compile(r"(?=.{0,3}[A-Z_])[A-Z0-9_]{4}\d{4}")
_MOMENT = re.compile(r"(?<!\d)(\d{8})[-_]?(\d{6})(?:[-_.]?(\d{3}))?(?!\d)")


@dataclass(frozen=True, eq=False)
class PhotoSequence:
    """The photos of a folder that are sequences, one after the other."""

    places: tuple[int, ...]  # [F], of the photos that follow each other, among all of the folder
    scan: Scan  # of these
    strangers: tuple[int, ...]  # photos in between that show something else, by place

    def among(self, kept: Sequence[int]) -> PhotoSequence:
        """Returns the sequence among fewer photos, which hold all of it, given by place."""
        now = {place: index for index, place in enumerate(kept)}
        return replace(self, places=tuple(now[place] for place in self.places), strangers=())


@dataclass(frozen=True)
class _SequencePlaces(JsonRecord):
    """What a sequence has besides its scan."""

    places: tuple[int, ...]
    strangers: tuple[int, ...]


def find_sequence(
    photos: Sequence[Photo], scan_file: Path, ctx: IngestContext, *, white: int = WHITE
) -> PhotoSequence | None:
    """Returns the scan of those photos that follow each other; None where none do.

    `scan_file` in the folder of a stage keeps it for the next run; `white` is that of photos with
    16 bits.
    """
    out, step = scan_file.parent, f"sequence of {scan_file.name}"
    steps = StepFolder(out, log_path(out), key=sha256_json([photo.name for photo in photos]))
    known = steps.find(step, _SequencePlaces)
    if known is not None:
        return PhotoSequence(known.places, Scan.read(scan_file), known.strangers)
    runs = list_runs(photos)
    parts: list[PhotoSequence] = []
    if runs:
        with ctx.progress.bar("scan", sum(map(len, runs)), unit="photo") as bar:
            found = (_scan_run(photos, run, white, bar) for run in runs)
            parts = [part for part in found if part is not None]
    if not parts:
        return None
    sequence = _join(parts)
    sequence.scan.write(scan_file)
    steps.finish(step, _SequencePlaces(sequence.places, sequence.strangers), [scan_file])
    return sequence


def list_runs(photos: Sequence[Photo]) -> list[list[int]]:
    """Returns the photos whose names may be in the order in which they were taken, by place.

    The photos of a run are of one camera and folder, and their names differ in numbers alone. Too
    few to leave any out, or taken more than a second apart, they are not a run.
    """
    camera = {photo.name: index for index, group in enumerate(group_photos(photos))
              for photo in group.photos}
    runs: dict[tuple[str, str, int], list[int]] = {}
    for place, photo in enumerate(photos):
        pattern = _NUMBER.sub("#", photo.path.stem)
        if "#" in pattern and not photo.is_raw:
            home = str(PurePosixPath(photo.name).parent)
            runs.setdefault((home, pattern, camera[photo.name]), []).append(place)
    return [run for run in runs.values() if len(run) > MIN_AUTOMATIC and (
        _usual_seconds([photos[place] for place in run]) or 0) <= MAX_SECONDS]


def is_dense(photos: Sequence[Photo]) -> bool:
    """Returns whether photos that follow each other may have been taken fast enough to spare some.
    """
    return (_usual_seconds(photos) or 0) <= DENSE_SECONDS


def _usual_seconds(photos: Sequence[Photo]) -> float | None:
    """Returns the time from one photo to the next; None where most do not say when they are of."""
    times = [time for photo in photos if (time := _read_time(photo)) is not None]
    if 2 * len(times) <= len(photos):
        return None
    return float(np.median([abs((after - before).total_seconds()) / SPAN
                            for before, after in zip(times, times[SPAN:], strict=False)]))


def _least_followed(photos: Sequence[Photo]) -> float:
    """Returns the share of its corners that one photo must share with the next."""
    by_camera = all(_CAMERA_NAME.fullmatch(photo.path.stem) for photo in photos)
    return CAMERA_FOLLOWED if by_camera and _usual_seconds(photos) is None else FOLLOWED


def _read_time(photo: Photo) -> datetime | None:
    """Returns when a photo was taken, by its name, else by EXIF; None where neither says it."""
    moment = _MOMENT.search(photo.path.stem)
    try:
        if moment is not None:
            date, time, part = moment.groups()
            return datetime.strptime(f"{date}{time}{part or '000'}", "%Y%m%d%H%M%S%f")
        with open_image(photo.path) as image:
            detail = image.getexif().get_ifd(ExifTags.IFD.Exif)
        return datetime.strptime(
            str(detail.get(ExifTags.Base.DateTimeOriginal)), "%Y:%m:%d %H:%M:%S")
    except BROKEN:  # a ValueError where it is not a time
        return None


def _scan_run(
    photos: Sequence[Photo], run: Sequence[int], white: int, bar: Bar
) -> PhotoSequence | None:
    """Returns the scan of a run, without photos that show something else; None if it is none."""
    def read(place: int) -> NDArray[np.uint8]:
        return read_gray(photos[place], white)

    def grays(places: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        for place in places:
            with suppress(InputError):  # it is named when it is to be stored
                yield place, read(place)

    least = _least_followed([photos[place] for place in run])
    measured = measure_sequence(grays(run), len(run), least=least, step=bar.advance)
    if measured is None:
        return None
    astray = [measured.places[index] for index in measured.list_astray()]
    others = sorted(set(measured.places) - set(astray))
    strangers = find_strangers(astray, others, read) if others else []
    if strangers:
        measured = measure_sequence(
            grays([place for place in measured.places if place not in strangers]), len(run),
            least=least)
        assert measured is not None, "a sequence is one without interruptions"
    photo = photos[measured.places[0]]
    return PhotoSequence(
        tuple(measured.places), measured.scan(photo.width, photo.height), tuple(strangers))


class MeasuredPhotos:
    """Measures of gray photos, one after the other, as of the frames of a video."""

    def __init__(self, least: float = FOLLOWED) -> None:
        self._least = least
        self.places: list[int] = []
        self.follows: list[bool] = []  # whether a photo shows what the one before shows
        self._meter, self._tracker, self._border = MotionMeter(), Tracker(), BorderMeter()
        self._rows: list[tuple[float, float, tuple[float, float, float]]] = []

    def add(self, place: int, gray: NDArray[np.uint8]) -> None:
        """Measures the next photo, [H, W]; all are of one size."""
        before = self._tracker.corners[0] if self.places else None
        self._tracker.advance(gray)
        if before is not None:
            shared = np.intersect1d(before, self._tracker.corners[0], assume_unique=True)
            self.follows.append(bool(len(before)) and len(shared) >= self._least * len(before))
        self.places.append(place)
        self._border.advance(gray)
        self._rows.append(
            (measure_sharpness(gray), self._meter.advance(gray), measure_exposure(gray)))

    def list_astray(self) -> list[int]:
        """Returns the photos, a few in a row at most, that follow no other and that none follows.

        They are given as indices of `places`.
        """
        starts = [0, *(index + 1 for index, follows in enumerate(self.follows) if not follows)]
        ends = [*starts[1:], len(self.places)]
        return [index for start, end in zip(starts, ends, strict=True)
                if end - start <= MOST_ASTRAY for index in range(start, end)]

    def scan(self, width: int, height: int) -> Scan:
        """Returns the measures as the scan of a video of upright frames of this size."""
        sharpness, motion, exposure = zip(*self._rows, strict=True)
        count = len(self.places)
        return Scan(
            width=width, height=height, declared=count, gaps=0,
            sharpness=np.array(sharpness, np.float64), motion=np.array(motion, np.float64),
            exposure=np.round(self._border.without_border(np.array(exposure)), 4),
            seconds=(None,) * count,
            intact=np.ones(count, np.bool_), tracks=self._tracker.tracks(), overlay=None,
            notices=())


def measure_sequence(
    grays: Iterator[tuple[int, NDArray[np.uint8]]], count: int,
    *, least: float = FOLLOWED, step: Callable[[], object] = lambda: None,
) -> MeasuredPhotos | None:
    """Returns the measures of up to `count` gray photos if they follow each other, else None.

    Neighbours share at least the share `least` of their corners. It stops reading as soon as too
    many do not; `step` is called for each.
    """
    measured = MeasuredPhotos(least)
    for place, gray in grays:
        step()
        measured.add(place, gray)
        if measured.follows.count(False) > (1 - SEQUENCE_SHARE) * count:
            return None
    steps = measured.follows
    return measured if steps and sum(steps) >= SEQUENCE_SHARE * len(steps) else None


def _join(parts: Sequence[PhotoSequence]) -> PhotoSequence:
    """Returns sequences as one; nothing is followed from one to the next."""
    scans = [part.scan for part in parts]
    count = sum(len(part.places) for part in parts)
    scan = Scan(
        width=scans[0].width, height=scans[0].height, declared=count, gaps=0,
        sharpness=np.concatenate([scan.sharpness for scan in scans]),
        motion=np.concatenate([scan.motion for scan in scans]),
        exposure=np.concatenate([scan.exposure for scan in scans]), seconds=(None,) * count,
        intact=np.ones(count, np.bool_), tracks=merge_tracks([scan.tracks for scan in scans]),
        overlay=None, notices=())
    return PhotoSequence(
        tuple(place for part in parts for place in part.places), scan,
        tuple(place for part in parts for place in part.strangers))


def find_odd(
    photos: Sequence[Photo], followed: Collection[int], *, white: int = WHITE
) -> list[int]:
    """Returns the photos that look out of place and show nothing that the others show, by place.

    Out of place are few that no sequence holds; without one, few of another size, without EXIF.
    """
    odd = set(range(len(photos))) - set(followed) if followed else _odd_sizes(photos)
    if not odd or len(odd) > FEW_SHARE * len(photos) or any(photo.is_raw for photo in photos):
        return []
    others = [place for place in range(len(photos)) if place not in odd]

    def read(place: int) -> NDArray[np.uint8] | None:
        with suppress(InputError):  # it is named when it is to be stored
            return read_gray(photos[place], white)
        return None

    return find_strangers(odd, others, read)


def _odd_sizes(photos: Sequence[Photo]) -> set[int]:
    """Returns the photos without EXIF that are not of the usual size, upright or on its side."""
    sizes = [tuple(sorted((photo.width, photo.height))) for photo in photos]
    (usual, _), = Counter(sizes).most_common(1)
    return {place for place, (photo, size) in enumerate(zip(photos, sizes, strict=True))
            if size != usual and not photo.has_exif}
