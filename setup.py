"""Makes the README's links absolute, for PyPI has none of the files that they name."""

import re
from pathlib import Path

_BLOB = "https://github.com/recon-cli/recon/blob/main"
_RAW = "https://raw.githubusercontent.com/recon-cli/recon/main"
_LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^\[\]]*)\]\((?P<path>(?!https?:)[^#)][^)]*)\)")


def absolute(text: str) -> str:
    """Returns Markdown whose links and pictures of this repository are URLs."""
    return _LINK.sub(lambda found: (
        f"{found['picture']}[{found['text']}]"
        f"({_RAW if found['picture'] else _BLOB}/{found['path']})"), text)


if __name__ == "__main__":
    from setuptools import setup

    setup(
        long_description=absolute(
            Path(__file__).with_name("README.md").read_text(encoding="utf-8")),
        long_description_content_type="text/markdown")
