"""COLMAP's limits, and ours of what fits together: each with one name, one meaning and a reason.

What only one step counts by itself (rounds, samples, neighbours) stands in the module of that step.
"""

from __future__ import annotations

from recon_cli.scene.matches import MIN_PAIR_INLIERS
from recon_cli.workspace import records as store

# --- matches and features
# COLMAP gives an image a camera from so many inliers on, and this share of its matches
# (abs_pose_min_num_inliers, abs_pose_min_inlier_ratio). Fewer points fix no similarity either.
MIN_POSE_INLIERS, MIN_POSE_SHARE = 30, 0.25
# What the relaxed mapper takes for these two: as much as for a pair, and about half.
RELAXED_POSE_INLIERS, RELAXED_POSE_SHARE = MIN_PAIR_INLIERS, 0.15
# Share of the matches of two panoramas that must fit one motion: a plane of rays through a panorama
# meets many features by chance. Of pairs in one room .37 to .98, in neighbouring rooms .4 to .6, in
# rooms that do not see each other at most .3, with up to 34 matches.
MIN_PANORAMA_SHARE = 0.33
# Tracks count beside features where a pair has fewer matches than this: they are less exact.
FEW_PAIR_MATCHES = 100
# An image with fewer keypoints is said to have too few. In six of eight captures 19 of 20 images
# had a fifth of their keypoints or more in the model, which is MIN_POSE_INLIERS of these.
FEW_KEYPOINTS = 5 * MIN_POSE_INLIERS
# Keypoints by which images are compared, largest scale first: they are seen from more places.
COARSEST_KEYPOINTS = 1000
# Share of verified matches in pairs explained by one homography: a turn on the spot, a flat wall.
# Measured: 0.03 to 0.38 around rooms, 0.50 in a short walk, 0.99 and 1.00 in turns on the spot.
MAX_FLAT_SHARE = 0.9
# Share of all verified matches that pairs at some distance must hold beside the flat ones to show
# depth: pairs that hardly overlap look deep by chance.
MIN_DEEP_SHARE = 0.01
# RANSAC's trials, of COLMAP's 10000, mostly spent on pairs without anything in common. 2000 took a
# third off the verification of five captures and lost 8 of 5700 verified pairs, but no image. A
# similarity that a quarter of the points agree on takes 900.
MAX_TRIALS = 2000

# --- points and rays
# Pixels that a point may be off in a model, and a match from its epipolar line
# (TwoViewGeometryOptions.ransac.max_error): COLMAP's.
MAX_ERROR_PX = 4.0
EXACT_PX = MAX_ERROR_PX / 2  # the same of a match that alone is to show something
# Degrees between the rays to a point: COLMAP drops a point of less.
MIN_RAY_ANGLE_DEG = 1.5
# The median of these angles in a model: 7 to 23 in good captures, 3.9 in one that failed.
MIN_PARALLAX_DEG = 2.0
# Scale of Cauchy's loss, times the mean error. Cameras of two rooms came out at .54 and .47 cm
# without it, at .34 and .19 without what is OUTLIER_SIGMAS off (mapper), at .16 and .09 with both.
LOSS_SCALE = 0.5

# --- models
MIN_FRAMES = store.MIN_FRAMES
# Fewer images of a camera cannot tell its principal point from a turn (COLMAP: min_model_size).
MIN_IMAGES_PRINCIPAL = 10
# Frames of a stretch that is mapped, or whose scale or height is measured, by itself.
MIN_STRETCH = 10
# Frames up to which a capture is mapped as one, and all of them are keyframes.
FEW_FRAMES = 200
# Neighbours of a frame: they are matched in any case, and a loop is closed by more than one pair.
NEAR_FRAMES = 3
# Share of the frames that can be placed which a model must hold, else another mapper is tried. Two
# rooms and 50 photos held all; a slow walk that split into four to seven models 76 to 82%.
ENOUGH_FRAMES = 0.9
# With a larger share of suspected images the model is wrong; removing them would hide it.
MAX_REJECTED = 0.2

# --- two models of one place, and two stretches of a walk
# Distance of two equal points, as a share of the median distance of a point from a camera. Depth is
# known to 1 to 3%: up to 4 px of some 1000 px focal length over 7 to 23 degrees between rays.
MAX_POINT_ERROR = 0.03
# Share of the points that agree: of the frames in common of two segments, and of a pair of other
# frames or of a loop. Where a segment is broken within the common frames, half to three quarters of
# their points agree, else nine tenths: see tests/bench/bench_join_breaks.py.
MIN_COMMON_SHARE, MIN_LOOP_SHARE = 0.8, 0.5
# What a way drifts: degrees, and displacement as a share of the way. Around a can whose label
# repeats, pairs that only look alike are off by 116 degrees in the median.
MAX_DRIFT_DEG, MAX_DRIFT = 15.0, 0.2
# Times MAX_POINT_ERROR: how far apart the points of a join may be, in the median, in a graph.
MAX_RESIDUAL = 3.0
# Images per image, besides those that should overlap, that it is matched with because they look
# alike: enough to find a loop, whose frames are matched with more of each other then.
LOOP_CANDIDATES = 2
# Frames; pairs whose ends are nearer than this in the walk are one witness of a loop.
NEAR_IN_WALK = 10

# --- the verdict: see tests/bench/bench_verdict.py
# Shares of the matches of a pair across the weakest cut: that must show one point, and that the
# cameras must explain.
MIN_ONE_POINT, MIN_EXPLAINED = 0.7, 0.6
# Sides of a cut of up to this share of the cameras are outliers, which can be dropped, and not half
# of a doubled place: blurred images match badly too.
MAX_OUTLIERS = 0.1
# Share of the matches of any one pair, or of a spot check of given poses, that the cameras must
# explain, else they contradict them. In checks of a room and a desk it was .997 and more, by wrong
# axes or other images .07 to .36 (tests/bench/bench_spot_check.py).
MIN_PAIR_EXPLAINED = 0.5
# Share of the verified matches that the points of given poses must confirm. Nine rendered frames
# gave 0.76 with their true poses and at most 0.06 with other axes or the names swapped.
MIN_CONFIRMED = 0.2
# Of the spot check of given poses: matches of all pairs together, fewer say nothing.
MIN_SPOT_MATCHES = 60
