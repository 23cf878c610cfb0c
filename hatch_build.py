"""The package's addresses and description, made when it is built: README.md with absolute links, which a package index can follow.

GitHub's workflows name the repository in GITHUB_SERVER_URL, GITHUB_REPOSITORY and GITHUB_REF_NAME. A build elsewhere knows no address: then
the description has no pictures, and only the text of links to files.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = re.compile(r"!\[([^]]*)\]\((?!https?:)([^)]+)\)")
LINK = re.compile(r"(?<!!)\[([^]]*)\]\((?!https?:)([^)]+)\)")
# A paragraph, or a table with its heads, of pictures alone.
ONLY_PICTURES = re.compile(r"(?:^\|.*\n\|[-:| ]+\|\n)?^(?:\| )?!\[[^]]*\]\((?!https?:).*\n+", re.MULTILINE)


class Metadata(MetadataHookInterface):
    def update(self, metadata: dict[str, Any]) -> None:
        address = repository()
        readme = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": description(readme, address, os.getenv("GITHUB_REF_NAME", "HEAD"))}
        if address:
            files = f"{address}/blob/HEAD"
            metadata["urls"] = {"Source": address, "Documentation": f"{files}/docs/README.md", "Changelog": f"{files}/CHANGELOG.md",
                                "Issues": f"{address}/issues"}


def repository() -> str:
    """Return the address of the repository in which a workflow runs, or "" outside workflows."""
    name = os.getenv("GITHUB_REPOSITORY")
    return f"{os.getenv('GITHUB_SERVER_URL', 'https://github.com')}/{name}" if name else ""


def description(readme: str, address: str, version: str) -> str:
    """Return the Markdown `readme` with absolute links to the files of `version`; without address, with neither files nor pictures."""
    if not address:
        return LINK.sub(r"\1", ONLY_PICTURES.sub("", readme))
    return LINK.sub(rf"[\1]({address}/blob/{version}/\2)", PICTURE.sub(rf"![\1]({address}/raw/{version}/\2)", readme))
