"""First rough cameras, which show the pairs worth matching; then cameras from all that agrees.

Two frames of a video that follow each other cannot be mistaken for others, so the cameras are found
from tracks through every frame alone. With these cameras, the skeleton, each pair of frames that
matches can be checked: most agree; some are off by what the cameras drift on a long way, and close
a loop; the rest look alike but are two places, and are left out.

The cameras of the skeleton are adjusted to the matches. Where that leaves a loop open, a pose
graph closes it, and they are adjusted again.

Photos get a skeleton from the coarsest of their features. Matching only what overlaps by it takes
.4 to .7 of the time of matching all pairs, more of it the fewer photos there are.
"""

from __future__ import annotations

import io
import itertools
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.io.tracks import Tracks
from recon_cli.scene.matches import EXHAUSTIVE_MAX, MIN_PAIR_INLIERS
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.features.keyframes import (
    choose_keyframes,
    name_keyframes,
    share_tracks,
    side_pairs,
    track_rows,
)
from recon_cli.sfm.features.matching import similar_pairs
from recon_cli.sfm.features.pair_checks import check_pairs, list_models
from recon_cli.sfm.job import MappingJob, Reporter, fresh_folder, publish
from recon_cli.sfm.limits import ENOUGH_FRAMES, FEW_PAIR_MATCHES, NEAR_FRAMES
from recon_cli.sfm.mapping import mapper, merge_models
from recon_cli.sfm.model_arrays import Pair, registered_images
from recon_cli.sfm.segments.loop_closure import optimize_model
from recon_cli.sfm.segments.view_overlap import WIDEST, overlapping_pairs
from recon_cli.sfm.verdict.view_graph import components
from recon_cli.workspace.steps import StepFolder

MATCHES_DB = "linked.db"  # matches that may be used, in the folder of an attempt
# Models in the folder of the attempts: from tracks, and from the coarsest features.
SKELETON, COARSE_SKELETON = "skeleton", "skeleton.coarse"
# Distances, in frames of a video, at which tracks are matches: enough for a path around a lost
# frame. All up to 20 take twice as long; they are for videos that fall apart.
TRACK_STEPS, ALL_TRACK_STEPS = (1, 2, 3, 5, 8, 13, 20), tuple(range(1, 21))
# Adjustments with new points in between once all frames are placed, or segments joined: there, on
# 300 frames, five take a tenth longer for an error of 3.25 cm in place of 3.29.
REST_ROUNDS = 2
LOOP_ROUNDS = 2  # times that open loops are closed and the model is fitted again
# Share of the neighbours with MIN_PAIR_INLIERS tracks above which a video hangs together by them.
CONTINUOUS = 0.5
# Pairs of photos that overlap, per image: more than of frames, as they have no neighbours. 50
# frames of each of two rooms as photos: .024 and .045% of the extent with 8, .020 and .034% with
# 12, .013 and .034% with all pairs.
OVERLAPPING_PHOTOS = 12
# Pairs per image that look alike. Of some 240 on the videos of the two rooms 97% overlap by the
# skeleton, of 314 on a walk round a room 27%; without those the rooms' cameras are as exact.
SIMILAR = 5
# Keypoints of a photo, the coarsest, from which cameras are found first. Of the 1225 pairs of 50
# photos 914 are verified with 1000, 743 with 600 and 566 with 400, in 17, 10 and 4 CPU s.
COARSEST = 600


def is_continuous(job: MappingJob) -> bool:
    """Returns whether the frames of a video follow each other closely enough to be tracked."""
    if job.tracks is None:
        return False
    tracks = _read_tracks(job)
    shared = [len(tracks.matches(index, index + 1)[0]) for index in range(len(tracks.names) - 1)]
    following = sum(count >= MIN_PAIR_INLIERS for count in shared)
    return len(tracks.names) == len(job.names) and following > CONTINUOUS * len(shared)


def list_keyframes(job: MappingJob) -> tuple[str, ...]:
    """Returns the frames that matches are sought between: the keyframes of a video, else all."""
    return name_keyframes(_read_tracks(job)) if is_continuous(job) else job.names


def _read_tracks(job: MappingJob) -> Tracks:
    assert job.tracks is not None
    return Tracks.read(job.tracks)


def near_pairs(job: MappingJob, reach: int, among: Collection[str] | None = None) -> set[Pair]:
    """Returns the pairs of frames of one camera that are up to `reach` apart by name.

    Other names than those in `among` do not count.
    """
    inside = set(job.names if among is None else among)
    return {pair for group in job.groups for names in [sorted(inside.intersection(group.names))]
            for step in range(1, reach + 1) for pair in zip(names, names[step:], strict=False)}


class _Counts(Reporter):
    """Passes to another reporter how many units are done, while it is shown, and nothing else."""

    def __init__(self, report: Reporter, *, shown: bool = True) -> None:
        super().__init__(io.BytesIO())
        self._report, self.shown = report, shown

    def done(self, count: int) -> None:
        if self.shown:
            self._report.done(count)


@contextmanager
def build_beside(job: MappingJob, report: Reporter) -> Iterator[None]:
    """Builds the skeleton in a thread while something else is done, as it needs no features.

    What is left of it when that is done is shown as a phase of its own.
    """
    with ThreadPoolExecutor(1) as pool:
        # The database is about to be filled.
        images = fresh_folder(job.attempts / f"{SKELETON}.partial") / "images.db"
        shutil.copyfile(job.database, images)
        counts = _Counts(report, shown=False)
        building = pool.submit(load_skeleton, job, counts, images)
        yield
        if not building.done():
            report.phase("skeleton", len(list_keyframes(job)))
            counts.shown = True
        building.result()


def load_skeleton(
    job: MappingJob, report: Reporter, images: Path | None = None
) -> list[pycolmap.Reconstruction]:
    """Returns the models of the tracks, the largest first, and keeps them in a folder.

    `images` is the database with the images, if not that of the job.
    """
    def build() -> list[pycolmap.Reconstruction]:
        report.phase("skeleton", len(list_keyframes(job)))
        if images is not None:
            return build_skeleton(job, images, report)
        # Pairs that were matched would count against the model, but not where it is built first.
        copy = fresh_folder(job.attempts / f"{SKELETON}.partial") / "images.db"
        shutil.copyfile(replace(job, matches_db=None).database, copy)
        database.clear_matches(copy)
        return build_skeleton(job, copy, report)

    return _load_models(job, SKELETON, build)


def _load_models(
    job: MappingJob, name: str, build: Callable[[], list[pycolmap.Reconstruction]]
) -> list[pycolmap.Reconstruction]:
    """Returns the models in a folder of the attempts, and builds them where it is missing."""
    folder, finished = job.attempts / name, StepFolder(job.attempts)
    if not finished.is_intact(name):
        unfinished = fresh_folder(job.attempts / f"{name}.found")
        for index, model in enumerate(build()):
            (unfinished / str(index)).mkdir()
            write_model(model, unfinished / str(index))
        publish(unfinished, folder)
        finished.finish(name, paths=[folder])
    return [pycolmap.Reconstruction(path) for path in sorted(
        folder.iterdir(), key=lambda path: int(path.name))]


def choose_tracked_pairs(job: MappingJob, report: Reporter) -> set[Pair]:
    """Returns the pairs of frames of a video that its tracks show to be worth matching."""
    models = load_skeleton(job, report)
    tracks = _read_tracks(job)
    names = name_keyframes(tracks)
    near = near_pairs(job, NEAR_FRAMES, names)
    if len(models) > 1:
        further = near_pairs(job, matching.SEQUENTIAL_OVERLAP, names)
        whole = len(names) == len(job.names)
        near |= further if whole else share_tracks(tracks, further)
    pairs = near.union(*(overlapping_pairs(model) for model in models))
    return side_pairs(tracks) | pairs | _unexpected_pairs(job, models, pairs, names)


def _unexpected_pairs(
    job: MappingJob, models: Sequence[pycolmap.Reconstruction], pairs: Collection[Pair],
    names: Sequence[str],
) -> set[Pair]:
    """Returns pairs of frames that look alike, and that by the models have little in common.

    They may close a loop. Others would repeat what the matches of `pairs` say already.
    """
    alike = similar_pairs(job.database, names, seed=job.seed, nearest=SIMILAR, besides=pairs)
    return alike.difference(*(overlapping_pairs(model, WIDEST) for model in models))


def choose_coarse_pairs(job: MappingJob, report: Reporter) -> set[Pair]:
    """Returns the pairs of photos that their coarsest features show to be worth matching."""
    models = _load_models(job, COARSE_SKELETON, lambda: build_coarse_skeleton(job, report))
    pairs = set[Pair]().union(
        *(overlapping_pairs(model, OVERLAPPING_PHOTOS) for model in models))
    return pairs | _unexpected_pairs(job, models, pairs, job.names)


def build_coarse_skeleton(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the models that the coarsest features alone give, the largest first."""
    folder = fresh_folder(job.attempts / f"{COARSE_SKELETON}.mapping")
    coarse = replace(job, matches_db=folder / MATCHES_DB)
    copy_coarsest(job.database, coarse.database)
    pairs = matching.exhaustive_pairs(job.names)
    if len(job.names) > EXHAUSTIVE_MAX:
        pairs = matching.near_or_similar_pairs(job, job.names)
    matching.match_pairs(coarse, pairs, report, phase="coarse")
    report.phase("first", len(job.names))
    models = mapper.map_incrementally(coarse, _Counts(report))
    shutil.rmtree(folder)
    return sorted(models, key=mapper.model_size, reverse=True)


def copy_coarsest(source: Path, target: Path) -> None:
    """Copies a database without matches, and with the COARSEST keypoints of each image alone.

    Keypoints are in the order of their sizes, the coarsest first.
    """
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
        numbers = [image.image_id for image in opened.read_all_images()]
        descriptors = {number: opened.read_descriptors(number) for number in numbers}
        opened.clear_descriptors()
        for number, rows in descriptors.items():
            opened.update_keypoints(number, opened.read_keypoints(number)[:COARSEST])
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, np.asarray(rows.data)[:COARSEST]))


def build_skeleton(
    job: MappingJob, images: Path, report: Reporter
) -> list[pycolmap.Reconstruction]:
    """Returns the models that tracks alone give, the largest first; a database has the images."""
    counts = _Counts(report)
    folder = fresh_folder(job.attempts / f"{SKELETON}.mapping")
    own = replace(job, matches_db=folder / MATCHES_DB)
    tracks = _read_tracks(job)
    keyframes = choose_keyframes(tracks)
    tracks = tracks.select({row: tracks.names[row] for row in keyframes})
    rows = range(len(keyframes))
    write_usable_matches(own, images, {}, tracks, rows)
    models = mapper.map_incrementally(own, counts)
    # As tracks cannot be mistaken, lower thresholds do no harm. The global mapper gets past a turn
    # without parallax. What tracks of a long video leave apart is left to the matches.
    whole, enough = len(keyframes) == len(job.names), ENOUGH_FRAMES * len(keyframes)
    for find_models in (mapper.map_relaxed, mapper.map_globally) if whole else ():
        if _most(models) >= enough or (
                find_models is mapper.map_globally and _count_tied(own) < enough):
            break
        write_usable_matches(own, images, {}, tracks, rows, steps=ALL_TRACK_STEPS)
        models = max(models, find_models(own, counts), key=_most)
    shutil.rmtree(folder)
    models.sort(key=mapper.model_size, reverse=True)
    return models


def _count_tied(job: MappingJob) -> int:
    """Returns how many images verified pairs tie together at most, directly or not."""
    row = {name: index for index, name in enumerate(job.names)}
    ties = np.zeros((len(row), len(row)))
    for first, second in matching.read_verified(job.database):
        ties[row[first], row[second]] = 1
    return max(map(len, components(ties)))


def complete_tracked(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the models that the tracks and the matches that agree with them give.

    `job.matches_db` names the database that is written and mapped from.
    """
    models = load_skeleton(job, report)
    source = replace(job, matches_db=None).database
    tracks = _read_tracks(job)
    geometries = matching.read_verified(source)
    checked = check_pairs(source, list_models(models), geometries)
    usable = {pair: geometry for pair, geometry in geometries.items()
              if pair not in checked.contradicting}
    keyframes = choose_keyframes(tracks)
    if _most(models) >= ENOUGH_FRAMES * len(keyframes):
        write_usable_matches(job, source, usable, tracks, keyframes)
        return [_place_rest(job, close_loops(job, report, _fit(job, models[0])))]
    write_usable_matches(job, source, usable, tracks, keyframes, steps=ALL_TRACK_STEPS)
    if len(keyframes) == len(job.names):
        return mapper.map_relaxed(job, report)
    found = mapper.map_relaxed(job, report, [tracks.names[row] for row in keyframes])
    if not found:
        return []
    largest, *others = sorted(found, key=mapper.model_size, reverse=True)
    fitted = _fit_where_it_meets(job, report, largest, models)
    return [_place_rest(job, close_loops(job, report, fitted)), *others]


def close_loops(
    job: MappingJob, report: Reporter, fitted: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """Returns a fitted model with its open loops closed, fitted again to what then agrees."""
    for _ in range(LOOP_ROUNDS):
        geometries = matching.read_verified(replace(job, matches_db=None).database)
        closed = optimize_model(fitted, geometries, seed=job.seed)
        if closed is None:
            break
        fitted = _fit_where_it_meets(job, report, closed, [fitted])
    return fitted


def _fit_where_it_meets(
    job: MappingJob, report: Reporter, model: pycolmap.Reconstruction,
    before: Sequence[pycolmap.Reconstruction],
) -> pycolmap.Reconstruction:
    """Returns a model fitted to the matches of frames that overlap by it, but not by those before.

    `job.matches_db` is written anew with all that does not contradict the model.
    """
    source, tracks = replace(job, matches_db=None), _read_tracks(job)
    met = overlapping_pairs(model).difference(
        *(overlapping_pairs(other, WIDEST) for other in before))
    if met - database.pair_names(source.database):
        matching.match_pairs(source, met, report)
        database.record_rows(source.database)
        report.phase("mapping", len(job.names))
    geometries = matching.read_verified(source.database)
    checked = check_pairs(source.database, list_models([model]), geometries)
    write_usable_matches(job, source.database, {
        pair: geometry for pair, geometry in geometries.items()
        if pair not in checked.contradicting}, tracks, choose_keyframes(tracks))
    return _fit(job, model)


def complete_coarse(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the model that all matches give to the cameras of the coarsest features.

    Where these placed too few, the models that the matches give by themselves.
    """
    models = _load_models(job, COARSE_SKELETON, lambda: build_coarse_skeleton(job, report))
    if _most(models) < ENOUGH_FRAMES * len(job.names):
        return mapper.map_incrementally(job, report)
    report.phase("mapping", len(job.names))
    return [_place_rest(job, _fit(job, models[0]))]


def _most(models: Sequence[pycolmap.Reconstruction]) -> int:
    """Returns the number of images in the largest model."""
    return max((model.num_reg_images() for model in models), default=0)


def _fit(job: MappingJob, skeleton: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Returns the cameras of a skeleton with the points that the matches give, adjusted."""
    poses = {image.name: image.cam_from_world() for image in registered_images(skeleton)}
    model = mapper.triangulate(
        job, merge_models.build_posed_model(job.database, skeleton, poses), rounds=1)
    mapper.refine(job, model)
    return model


def _place_rest(job: MappingJob, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Returns a model with the frames that it lacks, adjusted: those between keyframes first."""
    if job.tracks is not None and mapper.resect(job, model):
        mapper.refine(job, model, REST_ROUNDS)
    complete = model.num_reg_images() == len(job.names)
    return model if complete else mapper.extend_model(job, model)


def write_usable_matches(
    job: MappingJob, source: Path, geometries: Mapping[Pair, pycolmap.TwoViewGeometry],
    tracks: Tracks, keyframes: Sequence[int], *, steps: Sequence[int] = TRACK_STEPS,
) -> None:
    """Writes the database `job.matches_db`: images and keypoints of another one, and these matches.

    Observations of tracks follow the keypoints of an image. Where features gave few matches, they
    tie keyframes, by row, that are so many `steps` of them apart, and others to those beside them.
    Other pairs that were matched stay in it without matches: that they should show the same,
    and do not, speaks against a model.
    """
    tried = database.pair_names(source)
    database.remove(job.database)
    shutil.copyfile(source, job.database)
    matched = _match_tracks(tracks, geometries, track_rows(keyframes, steps))
    with pycolmap.Database.open(job.database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
        opened.clear_descriptors()
        images = {image.name: image for image in opened.read_all_images()}
        if not geometries:  # the features are of no use, and perhaps not found yet
            opened.clear_keypoints()
        counts = _append_tracks(opened, images, tracks)
        for pair, geometry in geometries.items():
            first, second = (images[name].image_id for name in pair)
            if pair not in matched:
                opened.write_matches(first, second, geometry.inlier_matches)
                opened.write_two_view_geometry(first, second, geometry)
        for pair, rows in matched.items():
            first, second = (images[name].image_id for name in pair)
            followed = rows + [counts[name] for name in pair]
            features = [geometries[pair].inlier_matches] if pair in geometries else []
            opened.write_matches(
                first, second, np.concatenate([*features, followed]).astype(np.uint32))
        for pair in sorted(tried - geometries.keys() - matched.keys()):
            first, second = (images[name].image_id for name in pair)
            opened.write_matches(first, second, np.zeros((0, 2), np.uint32))
    if matched:
        matching.verify_pairs(job, matched)


def _match_tracks(
    tracks: Tracks, geometries: Mapping[Pair, pycolmap.TwoViewGeometry],
    rows: Iterable[tuple[int, int]],
) -> dict[Pair, NDArray[np.int64]]:
    """Returns which observations of two images show the same tracks, [M, 2] by row in each."""
    start = np.searchsorted(tracks.image, np.arange(len(tracks.names)))
    matched = {}
    for first, second in rows:
        pair = tracks.names[first], tracks.names[second]
        known = geometries.get(pair)
        if known is not None and len(known.inlier_matches) >= FEW_PAIR_MATCHES:
            continue
        shown = np.stack(tracks.matches(first, second), axis=1)
        if len(shown) >= MIN_PAIR_INLIERS:
            matched[pair] = shown - start[[first, second]]
    return matched


def _append_tracks(
    opened: pycolmap.Database, images: Mapping[str, pycolmap.Image], tracks: Tracks
) -> dict[str, int]:
    """Appends observations to the keypoints; returns how many keypoints each image had."""
    counts = {}
    bounds = np.searchsorted(tracks.image, np.arange(len(tracks.names) + 1))
    for name, (first, last) in zip(tracks.names, itertools.pairwise(bounds), strict=True):
        image = images[name]
        camera = opened.read_camera(image.camera_id)
        there = opened.exists_keypoints(image.image_id)
        keypoints = opened.read_keypoints(image.image_id) if there else np.zeros(
            (0, database.KEYPOINT_COLUMNS), np.float32)
        counts[name] = len(keypoints)
        followed = np.zeros((last - first, database.KEYPOINT_COLUMNS), np.float32)
        followed[:, :2] = tracks.xy[first:last] * [camera.width, camera.height]
        followed[:, [2, 5]] = 1  # a shape of one pixel
        write = opened.update_keypoints if there else opened.write_keypoints
        write(image.image_id, np.concatenate([keypoints, followed]))
    return counts
