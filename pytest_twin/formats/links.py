"""Links to files that may be followed: those that end in the same store, or where a user allows it.

git-annex, DVC and the Hugging Face cache keep the content of files in a store, and a link to it
where each file belongs. Who made the folder could have put the file itself there, so following such
a link reads nothing more.
"""

from __future__ import annotations

import configparser
import os
import re
from collections.abc import Iterator
from pathlib import Path

from pytest_twin.formats.declared_inputs import declared_inputs

_DVC_CONTENT = re.compile(r"(files/md5/)?[0-9a-f]{2}/[0-9a-f]{30}(\.dir)?")
"""Name of a file in a DVC cache: its digest. A configuration may name any folder as the cache, so
that no file of another name is read from it."""
_WORKSPACE_OUTPUTS = ("install", "build", "devel")


def allowed_end(link: Path, target: Path) -> Path | None:
    """Folder or file in which a link may end; None if it may not be followed.

    Args:
        link: the link; its folder contains no link.
        target: where it ends, with all links resolved.
    """
    places = (*declared_inputs().roots, *declared_inputs().packages.values(), *stores(link))
    for place in places:
        if target.is_relative_to(place):
            return place
    for cache in _dvc_caches(link):
        if target.is_relative_to(cache) and _DVC_CONTENT.fullmatch(
            target.relative_to(cache).as_posix()
        ):
            return target
    return None


def stores(link: Path) -> Iterator[Path]:
    """Yield the folders in which a link may end, because a data manager keeps the contents there.

    Args:
        link: the link; it need not exist.
    """
    for folder in link.parents:
        # https://huggingface.co/docs/huggingface_hub/guides/manage-cache
        if folder.name == "snapshots":
            yield folder.parent / "blobs"
        # https://git-annex.branchable.com/internals/
        if (folder / ".git").is_dir():
            yield folder / ".git" / "annex" / "objects"
        # colcon and catkin link from what they build to the sources of the workspace.
        if folder.name in _WORKSPACE_OUTPUTS and (folder.parent / "src").is_dir():
            yield folder.parent / "src"


def _dvc_caches(link: Path) -> Iterator[Path]:
    """Yield the caches of the DVC repositories above a link: https://dvc.org/doc/user-guide."""
    for folder in link.parents:
        settings = folder / ".dvc"
        if not settings.is_dir():
            continue
        yield settings / "cache"
        for name in ("config", "config.local"):
            stated = configparser.ConfigParser(interpolation=None, strict=False)
            try:
                stated.read(settings / name, encoding="utf-8")
            except (configparser.Error, UnicodeDecodeError, OSError):
                continue
            if stated.has_option("cache", "dir"):
                yield Path(os.path.realpath(settings / stated.get("cache", "dir")))
