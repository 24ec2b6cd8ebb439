"""Write and verify signed releases: results of goldens, with all that they depended on."""

from pytest_twin.release.check import Baseline, baseline, check, newest
from pytest_twin.release.environment import environment
from pytest_twin.release.keys import signer
from pytest_twin.release.statement import Draft, FileEntry, Header, Previous, Proof, Release
from pytest_twin.release.verify import ReleaseProblem, Verdict
from pytest_twin.release.write import write

__all__ = [
    "Baseline",
    "Draft",
    "FileEntry",
    "Header",
    "Previous",
    "Proof",
    "Release",
    "ReleaseProblem",
    "Verdict",
    "baseline",
    "check",
    "environment",
    "newest",
    "signer",
    "write",
]
