"""Portable, unique file names for joint and link names on Windows, macOS and Linux."""

from __future__ import annotations

import re

from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.formats.file_names import (
    MAX_LENGTH,
    portable_name,
    portable_names,
    portable_paths,
)
from pytest_twin.release.file_names import colliding_names, problem_with

NAMES = st.one_of(
    st.text(max_size=12),
    st.text("aAbB:/ .-_é", max_size=4),
    st.sampled_from(["con", "CON", "Nul.txt", "com1", "lpt9.x", "a.", ".a", "-a", "", "x" * 300]),
)
POSIX_PORTABLE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


@settings(deadline=None)
@given(st.lists(NAMES, unique=True, max_size=12))
def test_different_names_get_different_files_on_every_system(names: list[str]) -> None:
    files = portable_names(names)
    assert list(files) == names
    assert len({file.lower() for file in files.values()}) == len(names)


@settings(deadline=None)
@given(st.lists(NAMES, unique=True, max_size=12))
def test_every_file_name_is_valid_on_every_system(names: list[str]) -> None:
    for file in portable_names(names).values():
        assert POSIX_PORTABLE.fullmatch(file)
        assert len(file) <= MAX_LENGTH
        assert problem_with(f"{file}.trace.csv") is None


@settings(deadline=None)
@given(st.lists(NAMES, unique=True, max_size=8), st.randoms())
def test_the_file_names_do_not_depend_on_the_order_of_the_names(
    names: list[str], random: object
) -> None:
    shuffled = list(names)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert portable_names(shuffled) == portable_names(names)


@settings(deadline=None)
@given(st.lists(NAMES, unique=True, max_size=8), NAMES)
def test_an_added_name_changes_only_files_of_names_that_differ_in_case(
    names: list[str], added: str
) -> None:
    before, after = portable_names(names), portable_names([*names, added])
    changed = {name for name in names if before[name] != after[name]}
    assert all(before[name].casefold() == portable_name(added).casefold() for name in changed)


def test_a_plain_name_keeps_its_spelling() -> None:
    plain = ["elbow", "LF_HAA", "link_11.0", "joint-2", "_x"]
    assert portable_names(plain) == {name: name for name in plain}


def test_escaped_names_stay_readable() -> None:
    assert re.fullmatch(r"robot0_FFJ3-[0-9a-f]{8}", portable_name("robot0:FFJ3"))
    assert re.fullmatch(r"Schiene_uber-[0-9a-f]{8}", portable_name("Schiene über"))
    assert re.fullmatch(r"con-[0-9a-f]{8}", portable_name("con"))
    assert re.fullmatch(r"[0-9a-f]{8}", portable_name("関節"))


def test_the_mapping_of_names_to_files_is_stable() -> None:
    # A change would rename files of existing twins and make their goldens stale.
    assert portable_names(["robot0:FFJ3", "J1", "j1"]) == {
        "robot0:FFJ3": "robot0_FFJ3-cc9add09",
        "J1": "J1-493d650d",
        "j1": "j1-08243666",
    }


@settings(deadline=None)
@given(
    st.lists(
        st.lists(
            st.text(
                st.characters(exclude_characters="/\0", exclude_categories=["Cs"]),
                min_size=1,
                max_size=8,
            ).filter(lambda part: part not in (".", "..")),
            min_size=1,
            max_size=3,
        ).map("/".join),
        unique=True,
        max_size=8,
    ).filter(lambda paths: not any(b.startswith(f"{a}/") for a in paths for b in paths))
)
def test_portable_paths_are_valid_and_unique(paths: list[str]) -> None:
    found = portable_paths(paths)
    assert list(found) == paths
    assert [problem_with(path) for path in found.values()] == [None] * len(paths)
    assert colliding_names(found.values()) == []


def test_a_portable_path_is_unchanged() -> None:
    paths = ["golden/fk/frames.yaml", "asset/Gelenk ü/mesh 1.stl"]
    assert portable_paths(paths) == {path: path for path in paths}


def test_a_file_keeps_its_suffix() -> None:
    assert re.fullmatch(
        r"asset/a_b_stl-[0-9a-f]{8}\.stl", portable_paths(["asset/a:b.stl"])["asset/a:b.stl"]
    )
