"""What a picture shows, by the name of its file or folder, where it is not the scene's colours."""

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
    """Returns what pictures of such a name show instead of the scene, "" for nothing else."""
    return next((kind for kind, pattern in _NAMES.items() if pattern.search(name)), "")
