"""What matches between two images must have, in photos that are chosen and in a model alike."""

# COLMAP takes a pair of images for verified from so many inliers on
# (TwoViewGeometryOptions.min_num_inliers); fewer keypoints or shared points cannot make a pair. Of
# 3,200 pairs of pictures of two scenes none had more than 13.
MIN_PAIR_INLIERS = 15
# Of the distances to the best and the second best feature (Lowe, IJCV 2004, section 7.1), and of
# their angles, as in COLMAP (SiftMatchingOptions).
MAX_RATIO = 0.8
# Images whose pairs are all matched. Their number grows with the square: 4950 pairs take a minute
# on two cores at 600x340.
EXHAUSTIVE_MAX = 100
