"""What --holdout says."""

from __future__ import annotations

from recon_cli.errors import ConfigError


def parse_holdout(text: str) -> tuple[str, float, float]:
    """Returns (kind, a, b) of --holdout: ("every", N, 0), ("segment", A, B) or ("none", 0, 0).

    Raises:
        ConfigError: the text is none of the three forms.
    """
    kind, *numbers = text.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if kind == "none" and not numbers:
        return kind, 0.0, 0.0
    if kind == "every" and len(values) == 1 and values[0] >= 2 and values[0].is_integer():
        return kind, values[0], 0.0
    if kind == "segment" and len(values) == 2 and 0 <= values[0] < values[1] <= 1:
        return kind, values[0], values[1]
    raise ConfigError(
        f"holdout is {text!r}, but it must be every:N (N >= 2), segment:A:B (0 <= A < B <= 1) "
        "or none.",
        hint="Try --holdout every:8.",
    )
