"""Problems that are drawn from seeds: blind cases of each family, and one law alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from frozen.one_law import make as make_one_law
from frozen.problem import Inputs, MissingInputError, Problem

sys.path.insert(0, str(Path(__file__).parents[1] / "concealed"))

CONTACT = ("contact_offset", "contact_stiffness", "contact_damping", "contact_friction")
HELD = range(5000, 5012)
CELLS = range(100230, 100248)
ENGINES = range(201160, 201172)
REAL = range(81000, 81040)
SIX_JOINTS = range(100300, 100306)
TOUCHING = range(5100, 5108)
ONE_LAW = range(60)
"""Seeds of each family. All of them have been looked at, so their figures are training figures."""


def problems() -> Iterator[Problem]:
    """Yield all drawn problems."""
    for seed in HELD:
        yield Problem(f"held/{seed}", "diagnose", partial(_blind, "cases", seed))
    for seed in CELLS:
        yield Problem(f"cells/{seed}", "diagnose", partial(_blind, "cell_cases", seed))
    for seed in ENGINES:
        yield Problem(f"engines/{seed}", "diagnose", partial(_blind, "engine_cases", seed))
    for seed in REAL:
        yield Problem(f"real/{seed}", "diagnose", partial(_blind, "real_cases", seed))
    for seed in SIX_JOINTS:
        yield Problem(f"six_joints/{seed}", "diagnose", partial(_blind, "cell_cases", seed, 6))
    for k, seed in enumerate(TOUCHING):
        effect = CONTACT[k % len(CONTACT)]
        yield Problem(f"contact/{seed}", "diagnose", partial(_blind, "cases", seed, effect))
    for seed in ONE_LAW:
        yield Problem(f"one_law/{seed:02d}", "diagnose", partial(make_one_law, seed))


def _blind(script: str, seed: int, *rest: object) -> Inputs:
    """Write a blind case to the folder that is the last argument, its truth file beside it."""
    *options, folder = rest
    assert isinstance(folder, Path)
    make: Callable[..., str]
    try:
        module = __import__(script)
    except ImportError as error:
        raise MissingInputError(f"pip install 'pytest-twin[engines]': {error}") from None
    if script == "real_cases" and not module.RECORDINGS.is_dir():
        raise MissingInputError("set TWIN_RECORDINGS to the folder of real recordings")
    make = module.make
    name = make(seed, folder / "cases", folder / "truth", *options)
    case = folder / "cases" / name
    twin = case / "twin.yaml"
    return Inputs(
        twin if twin.exists() else case / "model.xml",
        sorted((case / "recordings").glob("*.mcap")),
        truth=json.loads((folder / "truth" / f"{name}.json").read_text()),
    )
