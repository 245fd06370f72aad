"""How many examples Hypothesis tries: few every day, all where HYPOTHESIS_PROFILE is `full`."""

from __future__ import annotations

import os

from hypothesis import settings

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "default")
SHARE = 10  # the full profile tries this many times as many as the default one
FEWEST = 5


def load_profile() -> None:
    """Chooses the profile; the default one tries the same examples in every run."""
    settings.register_profile("default", deadline=None, derandomize=True, database=None)
    settings.register_profile("full", deadline=None)
    settings.load_profile(PROFILE)


def examples(full: int) -> int:
    """Returns the number of examples of a test that tries `full` of them in the full profile."""
    return full if PROFILE == "full" else max(FEWEST, full // SHARE)
