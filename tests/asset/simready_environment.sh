#!/usr/bin/env bash
# simready_environment.sh FOLDER: an environment with NVIDIA's validator of SimReady assets, in FOLDER.
# Its usd-core must not lie beside the usd-exchange of the extra `usd`, so that it has its own.
# The tests use it where TWIN_SIMREADY=FOLDER is set.
set -euo pipefail
python3 -m venv "$1"
"$1/bin/pip" install -q 'simready-validate==2026.8.0' 'simready-foundation-tier-core==2026.8.0'
