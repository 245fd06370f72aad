"""Names of files and folders whose pictures do not show the scene's colours: depth, masks."""

from __future__ import annotations

import re

_KINDS = {
    "masks": "masks?",
    "depth maps": "depths?|depthmaps?|disparity|disparities|disp",
    "confidence maps": "confidences?|conf",
    "normal maps": "normals?",
    "labels": "semantics?|segmentations?|segs?|labels?|instances?",
    "small copies": "thumbs?|thumbnails?|previews?",
}
_NAMES = {kind: re.compile(rf"(?:^|[^a-z])(?:{words})(?:$|[^a-z])", re.IGNORECASE)
          for kind, words in _KINDS.items()}


def picture_kind(name: str) -> str:
    """Returns the content of pictures of such a name (a mask, depth), "" for the scene itself."""
    return next((kind for kind, pattern in _NAMES.items() if pattern.search(name)), "")
