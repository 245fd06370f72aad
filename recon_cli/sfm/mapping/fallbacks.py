"""The mappers that are tried for a capture, from the quickest to the last resort.

A good capture stops at the first. The next one is tried where the model was not good enough, and
there is not too much to do; matches stay in the database. The best of all models is the result.
What there is to do is counted, not timed: a busy machine tries what an idle one does.

Each finished attempt is recorded, so that an interrupted run continues after it. An interrupted
mapping starts again: continued from COLMAP's snapshot, its result would differ.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

from recon_cli.errors import SfmError, name_command
from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.scene.matches import EXHAUSTIVE_MAX, MIN_PAIR_INLIERS
from recon_cli.sfm import database
from recon_cli.sfm.features import features, matching, xfeat_weights
from recon_cli.sfm.job import MappingJob, Reporter, fresh_folder
from recon_cli.sfm.limits import ENOUGH_FRAMES, FEW_PAIR_MATCHES, MIN_FRAMES, MIN_ONE_POINT
from recon_cli.sfm.mapping import checks, mapper, merge_models, parts, skeleton, wide_lens
from recon_cli.sfm.mapping.merge_models import ModelCandidate
from recon_cli.sfm.mapping.trusted_part import cuts_models, deliver_parts
from recon_cli.sfm.model_arrays import Pair, registered_images
from recon_cli.sfm.results import FeaturesResult, MatchesResult, ModelResult
from recon_cli.sfm.segments import join_segments
from recon_cli.sfm.verdict.verdict import ModelVerdict, examine
from recon_cli.time_estimate import COSTS, TimeEstimator, Work, format_minutes
from recon_cli.workspace.summaries import AttemptSummary, JsonRecord

TRACKS = "tracks"  # the fallback that has a database of its own
OTHERS = "others"  # in the folder of an attempt: its models that hold other frames, by number
COARSE = "coarse"  # the fallback for photos that begins with their coarsest features
BRIDGE = "bridge"  # the fallback with learned features, which has a database of its own
RELAXED_BRIDGE = "bridge relaxed"  # with the database of the former, and lower thresholds
SEGMENTS = "segments"  # the fallback that joins models; it has one, too, where there are tracks
# Frames up to which all pairs are matched at once: for less, the coarsest features save no time.
FEW_PHOTOS = 30
# How much longer than the first a mapping may take. Relaxed thresholds took 0.8 and 2.3 times as
# long as the first mapping of a capture, the global mapper 0.5, 2 and 3 times.
SLOWER = 3.0
# How many times as long as the attempt before it a further one usually takes (1.1 to 2.4 in three
# captures), and the minutes of an attempt from which on the user is told.
FURTHER, MINUTES_TOLD = 1.5, 0.5


@dataclass(frozen=True)
class Fallback:
    """One way to find a model: the pairs of images to match first, and the mapper."""

    name: str
    reason: str  # why a capture begins with it
    choose_pairs: Callable[[MappingJob, Reporter], set[Pair]]
    find_models: Callable[[MappingJob, Reporter], list[pycolmap.Reconstruction]]


@dataclass(frozen=True)
class MapperAttempt(JsonRecord):
    """What became of one fallback; see also `AttemptSummary` and `ModelCandidate`."""

    name: str
    reason: str
    seconds: float = 0.0
    skipped: str = ""
    registered: tuple[str, ...] = ()
    shortfall: str = "no model was found"  # why it is not good enough; empty where it is
    apart: tuple[tuple[str, ...], ...] = ()
    rejected: Mapping[str, str] = dataclasses.field(default_factory=dict)
    trusted: bool = False
    weak_link: float | None = None
    reprojection_error_px: float | None = None
    # Models that fit its cameras clearly better, by number; only where another attempt may use them
    lenses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    thin: tuple[str, ...] = ()  # frames of photos that few points place, see `list_thin`

    @property
    def models(self) -> list[int]:
        """Frames in the model, and those of the others that it lacks."""
        return [len(part) for part in (self.registered, *self.apart) if part]

    def summary(self, *, kept: bool) -> AttemptSummary:
        """Returns the attempt for the stage's summary."""
        return AttemptSummary(
            name=self.name, reason=self.reason, skipped=self.skipped,
            registered=len(self.registered), models=tuple(self.models), weak_link=self.weak_link,
            reprojection_error_px=self.reprojection_error_px, seconds=self.seconds, kept=kept)


def list_fallbacks(job: MappingJob) -> tuple[Fallback, ...]:
    """Returns the ways to a model that a job allows, the quickest first."""
    count = len(job.names)
    if job.pairs != "auto":
        return (_incremental(job.pairs, "--pairs asks for it"),)
    relaxed = Fallback("relaxed", "", lambda *_: set(), mapper.map_relaxed)
    every = _incremental("exhaustive", f"{count} frames are few enough to match all pairs")
    ways: tuple[Fallback, ...] = (every, relaxed) if count <= EXHAUSTIVE_MAX else (
        _incremental("retrieval", f"{count} frames are too many to match all pairs at once"),
        relaxed, every)  # lower thresholds take less time than all pairs
    if len(skeleton.list_keyframes(job)) < count:  # all pairs of so many would take an hour
        ways = tuple(way for way in ways if way is not every)
    if skeleton.is_continuous(job):
        ways = (Fallback(TRACKS, "the frames of a video are tracked from one to the next",
                         skeleton.choose_tracked_pairs, skeleton.complete_tracked), *ways)
    elif count > FEW_PHOTOS and not job.split and not job.segments and not job.panoramas:
        ways = (Fallback(COARSE, f"the coarsest features of {count} frames show overlap",
                         skeleton.choose_coarse_pairs, skeleton.complete_coarse), *ways)
    if job.segments:
        joined = Fallback(
            SEGMENTS, f"{count} frames were mapped in {len(job.segments)} segments",
            lambda *_: set(), join_segments.map_joined)
        if job.tracks is not None:  # mapped as one it would take longer than all of its segments
            return (joined,)
        ways = (joined, *ways)
    return (*ways, Fallback("global", "", lambda *_: set(), mapper.map_globally))


def find_features(job: MappingJob, report: Reporter) -> FeaturesResult:
    """Fills the database with the features of all frames; see `features.extract_features`."""
    if job.segments:
        join_segments.collect_features(job)
    by_tracks = list_fallbacks(job)[0].name == TRACKS
    with skeleton.build_beside(job, report) if by_tracks and job.threads > 1 else nullcontext():
        return features.extract_features(job, report)


def match_first(job: MappingJob, report: Reporter) -> MatchesResult:
    """Matches the pairs of the first fallback; SfmError if none matches, or none shows depth."""
    if job.segments:
        return join_segments.match_segments(job, report)
    matching.match_pairs(job, list_fallbacks(job)[0].choose_pairs(job, report), report)
    matching.check_motion(job)
    return matching.count_matches(job)


def build_model(job: MappingJob, report: Reporter) -> ModelResult:
    """Writes the best model of all attempts that were needed into out/model.

    The matches of the first fallback are in the database. No further attempt is made that would
    bring the work of all above `max_minutes` of one core, or above `spare_minutes` where a model
    can be trusted.
    SfmError if too few frames have a camera, they see the points from one place,
    or the parts of the model are too weakly connected.
    """
    log = job.tried
    attempts: list[MapperAttempt] = []
    verdicts: dict[str, ModelVerdict] = {}  # of the attempts of this call
    ways = list(_begin_with_fisheye(job, list_fallbacks(job), report))
    reason = ways[0].reason
    while ways:
        fallback = ways.pop(0)
        attempt = log.find(fallback.name, MapperAttempt)
        if attempt is None:
            attempt, candidate = _try_fallback(job, fallback, reason, attempts, report)
            if candidate is not None:
                verdicts[fallback.name] = candidate.verdict
            log.finish(fallback.name, attempt, [job.attempts / fallback.name])
        attempts.append(attempt)
        if not attempt.skipped:
            bridge = _with_bridge(job, attempts, ways, report)
            if bridge is not None:
                ways.insert(0, bridge)
            elif fallback.name == BRIDGE and attempt.registered and attempt.shortfall:
                ways.insert(0, Fallback(RELAXED_BRIDGE, "", lambda *_: set(), _map_bridged_again))
            elif any(made.registered and not made.shortfall for made in attempts):
                break
            reason = attempt.shortfall or "the photos share few matches"
            if attempt.lenses:
                ways.insert(0, _with_lenses(attempt.lenses))
            if ways and attempt.seconds > 60 * MINUTES_TOLD:
                told = any(before.shortfall == reason for before in attempts[:-1])
                report.tell(f"trying another mapper, for about "
                            f"{format_minutes(FURTHER * attempt.seconds)} more"
                            f"{'' if told else f': {reason}'}")
    return _publish_best(job, attempts, verdicts)


def _unneeded_minutes(job: MappingJob, attempts: Sequence[MapperAttempt]) -> float:
    """Returns by how much sooner than --max-minutes the search ends with what it has found.

    A model that lacks many frames is worth as much time again.
    """
    held = max((len(attempt.registered) for attempt in attempts if attempt.trusted), default=0)
    if job.spare_minutes is None or held < job.min_registered * len(job.names):
        return 0.0
    enough = held >= ENOUGH_FRAMES * len(job.names)
    return max(0.0, job.max_minutes - job.spare_minutes * (1 if enough else 2))


def _begin_with_fisheye(
    job: MappingJob, ways: tuple[Fallback, ...], report: Reporter
) -> tuple[Fallback, ...]:
    """Returns the ways to a model of matched pairs, that for fisheyes first if there are any.

    Segments are joined by their intrinsics, of which one may be found a fisheye and another not:
    they stay with the model that their database was made with.
    """
    if job.is_segment or not wide_lens.find_fisheyes(job):
        return ways
    if job.segments:
        if all(group.model == "auto" for group in job.groups):
            report.tell("The matches are those of a fisheye lens, but the segments were mapped "
                        f"with ordinary ones: {name_command('sfm --segments off')} maps them "
                        "together, and as fisheyes.")
        return ways
    named = any("FISHEYE" in group.model for group in job.groups)
    reason = "--camera-model asks for it" if named else "the matches are those of a fisheye lens"
    fisheye = Fallback(wide_lens.ATTEMPT, reason, lambda *_: set(), wide_lens.map_fisheye)
    if named:  # the others would map with the model that the database begins with
        return (fisheye,)
    return (fisheye, dataclasses.replace(ways[0], choose_pairs=lambda *_: set()), *ways[1:])


def _with_lenses(models: Mapping[str, str]) -> Fallback:
    """Returns the way to a model with other camera models, by the numbers of the cameras."""
    return Fallback(wide_lens.OTHER, "", lambda *_: set(), lambda job, report: (
        wide_lens.map_lenses(job, report, {int(number): models[number] for number in models})))


def _with_bridge(
    job: MappingJob, attempts: Sequence[MapperAttempt], ways: Sequence[Fallback], report: Reporter
) -> Fallback | None:
    """Returns the way to a model of photos with learned features, where these may help.

    That is after the last attempt that matches other pairs, if the model falls short or lacks
    frames, even such that SIFT matches to nothing, or if it is thin. Where the features are not
    installed, the user is told how to get them.
    """
    last, before = attempts[-1], {attempt.name for attempt in attempts}
    lacks = last.shortfall or len(last.registered) < ENOUGH_FRAMES * len(job.names)
    may_help = last.thin or (lacks and not (ways and ways[0].name in _PAIRS))
    if (not may_help or last.name not in (COARSE, *_PAIRS) or not may_bridge(job)
            or before & {BRIDGE, "relaxed", wide_lens.ATTEMPT}):
        return None
    if not xfeat_weights.are_installed():
        report.tell("These photos are few or far apart. Learned features may match them where SIFT "
                    f"cannot: `{xfeat_weights.COMMAND}` gets them, then run "
                    f"{name_command('sfm --again')}.")
        return None
    from recon_cli.sfm.features import bridge  # imports torch

    best = best_attempt(attempts)
    parts = [best.registered, *best.apart] if best else []
    thin = best.thin if best else ()
    return Fallback(BRIDGE, "", lambda *_: set(), lambda job, report: (
        bridge.map_bridged(job, report, parts, thin)))


def _map_bridged_again(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the models of the bridged matches with lower thresholds.

    From a copy: COLMAP writes to what it opens, and the finished attempt has digests.
    """
    shutil.copyfile(job.attempts / BRIDGE / skeleton.MATCHES_DB, job.database)
    return mapper.map_relaxed(job, report)


def may_bridge(job: MappingJob) -> bool:
    """Returns whether learned features may be asked: of photos that are mapped as one."""
    return job.pairs == "auto" and not (  # a segment has the keypoints that the others have
        job.is_segment or job.segments or job.panoramas or skeleton.is_continuous(job))


def list_thin(model: pycolmap.Reconstruction) -> tuple[str, ...]:
    """Returns the images that few points place which two others show; none where these are few.

    Nothing else contradicts a wrong place: 13 photos were trusted that were 12 cm off in a room,
    by images with 44 and more such points.
    """
    firm = {number for number, point in model.points3D.items() if point.track.length() > 2}
    images = registered_images(model)
    thin = sorted(image.name for image in images if sum(
        point.point3D_id in firm for point in image.get_observation_points2D()) < FEW_PAIR_MATCHES)
    return tuple(thin) if len(thin) > (1 - ENOUGH_FRAMES) * len(images) else ()


def may_change_lenses(job: MappingJob, before: Collection[str]) -> bool:
    """Returns whether an attempt with other camera models may follow those of some names.

    Not where the user names one, and not of segments, which are joined by their intrinsics.
    """
    named = any(group.model != "auto" for group in job.groups)
    return not named and not job.segments and wide_lens.OTHER not in before


def reachable(job: MappingJob, candidate: ModelCandidate) -> set[str]:
    """Returns the frames with features that a model could hold.

    Once all pairs are matched, these are only those that matches connect to it, directly or not.
    """
    counts = database.keypoint_counts(job.database)
    textured = {name for name, count in counts.items() if count >= MIN_PAIR_INLIERS}
    if database.progress(job.database, "matches") < len(counts) * (len(counts) - 1) // 2:
        return textured
    held = set(mapper.list_registered(candidate.model))
    connected = max(candidate.verdict.match_parts, key=lambda part: len(held.intersection(part)))
    return textured.intersection(connected)


def shortfall(
    candidate: ModelCandidate, reach: Collection[str], *, lenses: bool = False
) -> str:
    """Returns why a model is not good enough, given the frames that it could hold; empty if not.

    `lenses` says whether another camera model may be tried: no other mapper mends a wrong one.
    """
    held = candidate.model.num_reg_images()
    if held < ENOUGH_FRAMES * len(reach):
        return f"only {held} of the {len(reach)} frames that can be registered were"
    apart = [names for names in candidate.apart if set(names).intersection(reach)]
    if apart:
        return f"the capture split into {1 + len(apart)} disconnected models"
    found = candidate.verdict.lenses
    told = {lens.sentence() for lens in found}
    problems = [text for text in candidate.verdict.problems if text not in told]
    return " ".join(problems) or ("; ".join(
        lens.describe() for lens in found) if lenses else "")


def describe_other_rooms(job: MappingJob, candidate: ModelCandidate) -> str:
    """Returns why a model of panoramas is not all that could be mapped; empty if it is."""
    placed = {*mapper.list_registered(candidate.model), *sum(candidate.apart, ())}
    others = [names for names in candidate.verdict.match_parts
              if len(names) >= MIN_FRAMES and placed.isdisjoint(names)]
    return "" if not job.panoramas or not others else (
        f"{sum(map(len, others))} panoramas match each other, but not those that have a camera")


def best_attempt(attempts: Sequence[MapperAttempt]) -> MapperAttempt | None:
    """Returns the attempt with the best model: many frames that are strongly connected.

    A frame counts by the agreement across the weakest cut of its model, and at most as in a broken
    model where another check failed, or where bridges were tried as it was thin; in a tie of 1%
    the smaller reprojection error decides, then the earlier attempt. Bridges that give no trusted
    model are worth nothing.
    """
    bridged = any(attempt.name == BRIDGE for attempt in attempts)

    def quality(attempt: MapperAttempt) -> tuple[float, float]:
        if attempt.name in (BRIDGE, RELAXED_BRIDGE) and not attempt.trusted:
            return 0.0, 0.0
        link = attempt.weak_link if attempt.weak_link is not None else float(attempt.trusted)
        if not attempt.trusted or (bridged and attempt.thin):
            link = min(link, MIN_ONE_POINT)
        most = max(len(other.registered) for other in attempts)
        return (round(len(attempt.registered) / most * (0.5 + 0.5 * link), 2),
                -(attempt.reprojection_error_px or 0.0))

    return max((attempt for attempt in attempts if attempt.registered), key=quality, default=None)


def _try_fallback(
    job: MappingJob, fallback: Fallback, reason: str, before: Sequence[MapperAttempt],
    report: Reporter,
) -> tuple[MapperAttempt, ModelCandidate | None]:
    """Writes the model of a fallback into its folder and returns what became of it."""
    folder = fresh_folder(job.attempts / fallback.name)
    start = time.monotonic()  # for the summary alone
    # Those of the first are matched.
    wanted = fallback.choose_pairs(job, report) if before else set()
    work = _count_seconds(job, wanted, sum(not attempt.skipped for attempt in before))
    if before and work > 60 * (job.max_minutes - _unneeded_minutes(job, before)):
        skipped = f"all would take about {work / 60:.0f} minutes of a core"
        return MapperAttempt(fallback.name, reason, skipped=skipped), None
    if wanted:
        matching.match_pairs(job, wanted, report)
        database.record_rows(job.database)
    job = _with_own_matches(job, fallback.name)
    candidate = merge_models.best_model(
        job, fallback.find_models(job, report), merging=fallback.name != SEGMENTS,
        both_ways=fallback.name in (BRIDGE, RELAXED_BRIDGE))
    seconds = round(time.monotonic() - start, 2)
    if candidate is None:
        return MapperAttempt(fallback.name, reason, seconds), None
    for name, model in {
            "model": candidate.model,
            **{f"{OTHERS}/{k}": other for k, other in enumerate(candidate.others)}}.items():
        write_model(model, fresh_folder(folder / name))
    found = candidate.verdict.lenses if may_change_lenses(
        job, [fallback.name, *(attempt.name for attempt in before)]) else ()
    attempt = MapperAttempt(
        fallback.name, reason, seconds, "", tuple(mapper.list_registered(candidate.model)),
        shortfall(candidate, reachable(job, candidate), lenses=bool(found))
        or describe_other_rooms(job, candidate),
        candidate.apart, candidate.rejected,
        candidate.verdict.trusted, candidate.verdict.weakest_cut.share,
        candidate.model.compute_mean_reprojection_error(),
        {str(lens.camera): lens.better for lens in found},
        list_thin(candidate.model) if may_bridge(job) else ())
    return attempt, candidate


def _count_seconds(job: MappingJob, wanted: Collection[Pair], tried: int) -> float:
    """Returns the CPU seconds of all attempts with a further one, on the machine of `COSTS`."""
    mapping = "photo_mapping" if job.tracks is None else "walk_mapping"
    return TimeEstimator(COSTS).total([
        Work("pair", len(database.pair_names(job.database).union(wanted))),
        Work(mapping, len(job.names) * (tried + SLOWER))])


def _publish_best(
    job: MappingJob, attempts: Sequence[MapperAttempt], verdicts: Mapping[str, ModelVerdict]
) -> ModelResult:
    """Publishes the parts of the best model, and returns the result of the step."""
    chosen = best_attempt(attempts)
    registered = chosen.registered if chosen else ()
    placed = registered + sum(chosen.apart, ()) if chosen and cuts_models(job) else registered
    try:  # of which panoramas a share is asked, the verdict tells
        checks.check_registered(
            job.names, placed, 0.0 if job.panoramas and chosen else job.min_registered)
    except SfmError as error:
        counts = ", ".join(
            f"{attempt.name} was skipped for lack of time" if attempt.skipped else
            f"{attempt.name} found {len(attempt.registered)}" for attempt in attempts)
        refused = "".join(f" {text}" for text in join_segments.describe_refused_joins(job))
        raise SfmError(f"{error.message} Cameras by mapper: {counts}.{refused}",
                       hint=error.hint) from error
    assert chosen is not None  # three frames at least are registered
    job = _with_own_matches(job, chosen.name)
    folder = job.attempts / chosen.name
    model = pycolmap.Reconstruction(folder / "model")
    verdict = verdicts.get(chosen.name) or examine(
        model, job.database, job.names, sharpness=job.sharpness, times=job.times,
        lenses=job.unknown_lenses)
    delivered = deliver_parts(
        job, ModelCandidate(model, verdict, chosen.apart, chosen.rejected),
        [pycolmap.Reconstruction(folder / OTHERS / str(k)) for k in range(len(chosen.apart))])
    parts.write_parts(job, [(part.model, part.verdict) for part in delivered])
    shutil.rmtree(job.attempts)
    held = {name for part in delivered for name in mapper.list_registered(part.model)}
    apart = [tuple(sorted(set(names) - held)) for names in chosen.apart]
    return ModelResult(
        parts=tuple(parts.list_part(part.model, part.rejected) for part in delivered),
        poses=None, models=(len(chosen.registered), *chosen.models[1:]),
        apart=tuple(names for names in apart if len(names) >= MIN_FRAMES),
        broken=() if job.accept_weak else verdict.problems,
        left_out=tuple(sorted(set(chosen.registered) - held)),
        notes=join_segments.describe_refused_joins(job),
        attempts=tuple(attempt.summary(kept=attempt is chosen) for attempt in attempts))


def _with_own_matches(job: MappingJob, name: str) -> MappingJob:
    """Returns a job that maps from the database of an attempt that has its own."""
    own = job.attempts / name / skeleton.MATCHES_DB
    has_own = name in (TRACKS, BRIDGE, RELAXED_BRIDGE, wide_lens.ATTEMPT, wide_lens.OTHER) or (
        name == SEGMENTS and job.tracks is not None)
    return dataclasses.replace(job, matches_db=own) if has_own else job


def _incremental(pairs: str, reason: str) -> Fallback:
    return Fallback(pairs, reason, _PAIRS[pairs], mapper.map_incrementally)


_PAIRS: dict[str, Callable[[MappingJob, Reporter], set[Pair]]] = {
    "exhaustive": lambda job, _: matching.exhaustive_pairs(job.names),
    "sequential": lambda job, _: matching.sequential_pairs(job.names),
    "retrieval": lambda job, _: matching.near_or_similar_pairs(
        job, skeleton.list_keyframes(job))}
