"""Build hook of hatchling: the documentation goes into the wheel.

Where ``make docs`` has built the site of the files as they are now, wheel and source distribution
hold it; else the wheel holds the Markdown, and `trainlog docs` states how to get the site.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.append(str(Path(__file__).parent))

from sources import ADDED, site_of

PLACE = "trainlog/documentation_pages"
"""In the wheel."""


def included(checkout: Path, target: str) -> dict[str, str]:
    """Files and folders of the documentation by their place in a wheel, or in an sdist."""
    site = site_of(checkout)
    if site is not None:
        return {str(site): f"{PLACE}/site" if target == "wheel" else "build/site"}
    if target != "wheel":
        return {}
    docs = checkout / "docs"
    pages = [path for end in ("md", "png", "ipynb") for path in sorted(docs.rglob(f"*.{end}"))]
    found = {str(path): f"{PLACE}/source/{path.relative_to(docs).as_posix()}" for path in pages}
    return found | {str(checkout / at): f"{PLACE}/source/{name}" for name, at in ADDED.items()}


class DocumentationHook(BuildHookInterface[Any]):
    """Adds the documentation to what is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Before a target is built."""
        if version == "editable":
            return
        checkout = Path(self.root)
        build_data["force_include"].update(included(checkout, self.target_name))
        if site_of(checkout) is None:
            self.app.display_warning(
                "build/site is missing or of other files: the documentation is included as Markdown"
            )
