"""What is found about good and broken models."""

import json
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from facts import assert_facts, raises
from made_model import WIDTH, MadeModel, along, broken_walk, doubled_place, moved, walk, wall

from recon_cli.errors import SfmError
from recon_cli.sfm.verdict.evidence import gather_evidence
from recon_cli.sfm.verdict.verdict import (
    MAX_SHIFT,
    Histogram,
    ModelVerdict,
    check_weak_link,
    describe_shifted_centres,
    examine,
    explain_unregistered,
    find_jumps,
)


def verdict_on(made: MadeModel, folder, **known) -> ModelVerdict:
    return examine(made.model(), made.write_database(folder / "database.db"), made.names, **known)


@pytest.mark.integration
def test_a_model_that_all_matches_confirm_is_trusted(tmp_path):
    verdict = verdict_on(walk(), tmp_path)
    assert verdict.trusted
    assert verdict.problems == ()
    assert verdict.weakest_cut.share == 1
    assert verdict.aliasing.share == 1
    assert (verdict.outliers, verdict.jumps, verdict.unregistered) == ((), (), {})
    assert [len(part) for part in verdict.model_parts] == [16]
    check_weak_link(verdict, accept=False)


@pytest.mark.integration
def test_two_good_halves_set_wrongly_to_each_other_are_found(tmp_path):
    made = broken_walk()
    verdict = verdict_on(made, tmp_path)
    assert not verdict.trusted
    assert verdict.weakest_cut.share is not None
    assert verdict.weakest_cut.share < 0.1
    assert sorted(verdict.weakest_cut.sides) == [tuple(made.names[:8]), tuple(made.names[8:])]
    assert len(verdict.model_parts) == 1, "a few points still tie the halves"


@pytest.mark.integration
def test_a_half_of_wrong_scale_is_found_though_no_match_leaves_its_epipolar_line(tmp_path):
    """Both halves look from one line: scaling one along it keeps the epipolar lines."""
    made = walk(landmark=lambda image, point: (image >= 8, point))
    model = made.model()
    first = model.image(9).projection_center()
    for index in range(9, 17):
        image = model.image(index)
        center = first + 1.5 * (image.projection_center() - first)
        turn = image.cam_from_world().rotation
        image.frame.rig_from_world = pycolmap.Rigid3d(turn, -(turn.matrix() @ center))
    verdict = examine(model, made.write_database(tmp_path / "database.db"), made.names)
    assert verdict.weakest_cut.share == 0
    assert verdict.weakest_cut.sides == (tuple(made.names[:8]), tuple(made.names[8:]))


def test_halves_that_few_points_tie_wrongly_are_found_by_the_other_matches(tmp_path):
    """What would show the break is not in the model: the mapper has dropped it."""
    made = broken_walk()
    model = made.model()
    first, second = (
        {element.point3D_id for image in half for element in model.image(image).points2D
         if element.has_point3D()} for half in (range(1, 9), range(9, 17)))
    wanted = first & second
    for number in list(model.points3D):
        images = {element.image_id for element in model.point3D(number).track.elements}
        if number not in wanted and images & {7, 8, 9, 10}:
            model.delete_point3D(number)
    verdict = examine(model, made.write_database(tmp_path / "database.db"), made.names)
    assert verdict.weakest_cut.explained is not None
    assert verdict.weakest_cut.explained < 0.5
    assert sorted(verdict.weakest_cut.sides) == [tuple(made.names[:8]), tuple(made.names[8:])]
    with raises(SfmError, "agree", "cameras"):
        check_weak_link(verdict, accept=False)


@pytest.mark.integration
def test_a_broken_model_is_refused_with_the_way_out_unless_it_is_accepted(tmp_path):
    verdict = verdict_on(broken_walk(), tmp_path)
    with raises(SfmError, "model", "broken") as caught:
        check_weak_link(verdict, accept=False)
    for way_out in ("--frames", "--pairs exhaustive", "--accept-weak"):
        assert way_out in caught.value.hint
    check_weak_link(verdict, accept=True)


@pytest.mark.integration
def test_two_places_laid_over_each_other_are_found_though_every_match_agrees(tmp_path):
    made = doubled_place()
    verdict = verdict_on(made, tmp_path)
    assert verdict.weakest_cut.share == 1
    assert verdict.aliasing.share is not None
    assert verdict.aliasing.share < 0.5
    assert sorted(verdict.aliasing.sides) == [tuple(made.names[:6]), tuple(made.names[6:])]
    with raises(SfmError, "look", "alike"):
        check_weak_link(verdict, accept=False)


@pytest.mark.integration
def test_places_that_look_alike_do_not_speak_against_a_right_model(tmp_path):
    """The posters' matches outnumber those that tie the middle of a walk and all contradict it."""
    points = np.concatenate([wall(-4, 24, count=800), wall(-1, 1, count=800, seed=1)])
    away = np.array([20.0, 1, 0])  # higher up too: else it lies on the epipolar lines
    points = np.concatenate([points, points[800:] + away])
    looks = np.arange(len(points))
    looks[1600:] = looks[800:1600]
    made = MadeModel(points, along(np.arange(51) * 0.4), looks=looks)
    model, database = made.model(), made.write_database(tmp_path / "database.db")
    evidence = gather_evidence(model, database, made.names)
    middle = (evidence.pairs < 25).sum(axis=1) == 1
    assert evidence.agreeing[middle].sum() < 0.5 * evidence.matches[middle].sum()
    verdict = examine(model, database, made.names)
    assert verdict.trusted, verdict.problems


@pytest.mark.integration
def test_one_wrong_camera_is_named_and_its_neighbours_are_not(tmp_path):
    made = walk(
        motions={5: moved(3, 3, 0)},
        landmark=lambda image, point: point if point < 60 else (image == 5, point))
    verdict = verdict_on(made, tmp_path)
    assert [item.name for item in verdict.outliers] == [made.names[5]]
    assert verdict.outliers[0].share < 0.1
    assert verdict.weakest_cut.share == 1
    assert not verdict.trusted
    assert made.names[5] in verdict.problems[0]


@pytest.mark.integration
def test_a_camera_far_off_a_video_s_path_is_a_jump_there_and_back(tmp_path):
    made = walk(motions={5: moved(0, 30, 0)})
    verdict = verdict_on(made, tmp_path)
    names = made.names
    assert [(jump.before, jump.after) for jump in verdict.jumps] == [
        (names[4], names[5]), (names[5], names[6])]
    assert verdict.jumps[0].ratio == pytest.approx(60, rel=0.1)
    assert not any("jumps" in problem for problem in verdict.problems)


@pytest.mark.integration
def test_a_leap_out_of_the_world_is_a_problem(tmp_path):
    made = walk(motions={5: moved(0, 3000, 0)})
    verdict = verdict_on(made, tmp_path)
    assert not verdict.trusted
    assert_facts("\n".join(verdict.problems), "jumps", made.names[4])
    with raises(SfmError, "jumps"):
        check_weak_link(verdict, accept=False)
    check_weak_link(verdict, accept=False, given=True)


@pytest.mark.integration
def test_parts_that_share_no_point_are_a_problem(tmp_path):
    made = walk(landmark=lambda image, point: (image >= 10, point))
    verdict = verdict_on(made, tmp_path)
    assert verdict.model_parts == (tuple(made.names[:10]), tuple(made.names[10:]))
    assert [len(part) for part in verdict.match_parts] == [16]
    assert any("2 parts" in problem and "10, 6" in problem for problem in verdict.problems)


@pytest.mark.integration
def test_images_without_a_camera_have_a_reason(tmp_path):
    """The last two see another wall; the third is blurred, and the fifth just was not placed."""
    poses = along([*np.arange(10) * 0.5, 100, 101])
    points = np.concatenate([wall(-4, 9, count=2000), wall(98, 103, count=400)])
    made = MadeModel(points, poses, unregistered=frozenset({3, 5, 10, 11}))
    sharpness = dict.fromkeys(made.names, 100.0) | {made.names[3]: 20.0}
    reasons = verdict_on(made, tmp_path, sharpness=sharpness).unregistered
    assert list(reasons) == [made.names[index] for index in (3, 5, 10, 11)]
    assert_facts(reasons[made.names[3]], "blurred", 20, 100)
    assert_facts(reasons[made.names[5]], "matched", "placed")
    assert_facts(reasons[made.names[5]], 8, "images")
    assert_facts(reasons[made.names[10]], "overlap")


def test_two_cameras_are_too_few_to_tell(tmp_path):
    made = MadeModel(wall(-4, 4, count=20), along([0.0, 0.5]))
    verdict = verdict_on(made, tmp_path)
    assert verdict.weakest_cut.share is None
    assert_facts(verdict.weakest_cut.reason, 15, "matched")
    assert verdict.aliasing.share is None
    check_weak_link(verdict, accept=False)


@pytest.mark.integration
def test_the_keys_of_a_verdict_on_disk_stay(tmp_path):
    value = json.loads(json.dumps(verdict_on(broken_walk(), tmp_path).to_json(), allow_nan=False))
    assert list(value) == [
        "images", "registered", "model_parts", "match_parts", "weak_link", "fold", "astray",
        "unregistered", "jumps", "keypoints", "points", "neighbours", "still", "scale",
        "open_loops", "problems", "lenses", "camera_errors", "rough", "trusted"]
    assert value["trusted"] is False


@pytest.mark.integration
def test_the_same_model_gets_the_same_verdict_twice(tmp_path):
    made = broken_walk()
    database = made.write_database(tmp_path / "database.db")
    assert examine(made.model(), database, made.names) == examine(
        made.model(), database, made.names)


@pytest.mark.integration
def test_the_text_says_first_whether_the_model_can_be_trusted(tmp_path):
    assert_facts(verdict_on(walk(), tmp_path).lines()[0], "16 of 16", "trusted")
    (tmp_path / "database.db").unlink()
    lines = verdict_on(broken_walk(), tmp_path).lines()
    assert_facts(lines[0], "not", "trusted")
    assert_facts(lines[1], "model", "broken")


def test_an_image_that_the_database_lacks_is_a_mistake_of_the_program(tmp_path):
    made = walk()
    database = made.write_database(tmp_path / "database.db")
    with raises(ValueError, 16, 17):
        examine(made.model(), database, [*made.names, "other.png"])
    with raises(ValueError, made.names[-1]):
        examine(made.model(), database, made.names[:-1])


def test_a_model_without_cameras_cannot_be_told(tmp_path):
    made = walk(unregistered=frozenset(range(16)))
    verdict = verdict_on(made, tmp_path)
    assert (verdict.registered, verdict.model_parts) == (0, ())
    assert len(verdict.unregistered) == 16
    assert verdict.weakest_cut.share is None
    assert len(verdict.lines()) == 7, "five of the sixteen are listed"


def capture(keypoints, pairs=(), matches=()):
    """Images of which the first two have a camera."""
    count = len(keypoints)
    return SimpleNamespace(
        names=tuple("abcd"[:count]), registered=np.arange(count) < 2,
        keypoints=np.array(keypoints), pairs=np.array(pairs, np.int64).reshape(-1, 2),
        matches=np.array(matches, np.int64))


def explained(evidence, **sharpness):
    """Returns the reason of image c, the only one without a camera."""
    ((name, reason),) = explain_unregistered(evidence, sharpness).items()
    assert name == "c"
    return reason


def test_the_sharpness_of_the_others_decides_what_is_blurred():
    evidence = capture([900, 900, 900])
    assert_facts(explained(evidence, a=50.0, b=60.0, c=20.0), "blurred", 20, 50)
    assert_facts(explained(evidence, a=50.0, b=60.0, c=40.0), "overlap")


def test_an_image_that_matches_another_room_is_not_called_blurred_alone():
    evidence = capture([900] * 4, [[0, 1], [2, 3]], [300, 300])
    reasons = explain_unregistered(evidence, {"a": 50.0, "b": 60.0, "c": 20.0, "d": 61.0})
    assert_facts(reasons["c"], "overlap", "1 without", 20, 55)


def test_an_image_of_a_bare_wall_has_too_few_features():
    assert_facts(explained(capture([900, 900, 40])), "features", 40)


def test_an_image_that_matches_nothing_has_no_overlap():
    assert_facts(explained(capture([900] * 3, [[0, 1]], [300]), c=None), "overlap")


def test_an_image_that_matches_is_said_to_match():
    matched = capture([900] * 3, [[0, 1], [0, 2], [1, 2]], [300, 20, 30])
    assert_facts(explained(matched), "placed", 50, 2)


def path(centers, names=None):
    count = len(centers)
    return SimpleNamespace(
        names=tuple(names or [f"{index:06d}.png" for index in range(count)]),
        registered=np.ones(count, bool),
        centers=np.column_stack([centers, np.zeros((count, 2))]))


def test_a_step_far_longer_than_those_around_it_is_a_jump():
    jump, = find_jumps(path([*range(10), *range(29, 40)]), {})
    assert (jump.before, jump.after) == ("000009.png", "000010.png")
    assert jump.ratio == pytest.approx(20)


def test_a_walk_that_speeds_up_slowly_has_no_jump():
    assert find_jumps(path(1.15 ** np.arange(40)), {}) == ()


def test_a_long_step_over_a_long_time_is_no_jump():
    names = [f"{index:06d}.png" for index in [*range(10), *range(29, 40)]]
    assert find_jumps(path([*range(10), *range(29, 40)], names), {}) == ()


def test_photos_without_times_or_numbers_say_nothing_of_steps():
    names = [f"photo_{index:02d}.png" for index in range(21)]
    centers = [*range(10), *range(29, 40)]
    assert find_jumps(path(centers, names), {}) == ()
    assert find_jumps(path(centers, names), dict.fromkeys(names)) == ()
    times = {name: float(index) for index, name in enumerate(names)}
    assert len(find_jumps(path(centers, names), times)) == 1


def test_the_times_set_the_order():
    names = [f"{index:06d}.png" for index in range(20)]
    times = {name: 19.0 - index for index, name in enumerate(names)}
    assert find_jumps(path(range(20), names), times) == ()


def test_a_few_cameras_have_no_usual_step():
    assert find_jumps(path([0, 1, 2, 90]), {}) == ()


def test_every_count_falls_into_one_of_ten_bins():
    histogram = Histogram.from_values(np.array([0, 9, 10, 99, 99]))
    assert histogram.edges == (0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100)
    assert histogram.counts == (2, 1, 0, 0, 0, 0, 0, 0, 0, 2)
    assert histogram.median == 10


def test_no_counts_are_an_empty_histogram():
    histogram = Histogram.from_values(np.zeros(0, np.int64))
    assert sum(histogram.counts) == 0
    assert histogram.median == 0


def shifted(made, share):
    """The model with its principal point moved sideways by a share of the image's width."""
    model = made.model()
    camera = model.camera(1)
    camera.principal_point_x += share * WIDTH
    return model


def test_a_lens_that_stays_near_where_it_began_is_not_bent(tmp_path):
    made = walk()
    database = made.write_database(tmp_path / "database.db")
    assert describe_shifted_centres(made.model(), database) == []
    assert describe_shifted_centres(shifted(made, 0.9 * MAX_SHIFT), database) == []


@pytest.mark.integration
def test_a_model_whose_lens_went_far_is_refused(tmp_path):
    made = walk()
    database = made.write_database(tmp_path / "database.db")
    verdict = examine(shifted(made, -0.11), database, made.names)
    assert not verdict.trusted
    with raises(SfmError, 1, "11%"):
        check_weak_link(verdict, accept=False)
    check_weak_link(verdict, accept=True)
