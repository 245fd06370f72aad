"""Colours of a picture with an embedded ICC profile, such as Display P3, as sRGB.

Phones write Display P3. Shown as sRGB its colours are dull, and a photo beside a video of the same
phone would differ. A profile that is sRGB by its values leaves the pixels as they are.
"""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from PIL import Image, ImageCms

# Profiles of sRGB by several makers differ by rounding; Display P3 differs by up to 60 of 255.
_SAME = 2
_FLAGS = ImageCms.Flags.BLACKPOINTCOMPENSATION


def to_srgb(image: Image.Image) -> Image.Image:
    """Returns an 8-bit RGB or RGBA picture in sRGB; others, and those without a profile, as is.

    A profile that cannot be read counts as none, as in browsers.
    """
    profile = image.info.get("icc_profile")
    if image.mode not in ("RGB", "RGBA") or not isinstance(profile, bytes) or not profile:
        return image
    transform = _transform(profile)
    if transform is None:
        return image
    alpha = None
    if image.has_transparency_data:  # by a channel, or by one colour that another would replace
        image = image.convert("RGBA")
        alpha = image.getchannel("A")
    colours = ImageCms.applyTransform(image.convert("RGB"), transform)
    assert colours is not None  # it was not told to work in place
    if alpha is not None:
        colours.putalpha(alpha)
    return colours


@lru_cache(maxsize=16)
def _transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """Returns the way from an RGB profile to sRGB; None for sRGB itself and for a broken one."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        transform = ImageCms.buildTransform(
            source, ImageCms.createProfile("sRGB"), "RGB", "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC, _FLAGS)
        steps = np.linspace(0, 255, 9).round().astype(np.uint8)
        colours = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(27, 27, 3)
        moved = ImageCms.applyTransform(Image.fromarray(colours), transform)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    difference = np.abs(np.asarray(moved).astype(int) - colours).max()
    return transform if difference > _SAME else None
