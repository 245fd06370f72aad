"""The parts of a capture that can be trusted on their own.

A mapper goes wrong in few places, and what lies on either side of one is usually right. So a model
is cut where the verdict finds it broken, each side is adjusted and examined by itself, and cut
again where it is broken too. A capture that split into several models is in parts as well. Nothing
is known of how one part lies to another, nor of the ratio of their scales.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np

from recon_cli.errors import MOST_NAMED, SfmError, name_command
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.limits import MIN_FRAMES, MIN_IMAGES_PRINCIPAL, MIN_PARALLAX_DEG
from recon_cli.sfm.mapping import checks, mapper
from recon_cli.sfm.mapping.merge_models import ModelCandidate, drop_outliers
from recon_cli.sfm.verdict.verdict import (
    MAX_LEAP,
    ModelVerdict,
    check_weak_link,
    has_drifted,
    is_aliased,
    is_broken,
)

Names = tuple[str, ...]

# Frames of a part beside the largest, a tenth of the capture within these bounds: 20 are worth a
# scene, and fewer than 10 cannot tell the principal point (`limits`).
FEWEST_FRAMES, WORTH_FRAMES = MIN_IMAGES_PRINCIPAL, 20
JOIN_PANORAMAS = (
    "To join panoramas that do not overlap, add some between them, half a metre apart: in a "
    "doorway and on either side of it.")


def deliver_parts(
    job: MappingJob, model: ModelCandidate, others: Iterable[pycolmap.Reconstruction] = ()
) -> list[ModelCandidate]:
    """Returns the parts of a capture that can be trusted, that which shows most first.

    `others` are models beside the largest one, `model`. --accept-weak and --no-partial keep that as
    it is.
    SfmError if the parts hold less than --min-registered of the frames together (`frames_asked`),
    or show them from nearly one place.
    """
    parts = [model]
    if cuts_models(job):
        found = find_parts(job, model, others)
        parts = [part for part in found if checks.shows_depth(_angle(part))] or found[:1]
        _check_share(job, model.verdict, parts)
    checks.check_registered(
        frames_asked(job, model.verdict),
        [name for part in parts for name in mapper.list_registered(part.model)],
        job.min_registered)
    checks.check_parallax(_angle(parts[0]))
    check_weak_link(parts[0].verdict, job.accept_weak)
    return parts


def cuts_models(job: MappingJob) -> bool:
    """Returns whether a job takes parts of what the mapper found, rather than the largest model."""
    return job.partial and not job.accept_weak


def least_frames(job: MappingJob) -> int:
    """Returns how many frames a part beside the largest must have; three panoramas show rooms."""
    if job.panoramas:
        return MIN_FRAMES
    return min(max(len(job.names) // 10, FEWEST_FRAMES), WORTH_FRAMES)


def frames_asked(job: MappingJob, verdict: ModelVerdict) -> Names:
    """Returns the frames of which --min-registered asks for a share.

    A panorama shows a room by itself, and few overlap through doors. One that does not match two
    others, directly or through others, cannot be placed; it tells nothing against those that are.
    """
    if not job.panoramas:
        return tuple(job.names)
    return tuple(sorted(name for names in verdict.match_parts if len(names) >= MIN_FRAMES
                        for name in names))


def find_parts(
    job: MappingJob, model: ModelCandidate, others: Iterable[pycolmap.Reconstruction] = ()
) -> list[ModelCandidate]:
    """Returns the parts that can be trusted, that which shows most first.

    Where none has the frames that a part must have, that is the largest, of three cameras or more.
    The points of a model that has none are triangulated.
    """
    least = least_frames(job)
    parts = list(_cut(job, model, MIN_FRAMES))
    for other in sorted(others, key=mapper.model_size, reverse=True):
        held = {name for part in parts for name in mapper.list_registered(part.model)}
        names = set(mapper.list_registered(other)) - held
        if len(names) >= least:
            full = other if other.num_points3D() else mapper.triangulate(job, other)
            part = drop_outliers(job, mapper.sharpen(_cut_out(full, names)))
            parts += _cut(job, part, least)
    parts.sort(key=lambda part: mapper.model_size(part.model), reverse=True)
    worth = [part for part in parts if part.model.num_reg_images() >= least] or parts[:1]
    return sorted(worth, key=lambda part: count_distinct_views(part.model), reverse=True)


def count_distinct_views(model: pycolmap.Reconstruction) -> float:
    """Returns how many images without overlap would show the surfaces that a model shows.

    That needs no scale, which parts do not share, nor does it count what a camera sees again while
    it waits: a point counts as the share of the points of an image that it is, on the mean of the
    images that see it. Points without parallax do not count.
    """
    surface = mapper.triangulation_angles(model) >= MIN_PARALLAX_DEG
    tracks = [[element.image_id for element in point.track.elements]
              for point, shown in zip(model.points3D.values(), surface, strict=True) if shown]
    counts = Counter(image for track in tracks for image in track)
    return sum(sum(1 / counts[image] for image in track) / len(track) for track in tracks)


def _cut(job: MappingJob, model: ModelCandidate, least: int) -> Iterator[ModelCandidate]:
    """Yields the trusted parts of a model: of so many cameras, and others of those it must have."""
    if model.verdict.trusted:
        yield model
        return
    sides = [(names, model.rejected) for names in _sides(
        job, mapper.list_registered(model.model), model.verdict)]
    while sides:
        names, rejected = sides.pop(max(range(len(sides)), key=lambda i: len(sides[i][0])))
        if len(names) < least:
            continue
        part = drop_outliers(job, _cut_out(model.model, names))
        part = dataclasses.replace(part, rejected={**rejected, **part.rejected})
        cameras = mapper.list_registered(part.model)
        if not part.verdict.trusted:
            sides += [(side, part.rejected) for side in _sides(job, cameras, part.verdict)
                      if len(side) < len(cameras)]
        elif len(cameras) >= least:
            yield part
            least = max(least, least_frames(job))


def _check_share(
    job: MappingJob, verdict: ModelVerdict, parts: Sequence[ModelCandidate]
) -> None:
    """Raises SfmError if the parts of a broken capture hold too few frames together."""
    held = [mapper.list_registered(part.model) for part in parts]
    count, asked = sum(map(len, held)), frames_asked(job, verdict)
    broken = bool(verdict.problems) or len(parts) > 1
    if parts and (count >= job.min_registered * len(asked) or not broken):
        return
    more = JOIN_PANORAMAS if job.panoramas else (
        f"Use more frames between the parts ({name_command('ingest --frames N')}), or match all "
        "of them (--pairs exhaustive).")
    named = "; ".join(f"{len(names)} ({names[0]} to {names[-1]})" for names in held[:MOST_NAMED])
    problem = (verdict.problems or ("The capture split into disconnected models.",))[0]
    raise SfmError(
        f"{problem} The parts that can be trusted on their own hold {count} of {len(asked)} "
        f"frames{' that match others' if len(asked) < len(job.names) else ''} "
        f"together{f', {named}' if named else ''}, but --min-registered asks for "
        f"{job.min_registered:.0%}.",
        hint=f"{more} Or accept the parts with a lower --min-registered, or keep the largest model "
        "as it is with --accept-weak.")


def _sides(job: MappingJob, cameras: Collection[str], verdict: ModelVerdict) -> Iterator[Names]:
    """Yields the parts on either side of where a verdict finds a model broken, if that is known."""
    if is_broken(verdict.weakest_cut):
        yield from verdict.weakest_cut.sides
    elif is_aliased(verdict.aliasing):
        yield from verdict.aliasing.sides
    elif has_drifted(verdict) and verdict.scale is not None:
        yield from verdict.scale.sides
    elif len(verdict.model_parts) > 1:
        yield from verdict.model_parts
    elif verdict.rough:
        yield tuple(name for name in cameras if name not in verdict.rough)
    elif leap := next((jump for jump in verdict.jumps if jump.ratio > MAX_LEAP), None):
        ordered = sorted(cameras, key=lambda name: (job.times.get(name, 0.0), name))
        after = ordered.index(leap.after)
        yield tuple(ordered[:after])
        yield tuple(ordered[after:])


def _cut_out(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    """Returns a copy of a model with these images alone, adjusted."""
    part, keep = pycolmap.Reconstruction(model), set(names)
    for index in list(part.reg_image_ids()):
        image = part.image(index)
        if image.name not in keep:
            part.deregister_frame(image.frame_id)
    mapper.adjust(part)
    return part


def _angle(part: ModelCandidate) -> float:
    """Returns the median of the widest angles that points are seen at, degrees."""
    return float(np.median(mapper.triangulation_angles(part.model)))
