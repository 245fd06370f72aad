"""Limits that several modules of capture share."""

# Pictures that are cropped or scaled in whole pixels keep their width over their height this well.
SAME_SHAPE = 0.02
# Pictures of a set, evenly spread, by which all of it is judged.
SAMPLED_PICTURES = 8
# Corners or features: fewer move alike by chance.
MIN_TRACKS = 8
# Pixels of the longer side of a picture in which corners and features are found, and of one whose
# sharpness is measured: comparable, and free of the sensor noise of large frames.
TRACK_SIZE, MEASURE_SIZE = 640, 960
# SIFT features of a picture: pairs of neighbours then share hundreds, at 20 ms a pair.
MOST_FEATURES = 1500
# The tracker's windows in pixels, and what may lie between a corner and where following it there
# and back ends.
WINDOW, RETURN_ERROR = (15, 15), 1.0
# Pixels of an area at 0 or 255, as a share, beyond which what is averaged over it is cut off.
CLIPPED_SHARE = 0.02
