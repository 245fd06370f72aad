"""One model of segments that were mapped apart; see `segments` and `segment_joins`.

Features and matches are those of the segments; frames of two segments that look alike are matched
besides, and, once the segments lie beside each other, frames that should see the same. What then
agrees with the cameras is triangulated anew and adjusted as a whole, as `skeleton` does.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.tracks import Tracks
from recon_cli.scene.covisibility import cut_graph
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.features.keyframes import choose_keyframes, name_keyframes
from recon_cli.sfm.features.pair_checks import check_pairs, list_views
from recon_cli.sfm.job import MappingJob, Reporter, fresh_folder
from recon_cli.sfm.limits import LOOP_CANDIDATES, MAX_RESIDUAL, NEAR_FRAMES
from recon_cli.sfm.mapping import mapper, merge_models, skeleton
from recon_cli.sfm.model_arrays import Pair, registered_images
from recon_cli.sfm.results import MatchesResult, SplitResult
from recon_cli.sfm.segments.loop_closure import Node, move_frames, optimize_segments
from recon_cli.sfm.segments.segment_joins import (
    Join,
    Placement,
    judge_join,
    place_segments,
)
from recon_cli.sfm.segments.segments import overlap
from recon_cli.sfm.segments.shared_points import (
    Segment,
    SharedPoints,
    choose_owners,
    describe_segment,
    find_shared_points,
)
from recon_cli.sfm.segments.view_overlap import overlapping_images
from recon_cli.workspace import atomic

REPORT = "segments.json"  # in the stage's folder: the segments, and the evidence of their joins
MODEL_FOLDER = "parts/1"
# Frames of other segments that each is matched with because it should see the same, those that look
# alike included. Segments are rigid already: on 1,200 frames, 8 besides those end at an error of
# .106% of the extent in 1,621 CPU seconds, 4 with them at .112% in 1,422.
OVERLAPPING_SEGMENTS = 4


def collect_features(job: MappingJob) -> None:
    """Copies the features of the segments into the database of the capture."""
    paths = [job.segment(index) / "database.db" for index in range(len(job.segments))]
    sources = [path for path in paths if _is_intact(job, path)]
    with pycolmap.Database.open(job.database) as opened, pycolmap.DatabaseTransaction(opened):
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for path in sources:
            with pycolmap.Database.open(path) as source:
                for image in source.read_all_images():
                    number = numbers[image.name]
                    if opened.exists_descriptors(number) or not source.exists_descriptors(
                            image.image_id):
                        continue
                    _copy_features(source, image.image_id, opened, number)


def _copy_features(
    source: pycolmap.Database, index: int, target: pycolmap.Database, number: int
) -> None:
    write = (target.update_keypoints if target.exists_keypoints(number)
             else target.write_keypoints)
    write(number, source.read_keypoints(index))
    target.write_descriptors(number, source.read_descriptors(index))


def _is_intact(job: MappingJob, path: Path) -> bool:
    names = set(job.segments[int(path.parent.name)])
    groups = sum(bool(names.intersection(group.names)) for group in job.groups)
    return path.exists() and database.is_sound(path, sorted(names), groups)


def collect_matches(job: MappingJob) -> None:
    """Copies the matches of the segments into the database of the capture."""
    for index in range(len(job.segments)):
        path = job.segment(index) / "database.db"
        if _is_intact(job, path):
            copy_matches(path, job.database)


def copy_matches(path: Path, target: Path, names: Sequence[str] | None = None) -> None:
    """Copies the pairs of images of a database that another one, with the same features, lacks.

    `names` are the images of the other one where it has only some.
    """
    wanted = database.pair_names(path) - database.pair_names(target)
    if names is not None:
        inside = set(names)
        wanted = {pair for pair in wanted if inside.issuperset(pair)}
    with (pycolmap.Database.open(path) as source, pycolmap.Database.open(target) as opened,
          pycolmap.DatabaseTransaction(opened)):
        there = {image.image_id: image.name for image in source.read_all_images()}
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        geometries = {}
        for number, geometry in zip(*source.read_two_view_geometries(), strict=True):
            first, second = (there[index] for index in pycolmap.pair_id_to_image_pair(number))
            geometries[first, second] = geometry
        for pair in sorted(wanted):
            ordered = pair if pair in geometries else pair[::-1]
            geometry = geometries.get(ordered, pycolmap.TwoViewGeometry())
            first, second = (numbers[name] for name in ordered)
            opened.write_matches(
                first, second, np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2))
            opened.write_two_view_geometry(first, second, geometry)


def match_segments(job: MappingJob, report: Reporter) -> MatchesResult:
    """Matches frames of different segments that look alike, besides what segments have matched."""
    collect_matches(job)
    known = _inner_pairs(job.segments)
    near, names = skeleton.near_pairs(job, NEAR_FRAMES), job.names
    if job.tracks is not None:  # segments have matched what lies near each other
        near, names = near - known, name_keyframes(Tracks.read(job.tracks))
    pairs = near | matching.similar_pairs(
        job.database, names, seed=job.seed, nearest=LOOP_CANDIDATES, besides=known)
    matching.match_pairs(job, pairs, report)
    matching.check_motion(job)
    return matching.count_matches(job)


def _inner_pairs(segments: Sequence[Sequence[str]]) -> set[Pair]:
    """Returns the pairs of frames within a segment."""
    return {pair for names in segments for pair in itertools.combinations(sorted(names), 2)}


def split_by_view_graph(job: MappingJob) -> SplitResult:
    """Cuts the frames of a job into segments where few matches tie them.

    Each also gets the frames of others that most of its matches lead to. The features and matches
    of each are written into a database in its folder.
    """
    names, count = job.names, job.split
    row = {name: index for index, name in enumerate(names)}
    weights = np.zeros((len(names), len(names)))
    for (first, second), geometry in matching.read_verified(job.database).items():
        weights[row[first], row[second]] = len(geometry.inlier_matches)
    weights += weights.T
    labels = cut_graph(weights, count)
    common = overlap(len(names), count)
    segments = []
    for index in range(count):
        inside = labels == index
        ties = np.where(inside, 0.0, weights[inside].sum(axis=0))
        others = np.argsort(-ties, kind="stable")[:common]
        chosen = inside.copy()
        chosen[others[ties[others] > 0]] = True
        segments.append([names[number] for number in np.flatnonzero(chosen)])
    job = dataclasses.replace(job, segments=tuple(map(tuple, segments)))
    for index in range(count):
        _seed_database(job, index)
    return SplitResult(segments=job.segments)


def _seed_database(job: MappingJob, index: int) -> None:
    """Writes the database of a segment, with the features and matches of the capture."""
    names, folder = job.segments[index], fresh_folder(job.segment(index))
    segment = dataclasses.replace(job, out=folder, groups=tuple(
        dataclasses.replace(group, names=inside) for group in job.groups
        if (inside := tuple(name for name in group.names if name in set(names)))))
    matching.create_database(segment)
    with (pycolmap.Database.open(job.database) as source,
          pycolmap.Database.open(segment.database) as target,
          pycolmap.DatabaseTransaction(target)):
        there = {image.name: image.image_id for image in source.read_all_images()}
        for image in target.read_all_images():
            _copy_features(source, there[image.name], target, image.image_id)
    copy_matches(job.database, segment.database, names)
    database.record_rows(segment.database)


def read_segments(job: MappingJob) -> list[Segment]:
    """Returns the segments that have a model."""
    return [
        describe_segment(index, pycolmap.Reconstruction(job.segment(index) / MODEL_FOLDER))
        for index in range(len(job.segments))
        if (job.segment(index) / MODEL_FOLDER / "images.bin").exists()]


@dataclass(frozen=True, eq=False)
class SegmentGroup:
    """Segments that joins hold together, each frame with its motion to a common frame."""

    poses: Mapping[Node, Similarity]
    refused: tuple[str, ...]  # joins that were not made, in words

    @property
    def indices(self) -> list[int]:
        """The segments, sorted."""
        return sorted({index for index, _ in self.poses})


def join_all(
    segments: Sequence[Segment], common: Sequence[SharedPoints],
    walk: Mapping[Pair, pycolmap.TwoViewGeometry] | None, *, seed: int,
) -> tuple[list[Join], list[SegmentGroup]]:
    """Returns what segments say of each other by their common points, and the groups that follow.

    `walk` are the verified matches of a video, whose segments drift: a pose graph joins them;
    None for photos, whose segments stay as they are.
    """
    cameras = {segment.index: segment.cameras for segment in segments}
    joins = [judge_join(shared, cameras[shared.first], cameras[shared.second], seed=seed)
             for shared in common]
    if walk is None:
        return joins, [_place_rigid(segments, placement)
                       for placement in place_segments(cameras, joins)]
    while True:
        groups, torn = [], set()
        for placement in place_segments(cameras, joins, with_graph=True):
            optimized = optimize_segments(segments, placement.poses, common, walk, seed=seed)
            groups.append(SegmentGroup(optimized.poses, placement.refused))
            torn |= {pair for pair, off in optimized.residuals.items() if off > MAX_RESIDUAL}
        if not torn:
            return joins, groups
        joins = [dataclasses.replace(
            join, motion=None, contradictions=(
                *join.contradictions, "no poses of the two bring their common frames together"))
            if (join.first, join.second) in torn else join for join in joins]


def _place_rigid(segments: Sequence[Segment], placement: Placement) -> SegmentGroup:
    return SegmentGroup(
        {(segment.index, name): placement.poses[segment.index] for segment in segments
         if segment.index in placement.poses for name in segment.cameras.names},
        placement.refused)


@dataclass(frozen=True, eq=False)
class JoinedModel:
    """Segments in one frame; each image belongs to the segment that shows most of it."""

    parts: tuple[tuple[pycolmap.Reconstruction, frozenset[str]], ...]  # with the images they own

    @property
    def poses(self) -> dict[str, pycolmap.Rigid3d]:
        """World to camera by name of the image."""
        return {image.name: image.cam_from_world()
                for model, names in self.parts for image in _images(model, names)}


def join_models(segments: Sequence[Segment], group: SegmentGroup) -> JoinedModel:
    """Returns the segments of a group, their models copied and moved."""
    members = [segment for segment in segments if segment.index in group.indices]
    owner = choose_owners(members)
    return JoinedModel(tuple(
        (move_frames(segment.model, {
            name: group.poses[segment.index, name] for name in segment.cameras.names}),
         frozenset(name for name, which in owner.items() if which is segment))
        for segment in members))


def map_joined(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the model of the largest group of segments, and after it those of the other groups.

    `job.matches_db` names the database that is written and mapped from, where there are tracks.
    """
    largest, *others = _join(job, report)
    source = dataclasses.replace(job, matches_db=None)
    fitted = _fit(job, largest)
    if job.tracks is not None:
        fitted = skeleton.close_loops(job, report, fitted)
    return [fitted, *(_posed(source, other) for other in others)]


def _join(job: MappingJob, report: Reporter) -> list[JoinedModel]:
    """Returns the groups of segments, and writes what joined them; what else was read is freed."""
    source = dataclasses.replace(job, matches_db=None)
    report.phase("joining", len(job.segments))
    collect_matches(source)
    segments = read_segments(job)
    joins, groups, known = _join_by_matches(source, segments)
    others = _overlapping(source, join_models(segments, groups[0]), known)
    if others - database.pair_names(source.database):
        matching.match_pairs(source, others, report)
        database.record_rows(source.database)
        joins, groups, _ = _join_by_matches(source, segments)
    report.phase("joining", len(job.segments))
    atomic.write_json(job.out / REPORT, _describe(job, joins, groups))
    return [join_models(segments, group) for group in groups]


def _join_by_matches(
    job: MappingJob, segments: Sequence[Segment]
) -> tuple[list[Join], list[SegmentGroup], set[Pair]]:
    """Returns joins and groups by all matches so far, and the pairs that show common points."""
    geometries = matching.read_verified(job.database)
    common = find_shared_points(segments, geometries)
    joins, groups = join_all(
        segments, common, None if job.tracks is None else geometries, seed=job.seed)
    return joins, groups, {(min(pair), max(pair)) for shared in common for pair in shared.pairs}


def _overlapping(job: MappingJob, joined: JoinedModel, known: Collection[Pair]) -> set[Pair]:
    """Returns pairs of frames of different segments that should see the same, besides known ones.
    """
    held: dict[str, set[int]] = defaultdict(set)
    for index, names in enumerate(job.segments):
        for name in names:
            held[name].add(index)
    chosen = held if job.tracks is None else set(name_keyframes(Tracks.read(job.tracks)))
    owned = [(image, model) for model, names in joined.parts for image in _images(model, names)
             if image.name in chosen]
    return overlapping_images(
        [image for image, _ in owned], [model for _, model in owned], held,
        most=OVERLAPPING_SEGMENTS, besides=known)


def _images(model: pycolmap.Reconstruction, names: frozenset[str]) -> list[pycolmap.Image]:
    return [image for image in registered_images(model) if image.name in names]


def _posed(job: MappingJob, joined: JoinedModel) -> pycolmap.Reconstruction:
    """Returns a model without points; the intrinsics are the mean of those of the segments."""
    model = merge_models.build_posed_model(job.database, None, joined.poses)
    held: dict[int, list[NDArray[np.float64]]] = defaultdict(list)
    cameras = {image.name: image.camera_id for image in model.images.values()}
    for part, names in joined.parts:
        for image in _images(part, names):
            held[cameras[image.name]].append(np.asarray(image.camera.params))
    for number, params in held.items():
        model.camera(number).params = np.mean(params, axis=0)
    return model


def _fit(job: MappingJob, joined: JoinedModel) -> pycolmap.Reconstruction:
    """Returns the cameras of joined segments with the points that all matches give, adjusted."""
    source = dataclasses.replace(job, matches_db=None)
    if job.matches_db is not None:
        geometries = matching.read_verified(source.database)
        checked = check_pairs(source.database, list_views(joined.parts), geometries)
        usable = {pair: geometry for pair, geometry in geometries.items()
                  if pair not in checked.contradicting}
        assert job.tracks is not None
        tracks = Tracks.read(job.tracks)
        skeleton.write_usable_matches(
            job, source.database, usable, tracks, choose_keyframes(tracks))
    model = mapper.triangulate(job, _posed(job, joined), rounds=1)
    if model.num_reg_images() < len(job.names):
        model = mapper.extend_model(job, model, rounds=0)
    mapper.refine(job, model, skeleton.REST_ROUNDS)
    return model


def describe_refused_joins(job: MappingJob) -> tuple[str, ...]:
    """Returns which joins of segments were not made, a sentence each; none without segments."""
    if not job.segments or not (job.out / REPORT).exists():
        return ()
    refused: list[str] = atomic.read_json(job.out / REPORT, dict)["refused"]
    return tuple(f"{text[:1].upper()}{text[1:]}." for text in refused)


def _describe(
    job: MappingJob, joins: Sequence[Join], groups: Sequence[SegmentGroup]
) -> dict[str, object]:
    return {
        "segments": [list(names) for names in job.segments],
        "groups": [group.indices for group in groups],
        "refused": [text for group in groups for text in group.refused],
        "joins": [{
            "segments": [join.first, join.second],
            "made": any({join.first, join.second} <= set(group.indices) for group in groups),
            "scale": None if join.motion is None else join.motion.scale,
            "witnesses": join.witnesses, "contradictions": join.contradictions}
            for join in joins]}

