"""Which photos one camera took with one setting of its lens: they share intrinsics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from recon_cli.capture.images import Photo

# Focal lengths that agree this well are one setting of the lens: EXIF rounds to a tenth of a mm.
SAME_FOCAL = 0.01


@dataclass(frozen=True)
class PhotoGroup:
    """Photos that share intrinsics.

    Attributes:
        name: camera, size and, where two groups share these, focal length; for messages.
        photos: at least one, in the order in which they were given.
    """

    name: str
    photos: tuple[Photo, ...]

    @property
    def width(self) -> int:
        """Width in pixels, upright."""
        return self.photos[0].width

    @property
    def height(self) -> int:
        """Height in pixels, upright."""
        return self.photos[0].height

    @property
    def focal_px(self) -> float | None:
        """Focal length in pixels by EXIF, None where unknown."""
        return self.photos[0].focal_px


def group_photos(photos: Sequence[Photo]) -> list[PhotoGroup]:
    """Returns the photos in groups of one size, camera and focal length, by their first photos.

    A photo taken upright and one taken across differ in size. Photos without EXIF are one group
    for each size.
    """
    groups: list[list[Photo]] = []
    for photo in photos:
        home = next((group for group in groups if _alike(group[0], photo)), None)
        if home is None:
            groups.append([photo])
        else:
            home.append(photo)
    names = _names([group[0] for group in groups])
    return [PhotoGroup(name, tuple(group)) for name, group in zip(names, groups, strict=True)]


def odd_photos(groups: Sequence[PhotoGroup]) -> list[Photo]:
    """Returns photos that fit no other: alone in their group, without EXIF, of a size of their own.

    They may be pictures that went into the folder by mistake.
    """
    sizes = Counter((group.width, group.height) for group in groups)
    return [
        group.photos[0] for group in groups
        if len(groups) > 1 and len(group.photos) == 1 and not _has_exif(group.photos[0])
        and sizes[group.width, group.height] == 1]


def group_notices(groups: Sequence[PhotoGroup]) -> list[str]:
    """Returns what to tell the user of the groups: nothing where there is one."""
    if len(groups) < 2:
        return []
    listed = ", ".join(f"{len(group.photos)} of {group.name}" for group in groups)
    return [
        f"The photos are of {len(groups)} kinds, each with a lens of its own: {listed}.",
        *(f"{photo.path.name} fits no other photo: {photo.width}x{photo.height} and no EXIF. "
          "Remove it if it does not belong to the scene." for photo in odd_photos(groups))]


def _alike(first: Photo, other: Photo) -> bool:
    return (
        (first.width, first.height, first.camera) == (other.width, other.height, other.camera)
        and _same(first.focal_px, other.focal_px) and _same(first.focal_mm, other.focal_mm))


def _same(first: float | None, other: float | None) -> bool:
    if first is None or other is None:
        return first is other
    return max(first, other) <= min(first, other) * (1 + SAME_FOCAL)


def _has_exif(photo: Photo) -> bool:
    return bool(photo.camera) or photo.focal_px is not None or photo.focal_mm is not None


def _names(firsts: Sequence[Photo]) -> list[str]:
    """Returns a name for each group, with its focal length where that makes the difference."""
    plain = [f"{photo.camera} {photo.width}x{photo.height}".strip() for photo in firsts]
    twice = {name for name, count in Counter(plain).items() if count > 1}
    names = [
        f"{name} {_focal(photo)}".strip() if name in twice else name
        for name, photo in zip(plain, firsts, strict=True)]
    seen: Counter[str] = Counter()
    for place, name in enumerate(names):
        seen[name] += 1
        names[place] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return names


def _focal(photo: Photo) -> str:
    if photo.focal_mm is not None:
        return f"{photo.focal_mm:g} mm"
    return "" if photo.focal_px is None else f"f = {photo.focal_px:.0f} px"
