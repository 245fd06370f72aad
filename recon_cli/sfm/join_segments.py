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
from recon_cli.sfm import database, mapper, matching, merge_models, skeleton
from recon_cli.sfm.job import MappingJob, Reporter, Result, fresh_folder
from recon_cli.sfm.pair_checks import check_pairs, list_views
from recon_cli.sfm.segment_joins import (
    Join,
    Placement,
    SegmentCameras,
    SharedPoints,
    judge_join,
    place_segments,
)
from recon_cli.sfm.segments import overlap
from recon_cli.workspace import atomic

Pair = matching.Pair

REPORT = "segments.json"  # in the stage's folder: what the segments and their joins said
MODEL_FOLDER = "parts/1"
# Frames of other segments that each is matched with because they look alike: enough to find loops,
# whose frames are matched with more of each other once the segments lie beside each other.
ALIKE = 2
# Frames of other segments that each is matched with because it should see the same, those that look
# alike included. Segments are rigid already: on 1,200 frames, 8 besides those end at an error of
# .106% of the extent in 1,621 CPU seconds, 4 with them at .112% in 1,422.
OVERLAPPING = 4
# Adjustments of the whole with new points in between; segments have settled by themselves before.
# On 300 frames five take a tenth longer for an error of 3.25 cm in place of 3.29.
ROUNDS = 2


def collect_features(job: MappingJob) -> None:
    """Copies the features that segments found into the database of the whole."""
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
    """Copies the matches that segments found into the database of the whole."""
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


def match_segments(job: MappingJob, report: Reporter) -> Result:
    """Matches frames of different segments that look alike, besides what segments have matched."""
    collect_matches(job)
    known = _inner_pairs(job.segments)
    pairs = skeleton.near_pairs(job, skeleton.ALWAYS) | matching.similar_pairs(
        job.database, job.names, seed=job.seed, nearest=ALIKE, besides=known)
    matching.match_pairs(job, pairs, report)
    matching.check_motion(job)
    return matching.count_matches(job)


def _inner_pairs(segments: Sequence[Sequence[str]]) -> set[Pair]:
    """Returns the pairs of frames within a segment."""
    return {pair for names in segments for pair in itertools.combinations(sorted(names), 2)}


def split_by_view_graph(job: MappingJob) -> Result:
    """Cuts the frames of a job into segments where few matches tie them.

    Each also gets the frames of others that most of its matches lead to. The features and matches
    of each are written into a database in its folder.
    """
    names, count = job.names, job.split
    row = {name: index for index, name in enumerate(names)}
    weights = np.zeros((len(names), len(names)))
    for (first, second), geometry in skeleton.read_verified(job.database).items():
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
    return {"segments": segments}


def _seed_database(job: MappingJob, index: int) -> None:
    """Writes the database of a segment, with the features and matches of the whole."""
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
    database.seal(segment.database)


@dataclass(frozen=True, eq=False)
class _Shown:
    """The points of a segment that one of its images shows, K of them."""

    rows: NDArray[np.int64]  # [K], sorted keypoints
    xy: NDArray[np.float64]  # [K, 2] pixels
    points: NDArray[np.float64]  # [K, 3], in the segment's frame


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment that was mapped."""

    index: int
    model: pycolmap.Reconstruction
    cameras: SegmentCameras
    shown: Mapping[str, _Shown]


def read_segments(job: MappingJob) -> list[Segment]:
    """Returns the segments that have a model."""
    return [
        describe_segment(index, pycolmap.Reconstruction(job.segment(index) / MODEL_FOLDER))
        for index in range(len(job.segments))
        if (job.segment(index) / MODEL_FOLDER / "images.bin").exists()]


def describe_segment(index: int, model: pycolmap.Reconstruction) -> Segment:
    """Returns a model as a segment."""
    images = sorted((model.image(number) for number in model.reg_image_ids()),
                    key=lambda image: image.name)
    places = {number: point.xyz for number, point in model.points3D.items()}
    shown, depths = {}, []
    for image in images:
        seen = [(row, point.xy, places[point.point3D_id])
                for row, point in enumerate(image.points2D) if point.has_point3D()]
        points = np.array([xyz for _, _, xyz in seen]).reshape(-1, 3)
        shown[image.name] = _Shown(
            np.array([row for row, _, _ in seen], np.int64),
            np.array([xy for _, xy, _ in seen]).reshape(-1, 2), points)
        depths.append(np.linalg.norm(points - image.projection_center(), axis=1))
    cameras = SegmentCameras(
        tuple(image.name for image in images),
        np.array([image.projection_center() for image in images]).reshape(-1, 3),
        np.array([image.cam_from_world().rotation.matrix() for image in images]).reshape(-1, 3, 3),
        float(np.median(np.concatenate([np.zeros(0), *depths]) if depths else [0.0])))
    return Segment(index, model, cameras, shown)


def find_shared_points(job: MappingJob, segments: Sequence[Segment]) -> list[SharedPoints]:
    """Returns the points that two segments have in common, for each two that have some."""
    parts: dict[tuple[int, int], list[tuple[Pair, NDArray[np.float64], NDArray[np.float64]]]]
    parts = defaultdict(list)
    for one, other in itertools.combinations(segments, 2):
        for name in sorted(one.shown.keys() & other.shown.keys()):
            ours, theirs = one.shown[name], other.shown[name]
            # Keypoints of features are the same in both, those of tracks are numbered anew.
            _, left, right = np.intersect1d(
                _spots(ours.xy), _spots(theirs.xy), return_indices=True)
            parts[one.index, other.index].append(
                ((name, name), ours.points[left], theirs.points[right]))
    for pair, geometry in skeleton.read_verified(
            dataclasses.replace(job, linked=None).database).items():
        holders = [[segment for segment in segments if name in segment.shown] for name in pair]
        if set(map(id, holders[0])) & set(map(id, holders[1])):
            continue  # within a segment
        for one, other in itertools.product(*holders):
            ours, theirs = one.shown[pair[0]], other.shown[pair[1]]
            left, right = (_find(shown.rows, geometry.inlier_matches[:, side])
                           for side, shown in enumerate((ours, theirs)))
            both = (left >= 0) & (right >= 0)
            entry = pair, ours.points[left[both]], theirs.points[right[both]]
            if one.index > other.index:
                entry = pair[::-1], entry[2], entry[1]
            parts[min(one.index, other.index), max(one.index, other.index)].append(entry)
    return [
        SharedPoints(
            first, second, np.concatenate([ours for _, ours, _ in entries]),
            np.concatenate([theirs for _, _, theirs in entries]),
            np.repeat(np.arange(len(entries)), [len(ours) for _, ours, _ in entries]),
            tuple(pair for pair, _, _ in entries))
        for (first, second), entries in sorted(parts.items())]


def _spots(xy: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns a number for each spot of an image, to a sixteenth of a pixel."""
    whole = np.round(xy * 16).astype(np.int64)
    return np.asarray(whole[:, 0] << 32 | whole[:, 1])


def _find(rows: NDArray[np.int64], wanted: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Returns where sorted rows hold the wanted ones, [M]; -1 where they do not."""
    if not len(rows):
        return np.full(len(wanted), -1)
    place = np.minimum(np.searchsorted(rows, wanted), len(rows) - 1)
    return np.where(rows[place] == wanted, place, -1)


def join_all(
    segments: Sequence[Segment], common: Sequence[SharedPoints], *, seed: int
) -> tuple[list[Join], list[Placement]]:
    """Returns what segments say of each other by their common points, and the groups that follow.
    """
    by_index = {segment.index: segment.cameras for segment in segments}
    joins = [judge_join(shared, by_index[shared.first], by_index[shared.second], seed=seed)
             for shared in common]
    return joins, list(place_segments(by_index, joins))


@dataclass(frozen=True, eq=False)
class JoinedModel:
    """Segments in one frame; each image belongs to the segment that shows most of it."""

    parts: tuple[tuple[pycolmap.Reconstruction, frozenset[str]], ...]  # with the images they own

    @property
    def poses(self) -> dict[str, pycolmap.Rigid3d]:
        """World to camera by name of the image."""
        return {image.name: image.cam_from_world()
                for model, names in self.parts for image in _images(model, names)}


def join_models(segments: Sequence[Segment], placement: Placement) -> JoinedModel:
    """Returns the segments of a group, their models copied and moved."""
    members = [segment for segment in segments if segment.index in placement.motions]
    owner: dict[str, Segment] = {}
    for segment in members:
        for name, shown in segment.shown.items():
            best = owner.get(name)
            if best is None or len(shown.rows) > len(best.shown[name].rows):
                owner[name] = segment
    parts = []
    for segment in members:
        model, motion = pycolmap.Reconstruction(segment.model), placement.motions[segment.index]
        model.transform(pycolmap.Sim3d(
            motion.scale, pycolmap.Rotation3d(motion.rotation), motion.translation))
        parts.append((model, frozenset(
            name for name, which in owner.items() if which is segment)))
    return JoinedModel(tuple(parts))


def map_joined(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the model of the largest group of segments, and after it those of the other groups.

    `job.linked` names the database that is written and mapped from, where there are tracks.
    """
    largest, *others = _join(job, report)
    source = dataclasses.replace(job, linked=None)
    return [_fit(job, largest), *(_posed(source, other) for other in others)]


def _join(job: MappingJob, report: Reporter) -> list[JoinedModel]:
    """Returns the groups of segments, and writes what joined them; what else was read is freed."""
    source = dataclasses.replace(job, linked=None)
    report.phase("joining", len(job.segments))
    collect_matches(source)
    segments = read_segments(job)
    common = find_shared_points(source, segments)
    joins, groups = join_all(segments, common, seed=job.seed)
    known = {(min(pair), max(pair)) for shared in common for pair in shared.pairs}
    others = _overlapping(source, join_models(segments, groups[0]), known)
    if others - database.pair_names(source.database):
        matching.match_pairs(source, others, report)
        database.seal(source.database)
        joins, groups = join_all(
            segments, find_shared_points(source, segments), seed=job.seed)
    report.phase("joining", len(job.segments))
    atomic.write_json(job.out / REPORT, _describe(job, joins, groups))
    return [join_models(segments, group) for group in groups]


def _overlapping(job: MappingJob, joined: JoinedModel, known: Collection[Pair]) -> set[Pair]:
    """Returns pairs of frames of different segments that should see the same, besides known ones.
    """
    held: dict[str, set[int]] = defaultdict(set)
    for index, names in enumerate(job.segments):
        for name in names:
            held[name].add(index)
    owned = [(image, model) for model, names in joined.parts for image in _images(model, names)]
    return skeleton.overlapping_images(
        [image for image, _ in owned], [model for _, model in owned], held,
        most=OVERLAPPING, besides=known)


def _images(model: pycolmap.Reconstruction, names: frozenset[str]) -> list[pycolmap.Image]:
    images = (model.image(number) for number in model.reg_image_ids())
    return [image for image in images if image.name in names]


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
    source = dataclasses.replace(job, linked=None)
    if job.linked is not None:
        geometries = skeleton.read_verified(source.database)
        checked = check_pairs(source.database, list_views(joined.parts), geometries)
        usable = {pair: geometry for pair, geometry in geometries.items()
                  if pair not in checked.contradicting}
        assert job.tracks is not None
        skeleton.link(job, source.database, usable, Tracks.read(job.tracks))
    model = mapper.triangulate(job, _posed(job, joined), rounds=1)
    if model.num_reg_images() < len(job.names):
        model = mapper.extend_model(job, model, rounds=0)
    mapper.refine(job, model, ROUNDS)
    return model


def read_refused(job: MappingJob) -> list[str]:
    """Returns which joins of segments were not made, a sentence each; none without segments."""
    if not job.segments or not (job.out / REPORT).exists():
        return []
    refused: list[str] = atomic.read_json(job.out / REPORT, dict)["refused"]
    return [f"{text[:1].upper()}{text[1:]}." for text in refused]


def _describe(
    job: MappingJob, joins: Sequence[Join], groups: Sequence[Placement]
) -> dict[str, object]:
    return {
        "segments": [list(names) for names in job.segments],
        "groups": [sorted(group.motions) for group in groups],
        "refused": [text for group in groups for text in group.refused],
        "joins": [{
            "segments": [join.first, join.second], "made": join.holds,
            "scale": None if join.motion is None else join.motion.scale,
            "witnesses": join.witnesses, "contradictions": join.contradictions}
            for join in joins]}

