"""Limits that several modules of capture share."""

# Pictures that are cropped or scaled in whole pixels keep their width over their height this well.
SAME_SHAPE = 0.02
# Pictures of a set, evenly spread, by which all of it is judged.
SAMPLED_PICTURES = 8
# Corners or features: fewer move alike by chance.
MIN_TRACKS = 8
# Matches that agree with one epipolar geometry, as COLMAP asks for. Of 3,200 pairs of pictures of
# two scenes none had more than 13.
MIN_MATCHES = 15
# Pixels of the longer side of a picture in which corners and features are found, and of one whose
# sharpness is measured: comparable, and free of the sensor noise of large frames.
TRACK_SIZE, MEASURE_SIZE = 640, 960
# Of the distances to the best and the second best feature (Lowe, IJCV 2004, section 7.1).
MAX_RATIO = 0.8
# SIFT features of a picture: pairs of neighbours then share hundreds, at 20 ms a pair.
MOST_FEATURES = 1500
# The tracker's windows in pixels, and what may lie between a corner and where following it there
# and back ends.
WINDOW, RETURN_ERROR = (15, 15), 1.0
# Pixels of an area at 0 or 255, as a share, beyond which what is averaged over it is cut off.
CLIPPED_SHARE = 0.02
