"""TX40: published base parameters and held-out effort (benchmarks/identification/tx40.py)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "identification"


def test_published_base_parameters_of_the_tx40_are_reproduced_within_their_uncertainty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import tx40
    import tx40_files

    source = tx40_files.folder()
    if source is None:
        pytest.skip("no recordings of the TX40: set TWIN_RECORDINGS")
    paths = tx40_files.write(source, tmp_path)
    words = ["identify", str(paths["twin"]), str(paths["fit"]), "--held-out"]
    assert cli.main([*words, str(paths["held_out"]), "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out/identification.json").read_text())
    ours = {one["expression"]: one for one in document["base_parameters"]}
    known = [one for one in tx40.published(source) if one[2] / abs(one[1]) < 0.05]
    assert len(known) == 22
    for expression, value, std in known:
        one = ours[expression]
        assert one["essential"], expression
        assert abs(one["value"] - value) < 1.96 * np.hypot(one["std"], std), expression
        assert one["relative_std"] < 0.15, expression
    for error in document["held_out"].values():
        assert error["effort_relative"] < error["effort_relative_nominal"]
    for name in ("tx40", "tx40_files"):
        sys.modules.pop(name, None)
